"""Whether two scenes are the same, aspect by aspect, as shares from 0 to 1 (pure)."""

from collections.abc import Iterable, Mapping

import numpy as np
from scipy.spatial import cKDTree

from prior_sg.schemas.objects import SceneObject
from prior_sg.schemas.scene import Scene

NEAR_M = 0.01  # that a place may have moved
OBJECT_NEAR_M = 0.2  # between the middles of an object in both
ASPECTS = ("places", "place_ids", "edges", "cameras", "labels", "regions", "region_ids", "objects", "object_ids")
LASTING = ("place_ids", "region_ids", "object_ids")  # told, not judged: who joins a stream late numbers otherwise


def likeness(one: Scene, other: Scene) -> dict[str, float]:
    """How alike two scenes are in each of ASPECTS. Places are the same where they stand at the same spot."""
    first, second = _common(one, other)
    kept = one.place_ids[first] == other.place_ids[second]
    names = [{region.id: region.label for region in scene.regions} for scene in (one, other)]
    regions = one.place_regions[first].tolist(), other.place_regions[second].tolist()
    labels = [[known.get(region, "") for region in ids] for known, ids in zip(names, regions, strict=True)]
    edges = _edges(one, dict(zip(one.place_ids[first].tolist(), second.tolist(), strict=True)))
    other_edges = _edges(other, {place: row for row, place in enumerate(other.place_ids.tolist())})
    cameras = min(len(one.trajectory), len(other.trajectory))
    moved = np.abs(one.trajectory[:cameras] - other.trajectory[:cameras]).max(axis=1, initial=0.0) > NEAR_M
    pairs, ids = _objects(one.objects, other.objects)
    return {
        "places": _share(len(first), len(one.place_ids) + len(other.place_ids) - len(first)),
        "place_ids": _share(int(kept.sum()), len(first)),
        "edges": _jaccard(edges, other_edges),
        "cameras": _share(int((~moved).sum()), max(len(one.trajectory), len(other.trajectory))),
        "labels": _share(sum(a == b for a, b in zip(*labels, strict=True)), len(first)),
        "regions": _partition(edges & other_edges, dict(zip(second.tolist(), zip(*regions, strict=True), strict=True))),
        "region_ids": _share(sum(a == b for a, b in zip(*regions, strict=True)), len(first)),
        "objects": _share(pairs, max(len(one.objects), len(other.objects))),
        "object_ids": _share(ids, max(len(one.objects), len(other.objects))),
    }


def worst(measured: Iterable[Mapping[str, float]]) -> dict[str, float]:
    """The least of each aspect."""
    found = list(measured)
    return {aspect: min((one[aspect] for one in found), default=1.0) for aspect in ASPECTS}


def differences(measured: Mapping[str, float], tolerance: Mapping[str, float], lasting: bool) -> list[str]:
    """In which aspects two scenes differ more than undisturbed ones do."""
    judged = [aspect for aspect in ASPECTS if lasting or aspect not in LASTING]
    return [
        f"{aspect} {measured[aspect]:.3f} (undisturbed {tolerance[aspect]:.3f})"
        for aspect in judged
        if measured[aspect] < tolerance[aspect] - 1e-9
    ]


def kept_ids(before: Scene, after: Scene) -> float:
    """Share of the places that stand where they stood, which have the ids that they had."""
    first, second = _common(before, after)
    return _share(int((before.place_ids[first] == after.place_ids[second]).sum()), len(first))


def _common(one: Scene, other: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the places that stand at the same spot in both, each once."""
    if not (len(one.place_ids) and len(other.place_ids)):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    distances_m, nearest = cKDTree(other.positions_m).query(one.positions_m)
    _, back = cKDTree(one.positions_m).query(other.positions_m)
    rows = np.arange(len(one.place_ids))
    same = (distances_m <= NEAR_M) & (back[nearest] == rows)
    return rows[same], nearest[same]


def _edges(scene: Scene, rows: Mapping[int, int]) -> set[tuple[int, ...]]:
    """Edges between rows of the places that both have; an end that the other lacks is told by its own id."""
    return {tuple(sorted(rows.get(end, -1 - end) for end in edge)) for edge in scene.edges.tolist()}


def _partition(common: Iterable[tuple[int, ...]], regions: Mapping[int, tuple[int, int]]) -> float:
    """Share of the common edges that lie within one region in both, or cross a border in both."""
    alike = [
        (regions[a][0] == regions[b][0]) == (regions[a][1] == regions[b][1])
        for a, b in common
        if a in regions and b in regions
    ]
    return _share(sum(alike), len(alike))


def _objects(one: list[SceneObject], other: list[SceneObject]) -> tuple[int, int]:
    """How many objects stand in both with the same label, and how many of these have the same id."""
    free = list(other)
    same = 0
    found = 0
    for item in one:
        near = [
            (float(np.linalg.norm(np.subtract(item.position_m, twin.position_m))), number)
            for number, twin in enumerate(free)
            if twin.label == item.label
        ]
        distance_m, number = min(near, default=(np.inf, -1))
        if distance_m <= OBJECT_NEAR_M:
            found += 1
            same += free.pop(number).id == item.id
    return found, same


def _jaccard(one: Iterable, other: Iterable) -> float:
    first, second = set(one), set(other)
    return _share(len(first & second), len(first | second))


def _share(part: int, whole: int) -> float:
    return part / whole if whole else 1.0

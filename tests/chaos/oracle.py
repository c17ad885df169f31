"""Whether two scenes are the same, aspect by aspect, as shares from 0 to 1 (pure)."""

from collections.abc import Iterable, Iterator, Mapping

import numpy as np

from prior_sg.schemas.objects import SceneObject
from prior_sg.schemas.scene import Scene

NEAR_M = 0.01  # that a place may have moved
OBJECT_NEAR_M = 0.2  # between the middles of an object in both
ASPECTS = ("positions", "places", "edges", "cameras", "labels", "regions", "region_ids", "objects", "object_ids")
LASTING = ("region_ids", "object_ids")  # told, and not part of what must be equal while ids end with their service


def likeness(one: Scene, other: Scene) -> dict[str, float]:
    """How alike two scenes are in each of ASPECTS."""
    rows = _common(one, other)
    first, second = (np.array(part, np.int64) for part in zip(*rows, strict=True)) if rows else (np.zeros(0, int),) * 2
    near = np.linalg.norm(one.positions_m[first] - other.positions_m[second], axis=1) <= NEAR_M
    names = [{region.id: region.label for region in scene.regions} for scene in (one, other)]
    regions = one.place_regions[first].tolist(), other.place_regions[second].tolist()
    labels = [[known.get(region, "") for region in ids] for known, ids in zip(names, regions, strict=True)]
    cameras = min(len(one.trajectory), len(other.trajectory))
    moved = np.abs(one.trajectory[:cameras] - other.trajectory[:cameras]).max(axis=1, initial=0.0) > NEAR_M
    pairs, ids = _objects(one.objects, other.objects)
    return {
        "positions": _jaccard(*(_spots(scene) for scene in (one, other))),  # of places, whatever their ids
        "places": _share(int(near.sum()), len(one.place_ids) + len(other.place_ids) - len(rows)),
        "edges": _jaccard(map(tuple, one.edges.tolist()), map(tuple, other.edges.tolist())),
        "cameras": _share(int((~moved).sum()), max(len(one.trajectory), len(other.trajectory))),
        "labels": _share(sum(a == b for a, b in zip(*labels, strict=True)), len(rows)),
        "regions": _partition(
            one, other, dict(zip(one.place_ids[first].tolist(), zip(*regions, strict=True), strict=True))
        ),
        "region_ids": _share(sum(a == b for a, b in zip(*regions, strict=True)), len(rows)),
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


def _common(one: Scene, other: Scene) -> list[tuple[int, int]]:
    """Rows of the places that both have, by id."""
    rows = {place: row for row, place in enumerate(other.place_ids.tolist())}
    return [(row, rows[place]) for row, place in enumerate(one.place_ids.tolist()) if place in rows]


def _spots(scene: Scene) -> Iterator[tuple[int, ...]]:
    return map(tuple, np.rint(scene.positions_m / NEAR_M).astype(np.int64).tolist())


def _partition(one: Scene, other: Scene, regions: Mapping[int, tuple[int, int]]) -> float:
    """Share of the common edges that lie within one region in both, or cross a border in both."""
    common = set(map(tuple, one.edges.tolist())) & set(map(tuple, other.edges.tolist()))
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

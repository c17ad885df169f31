"""How far two scenes of one stream are the same, by what readers hold on to: places, labels, names of regions, objects.

Two undisturbed runs differ as well, in ids: workers answer in another order, so regions come and go at other times.
What they differ by is the measure for any other pair.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from prior_sg.schemas.scene import Scene

AT_ONE_PLACE_M = 0.01


class Same(NamedTuple):
    """Shares, each in [0, 1]: of places that stand where one of the other scene stands, and of these the shares that
    have the same id, the same label, and a region of the same id; of edges between these; of objects that overlap.
    """

    places: float
    place_ids: float
    labels: float
    region_ids: float
    edges: float
    objects: float
    object_ids: float

    def at_least(self, other: "Same", slack: float) -> bool:
        """Whether no share lies below that of another pair by more than `slack`; ids left out, for what is new after an
        exchange is numbered by another process.
        """
        what = ("places", "labels", "edges", "objects")
        return all(getattr(self, name) >= getattr(other, name) - slack for name in what)


def same(one: Scene, other: Scene) -> Same:
    """What two scenes have in common."""
    first, second = _pairs(one, other)
    count = max(len(one.place_ids), len(other.place_ids), 1)
    regions = one.place_regions[first], other.place_regions[second]
    edges = [_edges(one, dict(zip(one.place_ids[first].tolist(), range(len(first)), strict=True)))]
    edges.append(_edges(other, dict(zip(other.place_ids[second].tolist(), range(len(second)), strict=True))))
    boxes, ids = _objects(one, other)
    return Same(
        places=len(first) / count,
        place_ids=_share(one.place_ids[first] == other.place_ids[second]),
        labels=_share(_labels(one)[first] == _labels(other)[second]),
        region_ids=_share(regions[0] == regions[1]),
        edges=len(edges[0] & edges[1]) / max(len(edges[0] | edges[1]), 1),
        objects=boxes,
        object_ids=ids,
    )


def _pairs(one: Scene, other: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Rows of places that stand at one place."""
    if not (len(one.place_ids) and len(other.place_ids)):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    distances_m, at = cKDTree(other.positions_m).query(one.positions_m)
    rows = np.flatnonzero(distances_m <= AT_ONE_PLACE_M)
    return rows, at[rows]


def _labels(scene: Scene) -> np.ndarray:
    names = {region.id: region.label for region in scene.regions}
    return np.array([names.get(region, "") for region in scene.place_regions.tolist()])


def _edges(scene: Scene, row_of: dict[int, int]) -> set[tuple[int, int]]:
    found = set()
    for a, b in scene.edges.tolist():
        if a in row_of and b in row_of:
            found.add((min(row_of[a], row_of[b]), max(row_of[a], row_of[b])))
    return found


def _objects(one: Scene, other: Scene) -> tuple[float, float]:
    """Shares of the objects of which the other scene has one with the same middle, and of these with the same id."""
    if not (one.objects and other.objects):
        return float(not (one.objects or other.objects)), 1.0
    middles_m = [np.array([item.position_m for item in scene.objects]) for scene in (one, other)]
    sizes_m = np.array([np.subtract(item.max_m, item.min_m).max() for item in one.objects])
    distances_m, at = cKDTree(middles_m[1]).query(middles_m[0])
    there = np.flatnonzero(distances_m <= 0.5 * sizes_m)
    same_id = [one.objects[row].id == other.objects[at[row]].id for row in there.tolist()]
    return len(there) / max(len(one.objects), len(other.objects)), _share(np.array(same_id))


def _share(holds: np.ndarray) -> float:
    return float(np.mean(holds)) if len(holds) else 1.0

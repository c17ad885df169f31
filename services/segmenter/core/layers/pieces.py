"""Pieces of a map that no known way joins, and which of them stand side by side all the same (pure).

What was seen through a window, over a counter or from another storey is a piece of its own until somebody walks there.
Spheres of free space end at walls, so two pieces on both sides of a wall or a slab lie as far apart as that is thick.
"""

import numpy as np
import scipy

from prior_sg.services.compiled import compiled
from prior_sg.services.segmenter.core.map.received import ReceivedGraph
from prior_sg.services.segmenter.core.regions.components import numbered

NEAREST = 4  # places of another piece that are looked at from each place


def near_regions(
    graph: ReceivedGraph, regions: np.ndarray, ids: np.ndarray, edges: np.ndarray, join_m: float
) -> np.ndarray:
    """Pairs (n, 2) of regions of different pieces, smaller first, where the free space of these pieces is nearest.

    `regions` (place,) is the id of each place's region. Pairs and `edges` (contact, 2), which join regions that a way
    leads between, are numbers into `ids` (region,), ascending. Pieces whose nearest spheres are more than `join_m`
    apart are not joined.
    """
    piece = numbered(np.zeros(len(ids), np.int64), edges)
    if not piece.any():
        return np.zeros((0, 2), np.int64)
    rows = numbers_of(ids, regions)[regions]
    of_place = piece[rows]
    members = sorted((np.flatnonzero(of_place == one) for one in np.unique(of_place).tolist()), key=len)
    pairs = []
    for number, small in enumerate(members):
        for large in members[number + 1 :]:
            nearest = _nearest(graph, small, large, join_m)
            if nearest is not None:
                pairs.append(sorted((int(rows[nearest[0]]), int(rows[nearest[1]]))))
    return np.array(sorted(pairs), np.int64).reshape(-1, 2)


def numbers_of(ids: np.ndarray, regions: np.ndarray) -> np.ndarray:
    """Where each region (region id,) that there is in `ids` or `regions` comes in `ids`, -1 = not; the last entry is
    that of no region."""
    numbers = np.full(max(int(regions.max(initial=-1)), int(ids.max(initial=-1))) + 2, -1)
    numbers[ids] = np.arange(len(ids))
    return numbers


def _nearest(graph: ReceivedGraph, small: np.ndarray, large: np.ndarray, join_m: float) -> tuple[int, int] | None:
    """The places of two pieces whose spheres are nearest, unless these are more than `join_m` apart."""
    points_m, radii_m = graph.positions_m, graph.radii_m
    reach_m = float(radii_m[small].max() + radii_m[large].max()) + join_m
    large = _beside(points_m, large, small, reach_m)
    small = _beside(points_m, small, large, reach_m)
    if not len(small):
        return None
    k = min(NEAREST, len(large))
    tree = scipy.spatial.cKDTree(points_m[large])
    apart_m, at = tree.query(points_m[small], k=[*range(1, k + 1)], distance_upper_bound=reach_m)
    found = large[np.minimum(at, len(large) - 1)]
    gaps_m = apart_m - radii_m[small][:, None] - radii_m[found]
    first, second = np.unravel_index(int(gaps_m.argmin()), gaps_m.shape)
    if gaps_m[first, second] > join_m:
        return None
    return int(small[first]), int(found[first, second])


def _beside(points_m: np.ndarray, rows: np.ndarray, others: np.ndarray, reach_m: float) -> np.ndarray:
    """Those of `rows` in the box around `others` and `reach_m` more; none where there are no others."""
    if not len(others):
        return others
    low_m, high_m = points_m[others].min(axis=0) - reach_m, points_m[others].max(axis=0) + reach_m
    return _in_box(points_m, rows, low_m, high_m)


@compiled()
def _in_box(points_m, rows, low_m, high_m):  # noqa: ANN001, ANN202
    found, count = np.empty(len(rows), np.int64), 0
    for row in rows:
        inside = True
        for axis in range(3):
            inside = inside and low_m[axis] <= points_m[row, axis] <= high_m[axis]
        if inside:
            found[count] = row
            count += 1
    return found[:count].copy()

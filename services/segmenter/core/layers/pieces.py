"""Pieces of a map that no known way joins, and which of them stand side by side all the same (pure).

What was seen through a window, over a counter or from another storey is a piece of its own until somebody walks there.
Spheres of free space end at walls, so two pieces on both sides of a wall or a slab lie as far apart as that is thick.
"""

import numpy as np
import scipy

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
    trees = [scipy.spatial.cKDTree(graph.positions_m[one]) for one in members]
    pairs = []
    for number, small in enumerate(members):
        for tree, large in zip(trees[number + 1 :], members[number + 1 :], strict=True):
            nearest = _nearest(graph, small, large, tree, join_m)
            if nearest is not None:
                pairs.append(sorted((int(rows[nearest[0]]), int(rows[nearest[1]]))))
    return np.array(sorted(pairs), np.int64).reshape(-1, 2)


def numbers_of(ids: np.ndarray, regions: np.ndarray) -> np.ndarray:
    """Where each region (region id,) that there is in `ids` or `regions` comes in `ids`, -1 = not; the last entry is
    that of no region."""
    numbers = np.full(max(int(regions.max(initial=-1)), int(ids.max(initial=-1))) + 2, -1)
    numbers[ids] = np.arange(len(ids))
    return numbers


def _nearest(
    graph: ReceivedGraph, small: np.ndarray, large: np.ndarray, tree: "scipy.spatial.cKDTree", join_m: float
) -> tuple[int, int] | None:
    """The places of two pieces whose spheres are nearest, unless these are more than `join_m` apart."""
    points_m, radii_m = graph.positions_m, graph.radii_m
    reach_m = float(radii_m[small].max() + radii_m[large].max()) + join_m
    low_m, high_m = tree.mins - reach_m, tree.maxes + reach_m
    small = small[((points_m[small] >= low_m) & (points_m[small] <= high_m)).all(axis=1)]
    if not len(small):
        return None
    k = min(NEAREST, len(large))
    apart_m, at = tree.query(points_m[small], k=[*range(1, k + 1)], distance_upper_bound=reach_m)
    found = large[np.minimum(at, len(large) - 1)]
    gaps_m = apart_m - radii_m[small][:, None] - radii_m[found]
    first, second = np.unravel_index(int(gaps_m.argmin()), gaps_m.shape)
    if gaps_m[first, second] > join_m:
        return None
    return int(small[first]), int(found[first, second])

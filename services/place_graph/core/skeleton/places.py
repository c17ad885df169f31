"""From GVD voxels to places: compression cells, representatives, merging (Hydra, `graph_extractor`; pure).

Hydra's representative is the voxel with most basis points, a count that changes with every shift of the grid. The
middle of the group stays: a group that wins or loses a voxel at its edge has nearly the same middle.

Waves stop at what was not observed, so an obstacle behind a hole in the depth is none to them. A place's sphere ends
there all the same: obstacles are looked for in a straight line as well, as far as two cells.
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from prior_sg.services.compiled import compiled
from prior_sg.services.place_graph.core.skeleton.distance import STEPS
from prior_sg.services.place_graph.core.volume.grid import FAR_D2, OCCUPIED, UNKNOWN_D2, Box, VoxelGrid

SHIFT_UNITS = 16
LOOK_CELLS = 2  # how far obstacles behind unobserved space are looked for: no farther than a change renews places
Policy = Literal["middle", "basis_points", "distance"]


@dataclass(frozen=True)
class Extraction:
    """Places of one box, in the order of their voxels. A group is a connected set of GVD voxels in one cell."""

    voxels: np.ndarray  # (place, 3) int64, world voxel index of the representative
    shifts: np.ndarray  # (place, 3) int64, from the centre of that voxel to the place, SHIFT_UNITS to a voxel
    d2: np.ndarray  # (place,) float64, squared voxels to the nearest obstacle that observed space leads to, exact
    free_d2: np.ndarray  # (place,) float64, the same to any known obstacle at most LOOK_CELLS away, else d2
    basis: np.ndarray  # (place,) int64
    touching: np.ndarray  # (pair, 2) int64, places whose voxels touch, smaller first, sorted
    members: np.ndarray  # window of int32: place index of a member voxel, -1 elsewhere
    box: Box  # where `members` lies

    def place_at(self, voxel: np.ndarray) -> int:
        """Index of the place that the voxel belongs to, -1 if none."""
        return int(self.members[tuple(voxel - self.box.low)]) if self.box.contains(voxel) else -1


def cells_of(voxels: np.ndarray, cell_voxels: int) -> np.ndarray:
    """Compression cell (n, 3) of voxels (n, 3)."""
    return np.floor_divide(voxels, cell_voxels)


def whole_cells(box: Box, cell_voxels: int, margin_cells: int = 0) -> Box:
    """The box widened to whole compression cells and by `margin_cells` further ones."""
    low = np.floor_divide(box.low, cell_voxels) - margin_cells
    high = -np.floor_divide(-box.high, cell_voxels) + margin_cells
    return Box(low * cell_voxels, high * cell_voxels)


class ExtractionRules(NamedTuple):
    """What becomes a place; lengths in voxels."""

    cell: int  # side of a compression cell
    min_radius: float  # smallest radius of a place
    merge: float  # touching places nearer than this are one ...
    # ... that of the larger group. And a group's place is its middle; or, as in Hydra, the voxel with most basis points
    # or the widest, which absorbs as well.
    policy: Policy = "basis_points"


def extract(grid: VoxelGrid, box: Box, rules: ExtractionRules) -> Extraction:
    """Places of all cells inside `box`, which must consist of whole cells; the grid's GVD must be up to date."""
    basis = grid.gather("basis", box)
    d2 = grid.gather("d2", box, UNKNOWN_D2)
    members = _member_voxels(basis, d2, rules.min_radius**2)
    labels = np.full(basis.shape, -1, np.int32)
    cells = [np.floor_divide(low + np.arange(size), rules.cell) for low, size in zip(box.low, box.shape, strict=True)]
    groups = _grow_groups(members, labels, *cells)
    sizes = np.bincount(labels[tuple(members.T)], minlength=groups)
    if rules.policy == "middle":
        chosen, shifts = _middles(members, labels, sizes)
    else:
        chosen, shifts = _bests(members, labels, d2, basis, groups), np.zeros((groups, 3), np.int64)
    local = members[chosen]
    group_d2, group_basis = d2[tuple(local.T)].astype(np.int64), basis[tuple(local.T)].astype(np.int64)
    ranks = {
        "middle": (sizes, group_d2),
        "basis_points": (group_basis, group_d2),
        "distance": (group_d2, group_basis),
    }
    pairs = _unique_pairs(_touching(members, labels), groups)
    root = _merge(local, *ranks[rules.policy], pairs, rules.merge**2)
    kept = np.flatnonzero(root == np.arange(groups))
    index = np.full(groups, -1, np.int64)
    index[kept] = np.arange(len(kept))
    place_of = index[root] if groups else index
    labels[tuple(members.T)] = place_of[labels[tuple(members.T)]]
    touching = _unique_pairs(place_of[pairs], groups)
    local, shifts, clear_d2 = local[kept], shifts[kept], group_d2[kept].astype(np.float64)
    if shifts.any():
        _between_voxels(d2, grid.gather("offset", box), local, shifts, clear_d2, rules.min_radius**2)
    free_d2 = clear_d2.copy()
    _look_around(grid.gather("label", box), local, shifts, free_d2, LOOK_CELLS * rules.cell)
    return Extraction(local + box.low, shifts, clear_d2, free_d2, group_basis[kept], touching, labels, box)


def _member_voxels(basis: np.ndarray, d2: np.ndarray, min_d2: float) -> np.ndarray:
    """GVD voxels (n, 3) with room enough around them, in ascending order."""
    found = np.flatnonzero(basis.reshape(-1) > 0)
    found = found[d2.reshape(-1)[found] >= min_d2]
    return np.stack(np.unravel_index(found, basis.shape), axis=1)


def _unique_pairs(pairs: np.ndarray, count: int) -> np.ndarray:
    """Pairs (n, 2) of different indices below `count`, smaller first, sorted, once each."""
    one, two = pairs[pairs[:, 0] != pairs[:, 1]].T
    keys = np.unique(np.minimum(one, two) * count + np.maximum(one, two))
    return np.stack(np.divmod(keys, max(count, 1)), axis=1)


@compiled()
def _grow_groups(members, labels, cells_x, cells_y, cells_z):  # noqa: ANN001, ANN202
    """Label each 26-connected set of members inside one cell (-2: not reached yet); return the number of sets.

    The cells are those of the window's voxels along each axis.
    """
    for n in range(len(members)):
        labels[members[n, 0], members[n, 1], members[n, 2]] = -2
    stack = np.empty((len(members), 3), np.int64)
    groups = 0
    for n in range(len(members)):
        if labels[members[n, 0], members[n, 1], members[n, 2]] != -2:
            continue
        labels[members[n, 0], members[n, 1], members[n, 2]] = groups
        stack[0] = members[n]
        depth = 1
        while depth > 0:
            depth -= 1
            i, j, k = stack[depth]
            for s in range(26):
                a, b, c = i + STEPS[s, 0], j + STEPS[s, 1], k + STEPS[s, 2]
                if a < 0 or b < 0 or c < 0 or a >= labels.shape[0] or b >= labels.shape[1] or c >= labels.shape[2]:
                    continue
                if labels[a, b, c] != -2:
                    continue
                if cells_x[a] == cells_x[i] and cells_y[b] == cells_y[j] and cells_z[c] == cells_z[k]:
                    labels[a, b, c] = groups
                    stack[depth, 0], stack[depth, 1], stack[depth, 2] = a, b, c
                    depth += 1
        groups += 1
    return groups


def _bests(members: np.ndarray, labels: np.ndarray, d2: np.ndarray, basis: np.ndarray, groups: int) -> np.ndarray:
    """Per group the index (groups,) of the member with most basis points, then the widest, then the first."""
    where = tuple(members.T)
    group = labels[where]
    order = np.lexsort((np.arange(len(members)), -d2[where].astype(np.int64), -basis[where].astype(np.int64), group))
    return np.asarray(order[np.searchsorted(group[order], np.arange(groups))])


def _middles(members: np.ndarray, labels: np.ndarray, sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Per group the index (groups,) of the member nearest to the mean of all, and where in its voxel that mean lies.

    The second (groups, 3) is at most half a voxel on each axis, in SHIFT_UNITS. In whole numbers, hence exact.
    """
    group = labels[tuple(members.T)]
    sums = np.zeros((len(sizes), 3), np.int64)
    np.add.at(sums, group, members)
    apart2 = ((members * sizes[group, None] - sums[group]) ** 2).sum(axis=1)
    order = np.lexsort((np.arange(len(members)), apart2, group))
    chosen = order[np.searchsorted(group[order], np.arange(len(sizes)))]
    shifts = (sums - members[chosen] * sizes[:, None]) * SHIFT_UNITS // np.maximum(sizes, 1)[:, None]
    return chosen, np.clip(shifts, -SHIFT_UNITS // 2, SHIFT_UNITS // 2)


@compiled()
def _between_voxels(d2, offset, voxels, shifts, clear_d2, least_d2):  # noqa: ANN001, ANN202, PLR0917
    """Set the squared distance (place,) of places off their voxels (n, 3) by `shifts` to the nearest obstacle.

    Of the obstacles that a voxel and its neighbours are nearest to. A place with too little room stays on its voxel.
    """
    for n in range(len(voxels)):
        best = np.int64(1 << 40)
        for dx in (-1, 0, 1):
            for dy in (-1, 0, 1):
                for dz in (-1, 0, 1):
                    a, b, c = voxels[n, 0] + dx, voxels[n, 1] + dy, voxels[n, 2] + dz
                    if a < 0 or b < 0 or c < 0 or a >= d2.shape[0] or b >= d2.shape[1] or c >= d2.shape[2]:
                        continue
                    if d2[a, b, c] < 0 or d2[a, b, c] == FAR_D2:
                        continue
                    x = (np.int64(offset[a, b, c, 0]) - dx) * SHIFT_UNITS + shifts[n, 0]
                    y = (np.int64(offset[a, b, c, 1]) - dy) * SHIFT_UNITS + shifts[n, 1]
                    z = (np.int64(offset[a, b, c, 2]) - dz) * SHIFT_UNITS + shifts[n, 2]
                    best = min(best, x * x + y * y + z * z)
        if best >= least_d2 * SHIFT_UNITS**2:
            clear_d2[n] = best / SHIFT_UNITS**2
        else:
            shifts[n] = 0


@compiled()
def _look_around(label, voxels, shifts, free_d2, farthest):  # noqa: ANN001, ANN202
    """Lower `free_d2` (place,) to the squared distance of the nearest obstacle within it and within `farthest`."""
    for n in range(len(voxels)):
        best = min(free_d2[n], float(farthest * farthest)) * SHIFT_UNITS**2
        reach = int(np.sqrt(best)) // SHIFT_UNITS + 1
        nearest = best
        for i in range(max(voxels[n, 0] - reach, 0), min(voxels[n, 0] + reach + 1, label.shape[0])):
            x = (i - voxels[n, 0]) * SHIFT_UNITS - shifts[n, 0]
            for j in range(max(voxels[n, 1] - reach, 0), min(voxels[n, 1] + reach + 1, label.shape[1])):
                y = (j - voxels[n, 1]) * SHIFT_UNITS - shifts[n, 1]
                if x * x + y * y >= nearest:
                    continue
                for k in range(max(voxels[n, 2] - reach, 0), min(voxels[n, 2] + reach + 1, label.shape[2])):
                    if label[i, j, k] == OCCUPIED:
                        z = (k - voxels[n, 2]) * SHIFT_UNITS - shifts[n, 2]
                        nearest = min(nearest, x * x + y * y + z * z)
        if nearest < best:
            free_d2[n] = nearest / SHIFT_UNITS**2


@compiled()
def _touching(members, labels):  # noqa: ANN001, ANN202
    """Pairs of group labels with neighbouring voxels (26-neighbourhood), with repeats."""
    pairs = np.empty((len(members) * 4 + 16, 2), np.int64)
    count = 0
    for n in range(len(members)):
        i, j, k = members[n]
        last = -1
        for s in range(13, 26):  # the other half of the neighbours sees the pair from its side
            a, b, c = i + STEPS[s, 0], j + STEPS[s, 1], k + STEPS[s, 2]
            if a < 0 or b < 0 or c < 0 or a >= labels.shape[0] or b >= labels.shape[1] or c >= labels.shape[2]:
                continue
            other = labels[a, b, c]
            if other < 0 or other == labels[i, j, k] or other == last:
                continue
            if count == len(pairs):
                pairs = np.concatenate((pairs, np.empty_like(pairs)))
            pairs[count, 0], pairs[count, 1] = labels[i, j, k], other
            count += 1
            last = other
    return pairs[:count]


@compiled()
def _merge(voxels, first, second, pairs, merge_d2):  # noqa: ANN001, ANN202
    """Root of each group: a group that touches a better one nearby is absorbed by the best such, and so on upwards.

    Better means greater in the `first` measure, then in the `second`, then earlier. The rule looks at neighbours only,
    so what happens far away never changes who absorbs whom.
    """
    parent = np.arange(len(voxels))
    for n in range(len(pairs)):
        one, two = pairs[n, 0], pairs[n, 1]
        dx, dy, dz = voxels[one] - voxels[two]
        if dx * dx + dy * dy + dz * dz > merge_d2:
            continue
        worse, better = one, two
        if (first[one], second[one], -one) > (first[two], second[two], -two):
            worse, better = two, one
        best = parent[worse]
        if best == worse or (first[better], second[better], -better) > (first[best], second[best], -best):
            parent[worse] = better
    for n in range(len(parent)):
        while parent[parent[n]] != parent[n]:
            parent[n] = parent[parent[n]]
    return parent

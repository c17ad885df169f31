"""From GVD voxels to places: compression cells, representatives, merging (Hydra, `graph_extractor`; pure).

Hydra's representative is the voxel with most basis points, a count that changes with every shift of the grid. The
middle of the group stays: a group that wins or loses a voxel at its edge has nearly the same middle. Whether a middle
is a place of its own depends on the group's shadow on a face of its cell, which is the same for a sheet one voxel thick
and for one of two. Comparing every group with its neighbours instead would turn with a voxel of each of them.

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
SMALL = 0.4  # share of a cell's face: a group that covers less may be absorbed
ANYWHERE = np.inf
Policy = Literal["middle", "basis_points", "distance"]


@dataclass(frozen=True)
class Extraction:
    """Places of one box, in the order of their voxels. A group is a connected set of GVD voxels in one cell."""

    voxels: np.ndarray  # (place, 3) int64, world voxel index of the representative
    shifts: np.ndarray  # (place, 3) int64, from the centre of that voxel to the place, SHIFT_UNITS to a voxel
    # Of the places of the region that was asked for; of others `d2` is their voxel's.
    d2: np.ndarray  # (place,) float64, squared voxels to the nearest obstacle that observed space leads to, exact
    free_d2: np.ndarray  # (place,) float64, the same to any known obstacle at most LOOK_CELLS away, else d2
    basis: np.ndarray  # (place,) int64
    touching: np.ndarray  # (pair, 2) int64, places whose voxels touch, smaller first, sorted
    members: np.ndarray  # window of int32: place index of a member voxel, -1 elsewhere
    field_d2: np.ndarray  # window of int16: the grid's squared distances
    box: Box  # where both windows lie

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
    # ... that of the larger group, if the other is SMALL. And a group's place is its middle; or, as in Hydra, the voxel
    # with most basis points or the widest, which absorbs as well.
    policy: Policy = "basis_points"


def extract(grid: VoxelGrid, box: Box, rules: ExtractionRules, region: Box | None = None) -> Extraction:
    """Places of all cells inside `box`, which must consist of whole cells; the grid's GVD must be up to date.

    Exact distances are found for those in `region` only; it is all of the box unless given.
    """
    basis, d2, label = grid.gather_all({"basis": 0, "d2": UNKNOWN_D2, "label": 0}, box)
    members = _member_voxels(basis, d2, rules.min_radius**2)
    labels = np.full(basis.shape, -1, np.int32)
    cells = [np.floor_divide(low + np.arange(size), rules.cell) for low, size in zip(box.low, box.shape, strict=True)]
    sizes = _grow_groups(members, labels, *cells)
    groups = len(sizes)
    if rules.policy == "middle":
        chosen, shifts = _middles(members, labels, sizes)
    else:
        chosen, shifts = _bests(members, labels, d2, basis, groups), np.zeros((groups, 3), np.int64)
    local = members[chosen]
    group_d2, group_basis = d2[tuple(local.T)].astype(np.int64), basis[tuple(local.T)].astype(np.int64)
    if rules.policy == "middle":
        covered = _shadows(members, labels, groups, rules.cell)
        ranks, within2 = (covered, sizes), _reaches2(covered, rules)
    else:
        ranks = (group_basis, group_d2) if rules.policy == "basis_points" else (group_d2, group_basis)
        within2 = np.full(groups, rules.merge**2)
    pairs = _unique_pairs(_touching(members, labels, groups), groups)
    root = _merge(local * SHIFT_UNITS + shifts, *ranks, pairs, within2 * SHIFT_UNITS**2)
    kept = np.flatnonzero((root == np.arange(groups)) & (within2 < ANYWHERE))
    index = np.full(groups, -1, np.int64)
    index[kept] = np.arange(len(kept))
    place_of = index[root] if groups else index
    _relabel(members, labels, place_of)
    linked = place_of[pairs]
    touching = _unique_pairs(linked[(linked >= 0).all(axis=1)], groups)
    local, shifts, clear_d2 = local[kept], shifts[kept], group_d2[kept].astype(np.float64)
    region = box if region is None else region
    wanted = region.contains(local + box.low)
    if shifts[wanted].any():
        beside = region.grown(1).clipped(box)
        offset, low = grid.gather("offset", beside), beside.low - box.low
        _between_voxels(d2, offset, low, local, wanted, shifts, clear_d2, rules.min_radius**2)
    free_d2 = clear_d2.copy()
    _look_around(label, local, wanted, shifts, free_d2, LOOK_CELLS * rules.cell)
    return Extraction(local + box.low, shifts, clear_d2, free_d2, group_basis[kept], touching, labels, d2, box)


def _member_voxels(basis: np.ndarray, d2: np.ndarray, min_d2: float) -> np.ndarray:
    """GVD voxels (n, 3) with room enough around them, in ascending order."""
    return _roomy(np.flatnonzero(basis.reshape(-1) > 0), d2, min_d2)


@compiled()
def _roomy(flat, d2, min_d2):  # noqa: ANN001, ANN202
    """Those of the voxels of a window, given by their number (n,), that have a distance of `min_d2`, as (m, 3)."""
    found, count = np.empty((len(flat), 3), np.int64), 0
    ny, nz = d2.shape[1], d2.shape[2]
    for voxel in flat:
        i, j, k = voxel // (ny * nz), (voxel // nz) % ny, voxel % nz
        if d2[i, j, k] >= min_d2:
            found[count, 0], found[count, 1], found[count, 2] = i, j, k
            count += 1
    return found[:count]


def _unique_pairs(pairs: np.ndarray, count: int) -> np.ndarray:
    """Pairs (n, 2) of different indices below `count`, smaller first, sorted, once each."""
    one, two = pairs[pairs[:, 0] != pairs[:, 1]].T
    keys = np.sort(np.minimum(one, two) * count + np.maximum(one, two))
    first = np.ones(len(keys), np.bool_)
    first[1:] = keys[1:] != keys[:-1]
    return np.stack(np.divmod(keys[first], max(count, 1)), axis=1)


@compiled()
def _grow_groups(members, labels, cells_x, cells_y, cells_z):  # noqa: ANN001, ANN202
    """Label each 26-connected set of members inside one cell (-2: not reached yet); return the members of each.

    The cells are those of the window's voxels along each axis.
    """
    for n in range(len(members)):
        labels[members[n, 0], members[n, 1], members[n, 2]] = -2
    stack = np.empty((len(members), 3), np.int64)
    sizes = np.zeros(len(members), np.int64)
    groups = 0
    for n in range(len(members)):
        if labels[members[n, 0], members[n, 1], members[n, 2]] != -2:
            continue
        labels[members[n, 0], members[n, 1], members[n, 2]] = groups
        stack[0] = members[n]
        depth = 1
        while depth > 0:
            depth -= 1
            sizes[groups] += 1
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
    return sizes[:groups]


@compiled()
def _relabel(members, labels, place_of):  # noqa: ANN001, ANN202
    """Give members the number of their place in place of their group's."""
    for n in range(len(members)):
        i, j, k = members[n, 0], members[n, 1], members[n, 2]
        labels[i, j, k] = place_of[labels[i, j, k]]


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
    chosen, sums = _nearest_to_mean(members, labels, sizes)
    shifts = (sums - members[chosen] * sizes[:, None]) * SHIFT_UNITS // np.maximum(sizes, 1)[:, None]
    return chosen, np.clip(shifts, -SHIFT_UNITS // 2, SHIFT_UNITS // 2)


def _reaches2(covered: np.ndarray, rules: ExtractionRules) -> np.ndarray:
    """Squared distance (groups,) within which a larger group absorbs each, by the voxels of a face that it covers.

    Less than a line through the cell are pockets, which come and go with every shift of the grid: ANYWHERE.
    """
    reaches2 = np.where(covered < SMALL * rules.cell**2, rules.merge**2, 0.0)
    reaches2[covered < rules.cell] = ANYWHERE
    return reaches2


@compiled()
def _shadows(members, labels, groups, cell):  # noqa: ANN001, ANN202
    """Voxels (groups,) of a face of its cell that each group covers, of the face of which it covers most."""
    seen = np.zeros((groups, 3, cell * cell), np.bool_)
    covered = np.zeros((groups, 3), np.int64)
    for n in range(len(members)):
        group = labels[members[n, 0], members[n, 1], members[n, 2]]
        a, b, c = members[n, 0] % cell, members[n, 1] % cell, members[n, 2] % cell
        for face, spot in enumerate((b * cell + c, a * cell + c, a * cell + b)):
            covered[group, face] += not seen[group, face, spot]
            seen[group, face, spot] = True
    most = np.zeros(groups, np.int64)
    for group in range(groups):
        most[group] = covered[group].max()
    return most


@compiled()
def _nearest_to_mean(members, labels, sizes):  # noqa: ANN001, ANN202
    """Per group the index of the member nearest to the mean of all, the first of equal ones, and the sum of them."""
    sums = np.zeros((len(sizes), 3), np.int64)
    for n in range(len(members)):
        i, j, k = members[n]
        group = labels[i, j, k]
        sums[group, 0] += i
        sums[group, 1] += j
        sums[group, 2] += k
    chosen, nearest = np.zeros(len(sizes), np.int64), np.full(len(sizes), -1, np.int64)
    for n in range(len(members)):
        i, j, k = members[n]
        group = labels[i, j, k]
        size = sizes[group]
        x, y, z = i * size - sums[group, 0], j * size - sums[group, 1], k * size - sums[group, 2]
        apart2 = x * x + y * y + z * z
        if nearest[group] < 0 or apart2 < nearest[group]:
            chosen[group], nearest[group] = n, apart2
    return chosen, sums


@compiled()
def _between_voxels(d2, offset, low, voxels, wanted, shifts, clear_d2, least_d2):  # noqa: ANN001, ANN202, PLR0917
    """Set the squared distance (place,) of the `wanted` places off their voxels (n, 3) by `shifts` to the nearest
    obstacle.

    Of the obstacles that a voxel and its neighbours are nearest to. A place with too little room stays on its voxel.
    `offset` begins at the voxel `low` of the window and holds the neighbours of what is wanted.
    """
    for n in range(len(voxels)):
        if not wanted[n]:
            continue
        best = np.int64(1 << 40)
        for dx in (-1, 0, 1):
            for dy in (-1, 0, 1):
                for dz in (-1, 0, 1):
                    a, b, c = voxels[n, 0] + dx, voxels[n, 1] + dy, voxels[n, 2] + dz
                    if a < 0 or b < 0 or c < 0 or a >= d2.shape[0] or b >= d2.shape[1] or c >= d2.shape[2]:
                        continue
                    if d2[a, b, c] < 0 or d2[a, b, c] == FAR_D2:
                        continue
                    e, f, g = a - low[0], b - low[1], c - low[2]
                    x = (np.int64(offset[e, f, g, 0]) - dx) * SHIFT_UNITS + shifts[n, 0]
                    y = (np.int64(offset[e, f, g, 1]) - dy) * SHIFT_UNITS + shifts[n, 1]
                    z = (np.int64(offset[e, f, g, 2]) - dz) * SHIFT_UNITS + shifts[n, 2]
                    best = min(best, x * x + y * y + z * z)
        if best >= least_d2 * SHIFT_UNITS**2:
            clear_d2[n] = best / SHIFT_UNITS**2
        else:
            shifts[n] = 0


@compiled()
def _look_around(label, voxels, wanted, shifts, free_d2, farthest):  # noqa: ANN001, ANN202, PLR0917
    """Lower `free_d2` (place,) of the `wanted` places to the squared distance of the nearest obstacle within it and
    within `farthest`.
    """
    for n in range(len(voxels)):
        if not wanted[n]:
            continue
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
def _touching(members, labels, groups):  # noqa: ANN001, ANN202
    """Pairs of group labels with neighbouring voxels (26-neighbourhood), smaller first, with repeats."""
    pairs = np.empty((16 * groups + 16, 2), np.int64)
    last = np.full(groups, -1, np.int64)  # with which greater one each was paired last
    count = 0
    for n in range(len(members)):
        i, j, k = members[n]
        for s in range(13, 26):  # the other half of the neighbours sees the pair from its side
            a, b, c = i + STEPS[s, 0], j + STEPS[s, 1], k + STEPS[s, 2]
            if a < 0 or b < 0 or c < 0 or a >= labels.shape[0] or b >= labels.shape[1] or c >= labels.shape[2]:
                continue
            one, two = min(labels[i, j, k], labels[a, b, c]), max(labels[i, j, k], labels[a, b, c])
            if one < 0 or one == two or last[one] == two:
                continue
            if count == len(pairs):
                pairs = np.concatenate((pairs, np.empty_like(pairs)))
            pairs[count, 0], pairs[count, 1] = one, two
            count += 1
            last[one] = two
    return pairs[:count]


@compiled()
def _merge(spots, first, second, pairs, within2):  # noqa: ANN001, ANN202
    """Root of each group: a group that touches a better one nearby is absorbed by the best such, and so on upwards.

    Better means greater in the `first` measure, then in the `second`, then earlier. Nearby means that their `spots`
    (group, 3) are at most the worse one's squared distance `within2` (group,) apart; where that is ANYWHERE, a group is
    no place and absorbs none. The rule looks at neighbours only: what happens far away never changes who absorbs whom.
    """
    parent = np.arange(len(spots))
    for n in range(len(pairs)):
        one, two = pairs[n, 0], pairs[n, 1]
        worse, better = one, two
        if (first[one], second[one], -one) > (first[two], second[two], -two):
            worse, better = two, one
        dx, dy, dz = spots[one] - spots[two]
        if dx * dx + dy * dy + dz * dz > within2[worse] or within2[better] == ANYWHERE:
            continue
        best = parent[worse]
        if best == worse or (first[better], second[better], -better) > (first[best], second[best], -best):
            parent[worse] = better
    for n in range(len(parent)):
        while parent[parent[n]] != parent[n]:
            parent[n] = parent[parent[n]]
    return parent

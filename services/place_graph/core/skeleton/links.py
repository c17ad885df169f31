"""Edges between places: clear straight lines, weighted by their clearance (pure).

Two kinds of pairs may become an edge: places whose GVD voxels touch (Hydra's edges), and places that see each other
across free space nearby (Hydra's heuristic "freespace" edges). Of the second kind only those stay for which no third
place is nearer to both: a relative neighbourhood graph. It needs no notion of a largest component, so an edge depends
on its surroundings only, and it joins whatever the clear lines join (it contains their minimum spanning tree).
"""

import numpy as np

from prior_sg.services.compiled import compiled
from prior_sg.services.place_graph.core.volume.grid import FAR_D2

WITNESS = 3**0.5  # a point nearer to both ends of a line than these to each other, from its middle, in half lengths


@compiled()
def line_d2(d2, start, stop):  # noqa: ANN001, ANN201
    """Smallest squared distance (voxels) along the straight line between two voxels of a window, both ends included.

    0 where the line meets an obstacle, -1 where it leaves observed space or the window.
    """
    steps = 0
    for axis in range(3):
        steps = max(steps, abs(stop[axis] - start[axis]))
    lowest = FAR_D2
    for n in range(steps + 1):
        share = n / steps if steps else 0.0
        i = int(np.floor(start[0] + (stop[0] - start[0]) * share + 0.5))
        j = int(np.floor(start[1] + (stop[1] - start[1]) * share + 0.5))
        k = int(np.floor(start[2] + (stop[2] - start[2]) * share + 0.5))
        if i < 0 or j < 0 or k < 0 or i >= d2.shape[0] or j >= d2.shape[1] or k >= d2.shape[2]:
            return -1
        lowest = min(lowest, d2[i, j, k])
        if lowest <= 0:
            return lowest
    return lowest


@compiled()
def near_pairs(old, new, cell):  # noqa: ANN001, ANN201
    """Places (n, 3) and (m, 3) in one cell or at most a cell's side apart: (pair, 3) squared distance, row of each."""
    found, count = np.empty((8 * len(new) + 16, 3), np.int64), 0
    for one in range(len(old)):
        for two in range(len(new)):
            x, y, z = old[one, 0] - new[two, 0], old[one, 1] - new[two, 1], old[one, 2] - new[two, 2]
            squared = x * x + y * y + z * z
            if squared > cell * cell and not (
                max(abs(x), abs(y), abs(z)) < cell
                and old[one, 0] // cell == new[two, 0] // cell
                and old[one, 1] // cell == new[two, 1] // cell
                and old[one, 2] // cell == new[two, 2] // cell
            ):
                continue
            if count == len(found):
                found = np.concatenate((found, np.empty_like(found)))
            found[count, 0], found[count, 1], found[count, 2] = squared, one, two
            count += 1
    return found[:count]


@compiled()
def clear_lines(d2, voxels, touching, edge_d2, reach_d2, free_d2):  # noqa: ANN001, ANN201, PLR0917
    """Squared clearance (n, n) of the admissible lines between places (n, 3) of a window; 0 = no line.

    Lines between touching places (n, n bool) need `edge_d2`, others need `free_d2` and at most `reach_d2` of length.
    """
    count = len(voxels)
    clear = np.zeros((count, count), np.int32)
    for one in range(count):
        for two in range(one + 1, count):
            clear[one, two] = clear[two, one] = _line(d2, voxels, touching, one, two, edge_d2, reach_d2, free_d2)
    return clear


@compiled()
def _line(d2, voxels, touching, one, two, edge_d2, reach_d2, free_d2):  # noqa: ANN001, ANN202, PLR0917
    """Squared clearance of the line between two places, 0 if it is not admissible; see `clear_lines`."""
    near = _squared(voxels, one, two) <= reach_d2
    if not (near or touching[one, two]):
        return 0
    lowest = line_d2(d2, voxels[one], voxels[two])
    return lowest if (touching[one, two] and lowest >= edge_d2) or (near and lowest >= free_d2) else 0


@compiled()
def _squared(voxels, one, two):  # noqa: ANN001, ANN202
    dx, dy, dz = voxels[one, 0] - voxels[two, 0], voxels[one, 1] - voxels[two, 1], voxels[one, 2] - voxels[two, 2]
    return dx * dx + dy * dy + dz * dz


@compiled()
def concerned(voxels, pairs, low, high, reach_d2, margin):  # noqa: ANN001, ANN201, PLR0917
    """Which pairs (n, 2) of places a change inside the box from `low` to `high` may join or part; see `_concerns`."""
    found = np.empty(len(pairs), np.bool_)
    for n in range(len(pairs)):
        found[n] = _concerns(voxels, pairs[n, 0], pairs[n, 1], low, high, reach_d2, margin)
    return found


@compiled()
def _concerns(voxels, one, two, low, high, reach_d2, margin):  # noqa: ANN001, ANN202, PLR0917
    """Whether an end or a witness of a pair may lie in a box, or its line meet it.

    Witnesses against a line are nearer to both ends than these to each other, hence within a ball around its middle.
    With a `margin` instead: whether an end lies in the box, or both ends lie within the margin of it.
    """
    length2 = _squared(voxels, one, two)
    around = 0.5 * WITNESS * np.sqrt(float(length2)) if length2 <= reach_d2 else 0.0
    one_in = two_in = one_near = two_near = meets = True
    for axis in range(3):
        a, b = voxels[one, axis], voxels[two, axis]
        one_in = one_in and low[axis] <= a < high[axis]
        two_in = two_in and low[axis] <= b < high[axis]
        one_near = one_near and low[axis] - margin <= a < high[axis] + margin
        two_near = two_near and low[axis] - margin <= b < high[axis] + margin
        first = min(a, b, 0.5 * (a + b) - around)
        last = max(a, b, 0.5 * (a + b) + around)
        meets = meets and first < high[axis] and last >= low[axis]
    return one_in or two_in or (one_near and two_near if margin else meets)


@compiled()
def joined(d2, voxels, touching, low, high, edge_d2, reach_d2, free_d2):  # noqa: ANN001, ANN201, PLR0917
    """Edges (edge, 2) of places (n, 3), smaller first, sorted, and their squared clearance (edge,).

    Only those that a change in the box from `low` to `high` concerns. Clear lines are those of `clear_lines`, and stay
    as edges as in `thinned`; only lines that may be edges, or witness against one, are looked at.
    """
    count = len(voxels)
    starts = np.zeros(count + 1, np.int64)
    beside = np.empty(16 * count + 16, np.int64)
    fill = 0
    for one in range(count):
        for two in range(count):
            if two != one and (touching[one, two] or _squared(voxels, one, two) <= reach_d2):
                if fill == len(beside):
                    beside = np.concatenate((beside, np.empty_like(beside)))
                beside[fill] = two
                fill += 1
        starts[one + 1] = fill
    known = np.full((count, count), -1, np.int32)  # clearance of the lines looked at
    pairs, clearances, found = np.empty((fill // 2 + 1, 2), np.int64), np.empty(fill // 2 + 1, np.int64), 0
    for one in range(count):
        for two in beside[starts[one] : starts[one + 1]]:
            if two < one or not _concerns(voxels, one, two, low, high, reach_d2, 0):
                continue
            if known[one, two] < 0:
                line = _line(d2, voxels, touching, one, two, edge_d2, reach_d2, free_d2)
                known[one, two] = known[two, one] = line
            stays = known[one, two] > 0
            if stays and not (touching[one, two] and known[one, two] >= edge_d2):
                length = _squared(voxels, one, two)
                for third in beside[starts[one] : starts[one + 1]]:
                    if _squared(voxels, one, third) >= length or _squared(voxels, third, two) >= length:
                        continue
                    for end in (one, two):
                        if known[end, third] < 0:
                            line = _line(d2, voxels, touching, end, third, edge_d2, reach_d2, free_d2)
                            known[end, third] = known[third, end] = line
                    if known[one, third] > 0 and known[third, two] > 0:
                        stays = False
                        break
            if stays:
                pairs[found, 0], pairs[found, 1], clearances[found] = one, two, known[one, two]
                found += 1
    return pairs[:found], clearances[:found]


@compiled()
def thinned(clear, voxels, touching, edge_d2):  # noqa: ANN001, ANN201
    """Which clear lines (n, n) stay as edges: of touching places, or with no third place nearer to both."""
    count = len(voxels)
    keep = np.zeros((count, count), np.bool_)
    length = np.zeros((count, count), np.int64)
    for one in range(count):
        for two in range(count):
            dx, dy, dz = voxels[one] - voxels[two]
            length[one, two] = dx * dx + dy * dy + dz * dz
    for one in range(count):
        for two in range(one + 1, count):
            if clear[one, two] <= 0:
                continue
            stays = touching[one, two] and clear[one, two] >= edge_d2
            if not stays:
                stays = True
                for third in range(count):
                    if (
                        clear[one, third] > 0
                        and clear[third, two] > 0
                        and length[one, third] < length[one, two]
                        and length[third, two] < length[one, two]
                    ):
                        stays = False
                        break
            keep[one, two] = stays
    return keep


def nearest(mask: np.ndarray, voxels: np.ndarray, limit: int) -> np.ndarray:
    """Pairs (n, n) of `mask` in which either is among the `limit` nearest of the other's pairs; 0 = all."""
    if not limit:
        return mask
    mask = mask | mask.T
    length = ((voxels[:, None] - voxels[None]) ** 2).sum(axis=2).astype(float)
    length[~mask] = np.inf
    np.fill_diagonal(length, np.inf)
    farthest = np.sort(length, axis=1)[:, min(limit, len(voxels)) - 1 : min(limit, len(voxels))]
    near = mask & (length <= farthest) & np.isfinite(length)
    return near | near.T


@compiled()
def lenses(d2, voxels, radii, smallest, reach):  # noqa: ANN001, ANN201
    """Squared radius (n, n) of the lens that two spheres share, or of the smaller one if it lies in the other.

    0 where it is smaller than `smallest`, the centres are farther apart than `reach`, or do not see each other.
    """
    count = len(voxels)
    found = np.zeros((count, count), np.int32)
    for one in range(count):
        for two in range(one + 1, count):
            dx, dy, dz = voxels[one] - voxels[two]
            apart = np.sqrt(float(dx * dx + dy * dy + dz * dz))
            r, s = radii[one], radii[two]
            if apart >= r + s or apart > reach:
                continue
            if apart <= abs(r - s):
                lens = min(r, s)
            else:
                along = (apart * apart - s * s + r * r) / (2 * apart)
                lens = np.sqrt(max(0.0, r * r - along * along))
            if lens >= smallest and line_d2(d2, voxels[one], voxels[two]) > 0:
                found[one, two] = found[two, one] = int(lens * lens + 0.5)
    return found

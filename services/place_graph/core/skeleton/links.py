"""Edges between places: clear straight lines, weighted by their clearance (pure).

Two kinds of pairs may become an edge: places whose GVD voxels touch (Hydra's edges), and places that see each other
across free space nearby (Hydra's heuristic "freespace" edges). Of the second kind only those stay for which no third
place is nearer to both: a relative neighbourhood graph. It needs no notion of a largest component, so an edge depends
on its surroundings only, and it joins whatever the clear lines join (it contains their minimum spanning tree).
"""

import numpy as np

from prior_sg.services.compiled import compiled
from prior_sg.services.place_graph.core.volume.grid import FAR_D2


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
def clear_lines(d2, voxels, touching, edge_d2, reach_d2, free_d2):  # noqa: ANN001, ANN201, PLR0917
    """Squared clearance (n, n) of the admissible lines between places (n, 3) of a window; 0 = no line.

    Lines between touching places (n, n bool) need `edge_d2`, others need `free_d2` and at most `reach_d2` of length.
    """
    count = len(voxels)
    clear = np.zeros((count, count), np.int32)
    for one in range(count):
        for two in range(one + 1, count):
            dx, dy, dz = voxels[one] - voxels[two]
            near = dx * dx + dy * dy + dz * dz <= reach_d2
            if not (near or touching[one, two]):
                continue
            lowest = line_d2(d2, voxels[one], voxels[two])
            if (touching[one, two] and lowest >= edge_d2) or (near and lowest >= free_d2):
                clear[one, two] = clear[two, one] = lowest
    return clear


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

"""Which voxels one can stand on, what of them hangs together, and where one falls (pure)."""

import numpy as np

from prior_sg.services.compiled import compiled
from prior_sg.services.place_graph.core.volume.grid import FREE, OCCUPIED, UNOBSERVED

EDGE_VOXELS = 3  # how far beside an edge one looks for what lies below
OPEN, FALL = 1, 2  # what an edge of ground may be


@compiled()
def ground_voxels(label, clearance, step, slope):  # noqa: ANN001, ANN201
    """Which voxels of a window are ground: obstacles under free height, level enough with those around them."""
    nx, ny, nz = label.shape
    standing = np.zeros(label.shape, np.bool_)
    for i in range(nx):
        for j in range(ny):
            for k in range(nz - 1):
                if label[i, j, k] == OCCUPIED and label[i, j, k + 1] == FREE:
                    standing[i, j, k] = True
                    for above in range(k + 2, min(nz, k + 1 + clearance)):
                        if label[i, j, above] == OCCUPIED:
                            standing[i, j, k] = False
                            break
    ground = np.zeros(label.shape, np.bool_)
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                if standing[i, j, k]:
                    rise_x = _rise(standing, i, j, k, 1, 0, step)
                    rise_y = _rise(standing, i, j, k, 0, 1, step)
                    ground[i, j, k] = rise_x * rise_x + rise_y * rise_y <= slope * slope
    return ground


@compiled()
def _rise(standing, i, j, k, dx, dy, step):  # noqa: ANN001, ANN202, PLR0917
    """Rise over run along an axis: over two voxels to either side, as far as small steps lead.

    Both ends are rounded, so that a voxel of rise may be none: even stairs rise by steps of one voxel and of two.
    """
    ends = np.zeros(2, np.int64)
    run = 0
    for side in (-1, 1):
        height = k
        for n in (1, 2):
            a, b = i + side * n * dx, j + side * n * dy
            found = -1
            if 0 <= a < standing.shape[0] and 0 <= b < standing.shape[1]:
                for rise in range(step + 1):
                    for sign in (-1, 1):
                        c = height + sign * rise
                        if found < 0 and 0 <= c < standing.shape[2] and standing[a, b, c]:
                            found = c
            if found < 0:
                break
            height = found
            run += 1
        ends[(side + 1) // 2] = height
    return max(abs(ends[1] - ends[0]) - 1, 0) / run if run else 0.0


@compiled()
def connected(ground, step):  # noqa: ANN001, ANN201
    """Number of the connected part of each ground voxel (-1 elsewhere), by steps to the four sides; how many parts."""
    nx, ny, nz = ground.shape
    parts = np.full(ground.shape, -1, np.int64)
    stack = np.empty((ground.size, 3), np.int64)
    count = 0
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                if not ground[i, j, k] or parts[i, j, k] >= 0:
                    continue
                parts[i, j, k] = count
                stack[0, 0], stack[0, 1], stack[0, 2] = i, j, k
                depth = 1
                while depth > 0:
                    depth -= 1
                    x, y, z = stack[depth]
                    for side in range(4):
                        a = x + (side == 0) - (side == 1)
                        b = y + (side == 2) - (side == 3)
                        if a < 0 or b < 0 or a >= nx or b >= ny:
                            continue
                        for c in range(max(0, z - step), min(nz, z + step + 1)):
                            if ground[a, b, c] and parts[a, b, c] < 0:
                                parts[a, b, c] = count
                                stack[depth, 0], stack[depth, 1], stack[depth, 2] = a, b, c
                                depth += 1
                count += 1
    return parts, count


@compiled()
def edge_of(label, parts, count, step):  # noqa: ANN001, ANN201
    """Of how many edges of each part's voxels one falls by more than a step, and how many do not end at a wall."""
    nx, ny, nz = label.shape
    falls, edges = np.zeros(count, np.int64), np.zeros(count, np.int64)
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                part = parts[i, j, k]
                if part < 0:
                    continue
                for side in range(4):
                    found = _beside(label, parts, i, j, k, side, step)
                    edges[part] += found > 0
                    falls[part] += found == FALL
    return falls, edges


@compiled()
def _beside(label, parts, i, j, k, side, step):  # noqa: ANN001, ANN202, PLR0917
    """What the edge of a voxel is, on one of its four sides: 0 = no edge, or a wall; OPEN, or FALL."""
    nx, ny, nz = label.shape
    found = 0
    for n in range(1, EDGE_VOXELS + 1):
        a = i + n * (side == 0) - n * (side == 1)
        b = j + n * (side == 2) - n * (side == 3)
        if a < 0 or b < 0 or a >= nx or b >= ny:
            return found
        for c in range(max(0, k - step), min(nz, k + step + 1)):
            if parts[a, b, c] == parts[i, j, k]:
                return 0
        for c in range(k + 1, min(nz, k + 1 + EDGE_VOXELS)):
            if label[a, b, c] == OCCUPIED:
                return 0
        found = OPEN
        for c in range(k, -1, -1):
            if label[a, b, c] == UNOBSERVED:
                break
            if label[a, b, c] == OCCUPIED:
                if c < k - step:
                    return FALL
                break
    return found

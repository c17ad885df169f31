"""Distance to the nearest obstacle, measured through observed space only, and the Voronoi diagram it induces (pure).

After Lau, Sprunk and Burgard (2013), as used by Hydra. Every obstacle sends a wave; a wave enters observed free voxels
only, and never turns back toward its obstacle, so it does not bend around what was not observed. Distances along a wave
therefore grow strictly, voxels are settled in order of distance, and ties are broken by the obstacle's coordinates: the
result does not depend on the order of work or on the window it is computed in.
"""

import numpy as np
from numba import njit

from services.place_graph.grid import FAR_D2, FREE, OCCUPIED, UNKNOWN_D2, Box, VoxelGrid

RIM = 2  # voxels around the recomputed box: one for the GVD of its neighbours, one more for theirs
MAX_BASIS_POINTS = 8
STEPS = np.array(
    [(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) != (0, 0, 0)], np.int64
)


def refresh(
    grid: VoxelGrid,
    changed: Box,
    *,
    max_distance_voxels: float,
    voronoi_min_voxels: float,
    parent_l1_voxels: float,
    parent_cos: float,
) -> Box:
    """Bring distances and GVD up to date after labels changed inside `changed`; return the box that was recomputed.

    A changed voxel acts at most the maximal distance away. The field outside that reach is right already, and enters as
    the boundary from which its waves come in.
    """
    box = changed.grown(int(np.ceil(max_distance_voxels))).clipped(grid.bounds)
    window = box.grown(RIM)
    label = grid.gather("label", window)
    d2 = grid.gather("d2", window, UNKNOWN_D2).astype(np.int32)
    offset = grid.gather("offset", window)
    basis = grid.gather("basis", window)
    spread(label, d2, offset, RIM, int(np.floor(max_distance_voxels**2)))
    voronoi(label, d2, offset, basis, voronoi_min_voxels**2, parent_l1_voxels, parent_cos)
    for name, values in (("d2", d2.astype(np.int16)), ("offset", offset), ("basis", basis)):
        grid.scatter(name, window, values)
    return box.grown(1)


@njit(cache=True, nogil=True)
def spread(label, d2, offset, rim, max_d2):  # noqa: ANN001, ANN201
    """Recompute `d2` (int32) and `offset` (voxel minus obstacle) of a window in place, except for its `rim`.

    Rim voxels keep their values and act as sources.
    """
    nx, ny, nz = label.shape
    head = np.full(max_d2 + 1, -1, np.int64)
    entry_voxel = np.empty(label.size + 1024, np.int64)
    entry_next = np.empty(label.size + 1024, np.int64)
    entries = 0
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                fixed = i < rim or j < rim or k < rim or i >= nx - rim or j >= ny - rim or k >= nz - rim
                if not fixed:
                    offset[i, j, k, :] = 0
                    if label[i, j, k] == OCCUPIED:
                        d2[i, j, k] = 0
                    else:
                        d2[i, j, k] = FAR_D2 if label[i, j, k] == FREE else UNKNOWN_D2
                if 0 <= d2[i, j, k] <= max_d2 and (d2[i, j, k] == 0 or fixed):
                    level = d2[i, j, k]
                    entry_voxel[entries] = (i * ny + j) * nz + k
                    entry_next[entries] = head[level]
                    head[level] = entries
                    entries += 1
    for level in range(max_d2 + 1):
        entry = head[level]
        while entry >= 0:
            voxel = entry_voxel[entry]
            entry = entry_next[entry]
            k = voxel % nz
            j = (voxel // nz) % ny
            i = voxel // (nz * ny)
            if d2[i, j, k] != level:
                continue
            ox = np.int64(offset[i, j, k, 0])
            oy = np.int64(offset[i, j, k, 1])
            oz = np.int64(offset[i, j, k, 2])
            for dx in range(-1 if ox <= 0 else 0, 2 if ox >= 0 else 1):
                a = i + dx
                if a < rim or a >= nx - rim:
                    continue
                for dy in range(-1 if oy <= 0 else 0, 2 if oy >= 0 else 1):
                    b = j + dy
                    if b < rim or b >= ny - rim:
                        continue
                    for dz in range(-1 if oz <= 0 else 0, 2 if oz >= 0 else 1):
                        c = k + dz
                        if c < rim or c >= nz - rim or label[a, b, c] != FREE:
                            continue
                        px, py, pz = ox + dx, oy + dy, oz + dz
                        reach = px * px + py * py + pz * pz
                        known = d2[a, b, c]
                        if reach > max_d2 or reach > known:
                            continue
                        if reach == known:
                            qx, qy, qz = offset[a, b, c, 0], offset[a, b, c, 1], offset[a, b, c, 2]
                            if (px, py, pz) <= (np.int64(qx), np.int64(qy), np.int64(qz)):
                                continue
                        offset[a, b, c, 0] = px
                        offset[a, b, c, 1] = py
                        offset[a, b, c, 2] = pz
                        if reach < known:
                            d2[a, b, c] = reach
                            if entries == entry_voxel.size:
                                entry_voxel = np.concatenate((entry_voxel, np.empty_like(entry_voxel)))
                                entry_next = np.concatenate((entry_next, np.empty_like(entry_next)))
                            entry_voxel[entries] = (a * ny + b) * nz + c
                            entry_next[entries] = head[reach]
                            head[reach] = entries
                            entries += 1


@njit(cache=True, nogil=True)
def distinct(px, py, pz, qx, qy, qz, l1, cosine):  # noqa: ANN001, ANN201, PLR0917
    """Whether two obstacles, given by their offsets from one voxel, count as different basis points (L1 or angle)."""
    if abs(px - qx) + abs(py - qy) + abs(pz - qz) > l1:
        return True
    dot = px * qx + py * qy + pz * qz
    return dot < cosine * np.sqrt(float((px * px + py * py + pz * pz) * (qx * qx + qy * qy + qz * qz)))


@njit(cache=True, nogil=True)
def _on_gvd(label, d2, offset, i, j, k, min_d2, l1, cosine):  # noqa: ANN001, ANN202, PLR0917
    """Whether a wave front stops here: a face neighbour has a distinct obstacle that is about as near to this voxel."""
    ox, oy, oz = np.int64(offset[i, j, k, 0]), np.int64(offset[i, j, k, 1]), np.int64(offset[i, j, k, 2])
    for axis in range(3):
        for side in (-1, 1):
            dx = side if axis == 0 else 0
            dy = side if axis == 1 else 0
            dz = side if axis == 2 else 0
            a, b, c = i + dx, j + dy, k + dz
            if label[a, b, c] != FREE or d2[a, b, c] == FAR_D2 or d2[a, b, c] <= min_d2:
                continue
            qx, qy, qz = np.int64(offset[a, b, c, 0]), np.int64(offset[a, b, c, 1]), np.int64(offset[a, b, c, 2])
            mine_x, mine_y, mine_z = qx - dx, qy - dy, qz - dz  # the neighbour's obstacle seen from here
            if not distinct(ox, oy, oz, mine_x, mine_y, mine_z, l1, cosine):
                continue
            here = mine_x * mine_x + mine_y * mine_y + mine_z * mine_z
            there = (ox + dx) ** 2 + (oy + dy) ** 2 + (oz + dz) ** 2
            if here <= there:
                return True
    return False


@njit(cache=True, nogil=True)
def _basis_points(label, d2, offset, i, j, k, l1, cosine):  # noqa: ANN001, ANN202, PLR0917
    """One plus the number of mutually distinct further obstacles of the 26 neighbours."""
    found = np.empty((MAX_BASIS_POINTS, 3), np.int64)
    found[0, 0], found[0, 1], found[0, 2] = offset[i, j, k, 0], offset[i, j, k, 1], offset[i, j, k, 2]
    count = 1
    for s in range(26):
        dx, dy, dz = STEPS[s, 0], STEPS[s, 1], STEPS[s, 2]
        a, b, c = i + dx, j + dy, k + dz
        if count == MAX_BASIS_POINTS:
            break
        if label[a, b, c] != FREE or d2[a, b, c] == FAR_D2:
            continue
        qx, qy, qz = offset[a, b, c, 0] - dx, offset[a, b, c, 1] - dy, offset[a, b, c, 2] - dz
        new = True
        for n in range(count):
            if not distinct(found[n, 0], found[n, 1], found[n, 2], qx, qy, qz, l1, cosine):
                new = False
                break
        if new:
            found[count, 0], found[count, 1], found[count, 2] = qx, qy, qz
            count += 1
    return count


@njit(cache=True, nogil=True)
def voronoi(label, d2, offset, basis, min_d2, l1, cosine):  # noqa: ANN001, ANN201, PLR0917
    """Recompute `basis` of a window in place, except for its outermost layer: 0 off the GVD, else its basis points."""
    nx, ny, nz = label.shape
    for i in range(1, nx - 1):
        for j in range(1, ny - 1):
            for k in range(1, nz - 1):
                basis[i, j, k] = 0
                if label[i, j, k] != FREE or d2[i, j, k] == FAR_D2 or d2[i, j, k] <= min_d2:
                    continue
                if _on_gvd(label, d2, offset, i, j, k, min_d2, l1, cosine):
                    basis[i, j, k] = _basis_points(label, d2, offset, i, j, k, l1, cosine)

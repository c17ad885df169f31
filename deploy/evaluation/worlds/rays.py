"""Depth of rays through a grid of voxels, exact at the voxels' faces."""

import numpy as np

from prior_sg.deploy.evaluation.worlds.plan import GLASS, NOTHING
from prior_sg.services.compiled import compiled

THROUGH, LOST = 0.2, 0.95  # below the first, a ray passes glass; up to the second, it returns nothing; else it is seen


@compiled()
def cast(  # noqa: PLR0917
    grid: np.ndarray,
    origin_voxels: np.ndarray,
    directions_voxels: np.ndarray,
    range_m: float,
    chance: np.ndarray,
    depth_m: np.ndarray,
    axis: np.ndarray,
) -> None:
    """Fill `depth_m` (n,), 0 = nothing in range, and `axis` (n,), that of the face that was hit.

    `grid` (x, y, z) holds matter, 0 = nothing; what leaves it hits nothing. `origin_voxels` (3,) lies in it.
    `directions_voxels` (n, 3) is the way per metre of depth. `chance` (n,) in [0, 1) decides what glass does to a ray.
    """
    nx, ny, nz = grid.shape
    at_x, at_y, at_z = origin_voxels
    for ray in range(len(directions_voxels)):
        way_x, way_y, way_z = directions_voxels[ray]
        i, j, k = int(at_x), int(at_y), int(at_z)
        step_x, leap_x, next_x = _first_face(at_x, way_x)
        step_y, leap_y, next_y = _first_face(at_y, way_y)
        step_z, leap_z, next_z = _first_face(at_z, way_z)
        depth_m[ray], axis[ray] = 0.0, 0
        while True:
            if next_x <= next_y and next_x <= next_z:
                depth, crossed = next_x, 0
                i, next_x = i + step_x, next_x + leap_x
            elif next_y <= next_z:
                depth, crossed = next_y, 1
                j, next_y = j + step_y, next_y + leap_y
            else:
                depth, crossed = next_z, 2
                k, next_z = k + step_z, next_z + leap_z
            if depth > range_m or not (0 <= i < nx and 0 <= j < ny and 0 <= k < nz):
                break
            matter = grid[i, j, k]
            if matter == NOTHING or (matter == GLASS and chance[ray] < THROUGH):
                continue
            if matter != GLASS or chance[ray] >= LOST:
                depth_m[ray], axis[ray] = depth, crossed
            break


@compiled(inline="always")
def _first_face(at: float, way: float) -> tuple[int, float, float]:
    """Which way the cells go along one axis, depth from face to face, and depth of the first."""
    if way > 0:
        return 1, 1 / way, (np.floor(at) + 1 - at) / way
    if way < 0:
        return -1, -1 / way, (np.floor(at) - at) / way
    return 0, np.inf, np.inf


@compiled()
def fill(grid: np.ndarray, low: np.ndarray, high: np.ndarray, matter: np.ndarray) -> None:
    """Write boxes, from voxel `low` to before voxel `high` (n, 3), one after the other."""
    for box in range(len(matter)):
        for i in range(low[box, 0], high[box, 0]):
            for j in range(low[box, 1], high[box, 1]):
                for k in range(low[box, 2], high[box, 2]):
                    grid[i, j, k] = matter[box]

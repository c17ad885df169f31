"""Depth of rays through a grid of voxels, exact at the voxels' faces (pure)."""

import numpy as np

from prior_sg.deploy.evaluation.worlds.plan import GLASS
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
    size = grid.shape
    for ray in range(len(directions_voxels)):
        cell, step, leap, after = [0, 0, 0], [0, 0, 0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
        for k in range(3):
            way, at = directions_voxels[ray, k], origin_voxels[k]
            cell[k] = int(np.floor(at))
            if way > 0:
                step[k], leap[k], after[k] = 1, 1 / way, (cell[k] + 1 - at) / way
            elif way < 0:
                step[k], leap[k], after[k] = -1, -1 / way, (cell[k] - at) / way
            else:
                leap[k], after[k] = np.inf, np.inf
        depth_m[ray], axis[ray] = 0.0, 0
        while True:
            k = 0 if after[0] <= after[1] else 1
            if after[2] < after[k]:
                k = 2
            depth = after[k]
            if depth > range_m:
                break
            cell[k] += step[k]
            if cell[k] < 0 or cell[k] >= size[k]:
                break
            after[k] += leap[k]
            matter = grid[cell[0], cell[1], cell[2]]
            if matter == 0:
                continue
            if matter == GLASS:
                if chance[ray] < THROUGH:
                    continue
                if chance[ray] < LOST:
                    break
            depth_m[ray], axis[ray] = depth, k
            break


@compiled()
def fill(grid: np.ndarray, low: np.ndarray, high: np.ndarray, matter: np.ndarray) -> None:
    """Write boxes, from voxel `low` to before voxel `high` (n, 3), one after the other."""
    for box in range(len(matter)):
        for i in range(low[box, 0], high[box, 0]):
            for j in range(low[box, 1], high[box, 1]):
                for k in range(low[box, 2], high[box, 2]):
                    grid[i, j, k] = matter[box]

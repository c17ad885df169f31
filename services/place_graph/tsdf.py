"""Projective TSDF integration of one depth image (Hydra, `projective_integrator`; pure).

A voxel that projects onto a measured pixel sees `sdf = range - distance of the voxel`: clipped to +truncation in front
of the surface, dropped beyond -truncation behind it. The weight falls with the squared depth, and linearly to zero from
one voxel behind the surface, so that what is hidden behind a thin wall is decided by who sees it from its own side.
"""

import numpy as np
from numba import njit

from schemas.frames import Intrinsics
from services.geometry import inverse, transform
from services.place_graph.grid import BLOCK, FREE, OCCUPIED, Block, BlockKey, Box, VoxelGrid

HALF_DIAGONAL = float(np.sqrt(3.0) / 2.0)


def integrate(
    grid: VoxelGrid,
    depth_m: np.ndarray,
    camera: Intrinsics,
    world_from_camera: np.ndarray,
    *,
    voxel_m: float,
    truncation_m: float,
    surface_m: float,
    min_range_m: float,
    max_range_m: float,
    max_weight: float,
) -> Box | None:
    """Fuse a depth image (h, w) in metres, 0 = no measurement; return the box of voxels whose label changed, if any."""
    camera_from_world = inverse(world_from_camera)
    lens = np.array((camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px))
    limits = np.array((voxel_m, truncation_m, surface_m, min_range_m, max_range_m, max_weight))
    changed = np.array((2**31, 2**31, 2**31, -(2**31), -(2**31), -(2**31)), np.int64)
    spare = Block()
    for key in visible_blocks(camera, world_from_camera, voxel_m, max_range_m):
        block = grid.blocks.get(key, spare)
        corner = np.array(key, np.int64) * BLOCK
        touched = _integrate_block(
            block.tsdf_m, block.weight, block.label, corner, depth_m, camera_from_world, lens, limits, changed
        )
        if touched and block is spare:
            grid.insert(key, spare)
            spare = Block()
    return Box(changed[:3].copy(), changed[3:] + 1) if changed[3] >= changed[0] else None


def visible_blocks(
    camera: Intrinsics, world_from_camera: np.ndarray, voxel_m: float, max_range_m: float
) -> list[BlockKey]:
    """Blocks that may meet the viewing pyramid within range, in a fixed order; a few too many, none too few."""
    u = np.array((0, camera.width_px - 1)) - camera.cx_px
    v = np.array((0, camera.height_px - 1)) - camera.cy_px
    corners = np.array([(x / camera.fx_px, y / camera.fy_px, 1.0) for x in u for y in v]) * max_range_m
    apex = np.zeros((1, 3))
    points_world = transform(world_from_camera, np.concatenate((apex, corners)))
    reach_low = np.maximum(points_world.min(axis=0), world_from_camera[:3, 3] - max_range_m)
    reach_high = np.minimum(points_world.max(axis=0), world_from_camera[:3, 3] + max_range_m)
    block_m = BLOCK * voxel_m
    low, high = np.floor(reach_low / block_m).astype(int), np.floor(reach_high / block_m).astype(int) + 1
    keys = np.stack(np.meshgrid(*map(np.arange, low, high), indexing="ij"), axis=-1).reshape(-1, 3)
    centers = transform(inverse(world_from_camera), (keys + 0.5) * block_m)
    radius_m = HALF_DIAGONAL * block_m
    inside = (centers[:, 2] > -radius_m) & (np.linalg.norm(centers, axis=1) < max_range_m + radius_m)
    for axis, slopes in ((0, u / camera.fx_px), (1, v / camera.fy_px)):
        for slope, side in zip(slopes, (1.0, -1.0), strict=True):
            distance = side * (centers[:, axis] - slope * centers[:, 2]) / np.hypot(1.0, slope)
            inside &= distance > -radius_m
    return [(int(x), int(y), int(z)) for x, y, z in keys[inside]]


@njit(cache=True, nogil=True)
def _integrate_block(tsdf_m, weight, label, corner, depth_m, camera_from_world, lens, limits, changed):  # noqa: ANN001, ANN202, PLR0917
    """Update one block in place; widen `changed` by every voxel with a new label; return how many voxels were seen."""
    voxel_m, truncation_m, surface_m, min_range_m, max_range_m, max_weight = limits
    fx, fy, cx, cy = lens
    height, width = depth_m.shape
    touched = 0
    for i in range(BLOCK):
        for j in range(BLOCK):
            for k in range(BLOCK):
                x = (corner[0] + i + 0.5) * voxel_m
                y = (corner[1] + j + 0.5) * voxel_m
                z = (corner[2] + k + 0.5) * voxel_m
                m = camera_from_world
                zc = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
                if zc < min_range_m or zc > max_range_m:
                    continue
                xc = m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]
                yc = m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]
                u = int(np.floor(fx * xc / zc + cx + 0.5))
                v = int(np.floor(fy * yc / zc + cy + 0.5))
                if u < 0 or v < 0 or u >= width or v >= height:
                    continue
                measured_m = depth_m[v, u]
                if not measured_m > 0.0:
                    continue
                range_m = np.sqrt(xc * xc + yc * yc + zc * zc)
                if range_m > max_range_m:
                    continue
                sdf_m = (measured_m / zc - 1.0) * range_m
                if sdf_m < -truncation_m:
                    continue
                gain = 1.0 / (zc * zc)
                if sdf_m < -voxel_m:
                    gain *= (truncation_m + sdf_m) / (truncation_m - voxel_m)
                if gain <= 0.0:
                    continue
                touched += 1
                before = weight[i, j, k]
                mean = (tsdf_m[i, j, k] * before + min(sdf_m, truncation_m) * gain) / (before + gain)
                tsdf_m[i, j, k] = mean
                weight[i, j, k] = min(before + gain, max_weight)
                now = FREE if mean >= surface_m else OCCUPIED
                if now != label[i, j, k]:
                    label[i, j, k] = now
                    for axis, index in enumerate((i, j, k)):
                        changed[axis] = min(changed[axis], corner[axis] + index)
                        changed[3 + axis] = max(changed[3 + axis], corner[axis] + index)
    return touched

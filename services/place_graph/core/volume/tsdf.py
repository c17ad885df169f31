"""Projective TSDF integration of one depth image (Hydra, `projective_integrator`; pure).

A voxel that projects onto a measured pixel sees `sdf = range - distance of the voxel`: clipped to +truncation in front
of the surface, dropped beyond -truncation behind it. The weight falls with the squared depth, as a depth sensor's
precision does, and linearly to zero from one voxel behind the surface, so that what is hidden behind a thin wall is
decided by who sees it from its own side.

Weights and weighted distances are summed as integers. Sums of integers do not depend on their order, and what was added
can be taken away again without a trace: the map after any order of the same images is the same map, and an image whose
pose turns out wrong leaves nothing behind. (Unless a voxel's weight reached `max_weight`, where old evidence fades.)
"""

from dataclasses import dataclass

import numpy as np

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.compiled import compiled
from prior_sg.services.geometry import back_project, inverse, transform
from prior_sg.services.place_graph.core.volume.grid import (
    BLOCK,
    FREE,
    OCCUPIED,
    UNOBSERVED,
    BlockKey,
    Box,
    VoxelGrid,
)

HALF_DIAGONAL = float(np.sqrt(3.0) / 2.0)
FINENESS = 256  # integer weight of a measurement at the maximal range
LARGEST = 2**30  # integer weight at which evidence fades for lack of bits
ADD, REMOVE = 1, -1
CORNERS = np.array(list(np.ndindex(2, 2, 2)), np.float64)
TILE_PX = 8  # of the depth image, of which one knows the greatest depth
SHARE_KNOWN = 0.2  # of a depth image that must lie in the known map to be judged by it


@dataclass(frozen=True)
class View:
    """A depth image (h, w), metres, 0 = no measurement, and the camera that took it."""

    depth_m: np.ndarray
    camera: Intrinsics
    world_from_camera: np.ndarray


@dataclass(frozen=True)
class Fusion:
    """How depth becomes signed distance; lengths in metres."""

    voxel_m: float
    truncation_m: float
    surface_m: float  # a voxel with a smaller signed distance is an obstacle
    min_range_m: float
    max_range_m: float
    max_weight: float  # 1 / m^2 of a voxel's evidence
    constant_weight: bool = False  # every measurement counts alike

    @property
    def unit(self) -> float:
        """Integer weight of a measurement of weight 1 / m^2."""
        return FINENESS * self.max_range_m**2

    def limits(self) -> np.ndarray:
        """The numbers that the kernel takes."""
        heaviest = min(self.max_weight * self.unit, LARGEST)
        lengths = (self.voxel_m, self.truncation_m, self.surface_m, self.min_range_m, self.max_range_m)
        return np.array((*lengths, self.unit, heaviest, float(self.constant_weight)))


def integrate(grid: VoxelGrid, view: View, fusion: Fusion, sign: int = ADD) -> np.ndarray:
    """Fuse a depth image, or take it out again (`REMOVE`); return the voxels (n, 3) whose label changed."""
    camera_from_world = inverse(view.world_from_camera)
    camera, limits = view.camera, fusion.limits()
    lens = np.array((camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px))
    changed: list[np.ndarray] = []
    found = np.empty((BLOCK**3, 3), np.int64)
    spare = grid.blank()
    keys = visible_blocks(camera, view.world_from_camera, fusion.voxel_m, fusion.max_range_m)
    for key in seen_blocks(keys, view, fusion):
        known = grid.block(key)
        if known is None and sign == REMOVE:
            continue
        block = spare if known is None else known
        corner = np.array(key, np.int64) * BLOCK
        touched, count = _integrate_block(
            block.sdf, block.weight, block.label, corner, view.depth_m, camera_from_world, lens, limits, sign, found
        )
        if touched and known is None:
            grid.insert(key, spare)
            spare = grid.blank()
        if count:
            changed.append(found[:count].copy())
    return np.concatenate(changed) if changed else np.empty((0, 3), np.int64)


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


def seen_blocks(keys: list[BlockKey], view: View, fusion: Fusion) -> list[BlockKey]:
    """Those of the blocks that the depth image may say something of: not the ones behind all that it shows there."""
    if not keys:
        return []
    camera, block_m = view.camera, BLOCK * fusion.voxel_m
    points = (np.array(keys, np.float64)[:, None] + CORNERS) * block_m
    x, y, z = np.moveaxis(transform(inverse(view.world_from_camera), points.reshape(-1, 3)), -1, 0).reshape(3, -1, 8)
    before = z.min(axis=1) > fusion.min_range_m  # the others are looked at voxel by voxel
    z = np.where(before[:, None], z, 1.0)
    u, v = camera.fx_px * x / z + camera.cx_px, camera.fy_px * y / z + camera.cy_px
    ends = np.stack((u.min(axis=1), u.max(axis=1) + 1.0, v.min(axis=1), v.max(axis=1) + 1.0), axis=1)
    size = np.array((camera.width_px, camera.width_px, camera.height_px, camera.height_px)) - 1
    tiles = np.clip(np.floor(ends), 0, size).astype(np.int64) // TILE_PX
    seen = ~before | _any_beyond(_farthest(view.depth_m, TILE_PX), tiles, z.min(axis=1) - fusion.truncation_m)
    return [key for key, there in zip(keys, seen.tolist(), strict=True) if there]


@compiled()
def _farthest(depth_m, side):  # noqa: ANN001, ANN202
    """The greatest depth in each tile of `side` pixels."""
    rows, columns = depth_m.shape
    found = np.zeros((-(-rows // side), -(-columns // side)), depth_m.dtype)
    for v in range(rows):
        line = found[v // side]
        for tile in range(len(line)):
            best = line[tile]
            for u in range(tile * side, min((tile + 1) * side, columns)):
                best = max(best, depth_m[v, u])
            line[tile] = best
    return found


@compiled()
def _any_beyond(farthest_m, tiles, nearest_m):  # noqa: ANN001, ANN202
    """Whether any tile of each range (n, 4) of columns and rows holds a depth of at least `nearest_m` (n,)."""
    found = np.zeros(len(tiles), np.bool_)
    for n in range(len(tiles)):
        for row in range(tiles[n, 2], tiles[n, 3] + 1):
            for column in range(tiles[n, 0], tiles[n, 1] + 1):
                if farthest_m[row, column] >= nearest_m[n] and farthest_m[row, column] > 0:
                    found[n] = True
                    break
            if found[n]:
                break
    return found


@compiled()
def _integrate_block(sdf, weight, label, corner, depth_m, camera_from_world, lens, limits, sign, changed):  # noqa: ANN001, ANN202, PLR0917
    """Update one block in place; list voxels with a new label in `changed`; return how many were seen and listed."""
    voxel_m, truncation_m, surface_m, min_range_m, max_range_m, unit, heaviest, constant = limits
    fx, fy, cx, cy = lens
    height, width = depth_m.shape
    surface = surface_m / truncation_m
    touched = count = 0
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
                gain = 1.0 if constant else 1.0 / (zc * zc)
                if sdf_m < -voxel_m:
                    gain *= (truncation_m + sdf_m) / (truncation_m - voxel_m)
                units = np.int64(np.floor(gain * unit + 0.5))
                if units <= 0:
                    continue
                touched += 1
                share = min(sdf_m / truncation_m, 1.0)
                total = np.int64(weight[i, j, k]) + sign * units
                summed = np.int64(sdf[i, j, k]) + sign * np.int64(np.floor(share * units + 0.5))
                if total > heaviest:
                    summed = np.int64(np.floor(summed * (heaviest / total) + 0.5))
                    total = np.int64(heaviest)
                if total <= 0:
                    total = summed = np.int64(0)
                sdf[i, j, k] = summed
                weight[i, j, k] = total
                now = UNOBSERVED if total == 0 else (FREE if summed >= surface * total else OCCUPIED)
                if now != label[i, j, k]:
                    label[i, j, k] = now
                    changed[count, 0] = corner[0] + i
                    changed[count, 1] = corner[1] + j
                    changed[count, 2] = corner[2] + k
                    count += 1
    return touched, count


def contradiction(grid: VoxelGrid, view: View, fusion: Fusion, samples: int = 48) -> float:
    """Share of a depth image, where the map is known, that contradicts it: surfaces amid free space, or rays that end
    behind known surfaces. 0 where little of it is known.
    """
    height, width = view.depth_m.shape
    step = max(1, max(height, width) // samples)
    points = back_project(view.depth_m, view.camera)[::step, ::step].reshape(-1, 3)
    depth_m = points[:, 2]
    points = points[(depth_m > fusion.min_range_m) & (np.linalg.norm(points, axis=1) < fusion.max_range_m)]
    if not len(points):
        return 0.0
    at_end = _seen(grid, transform(view.world_from_camera, points), fusion.voxel_m)
    on_the_way = np.stack(
        [_seen(grid, transform(view.world_from_camera, share * points), fusion.voxel_m) for share in (0.4, 0.6, 0.8)]
    )
    wrong = (at_end == FREE) | (on_the_way == OCCUPIED).any(axis=0)
    known = wrong | (at_end == OCCUPIED)
    return float(wrong.sum() / known.sum()) if known.mean() > SHARE_KNOWN else 0.0


def dilated(mask: np.ndarray) -> np.ndarray:
    """The mask (x, y, z) grown by one voxel in all directions, corners included."""
    for axis in range(mask.ndim):
        along = np.moveaxis(mask, axis, 0)
        grown = along.copy()
        grown[1:] |= along[:-1]
        grown[:-1] |= along[1:]
        mask = np.moveaxis(grown, 0, axis)
    return mask


def _seen(grid: VoxelGrid, points_world: np.ndarray, voxel_m: float) -> np.ndarray:
    """What the map holds around each point (n, 3): an obstacle if one is within a voxel, else the point's own label."""
    voxels = np.floor(points_world / voxel_m).astype(np.int64)
    box = Box(voxels.min(axis=0), voxels.max(axis=0) + 1).grown(1)
    label = grid.gather("label", box)
    near = dilated(label == OCCUPIED)
    where = tuple((voxels - box.low).T)
    return np.where(near[where], OCCUPIED, label[where])

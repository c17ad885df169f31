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
    Box,
    VoxelGrid,
)

HALF_DIAGONAL = float(np.sqrt(3.0) / 2.0)
FINENESS = 256  # integer weight of a measurement at the maximal range
LARGEST = 2**30  # integer weight at which evidence fades for lack of bits
ADD, REMOVE = 1, -1
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


def blocks_of(view: View, fusion: Fusion) -> np.ndarray:
    """Blocks (n, 3) of which a depth image may say something, in a fixed order; a few too many, none too few.

    Those that meet the viewing pyramid within range, and not behind all that the image shows there.
    """
    camera, world_from_camera, block_m = view.camera, view.world_from_camera, BLOCK * fusion.voxel_m
    farthest_m = _farthest(view.depth_m, TILE_PX)
    deepest_m = min(fusion.max_range_m, float(farthest_m.max(initial=0.0)) + fusion.truncation_m)
    size = np.array((camera.width_px, camera.height_px))
    focal, middle = np.array((camera.fx_px, camera.fy_px)), np.array((camera.cx_px, camera.cy_px))
    slopes = (np.stack((np.zeros(2), size)) - 0.5 - middle) / focal  # (end, axis): x / z and y / z of its sides
    corners = np.array([(x, y, 1.0) for x in slopes[:, 0] for y in slopes[:, 1]]) * deepest_m
    points_world = transform(world_from_camera, np.concatenate((np.zeros((1, 3)), corners)))
    low = np.floor(np.maximum(points_world.min(axis=0), world_from_camera[:3, 3] - fusion.max_range_m) / block_m)
    high = np.floor(np.minimum(points_world.max(axis=0), world_from_camera[:3, 3] + fusion.max_range_m) / block_m) + 1
    found = np.zeros((high - low).astype(np.int64), np.bool_)
    lengths_m = np.array((block_m, fusion.min_range_m, fusion.max_range_m, deepest_m, fusion.truncation_m))
    _mark_seen(found, low, inverse(world_from_camera), slopes, focal, middle, size, farthest_m, lengths_m)
    return np.argwhere(found) + low.astype(np.int64)


def integrate(grid: VoxelGrid, view: View, fusion: Fusion, blocks: np.ndarray, sign: int = ADD) -> np.ndarray:
    """Fuse a depth image into some blocks (n, 3), or take it out again (`REMOVE`); return the voxels (m, 3) whose label
    changed.
    """
    camera_from_world = inverse(view.world_from_camera)
    camera, limits = view.camera, fusion.limits()
    lens = np.array((camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px))
    changed: list[np.ndarray] = []
    found = np.empty((BLOCK**3, 3), np.int64)
    spare = grid.blank()
    for x, y, z in blocks.tolist():
        known = grid.block((x, y, z))
        if known is None and sign == REMOVE:
            continue
        block = spare if known is None else known
        corner = np.array((x, y, z), np.int64) * BLOCK
        touched, count = _integrate_block(
            block.sdf, block.weight, block.label, corner, view.depth_m, camera_from_world, lens, limits, sign, found
        )
        if touched and known is None:
            grid.insert((x, y, z), spare)
            spare = grid.blank()
        if count:
            changed.append(found[:count].copy())
    return np.concatenate(changed) if changed else np.empty((0, 3), np.int64)


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
def _mark_seen(found, low, camera_from_world, slopes, focal, middle, size, farthest_m, lengths_m):  # noqa: ANN001, ANN202, PLR0917
    """Mark the blocks from `low` on of which an image may say something, by the greatest depth of its tiles."""
    block_m, min_range_m, max_range_m, deepest_m, truncation_m = lengths_m
    radius_m = HALF_DIAGONAL * block_m
    tilts = np.sqrt(1.0 + slopes * slopes)
    m = camera_from_world
    middle_m, ends = np.empty(3), np.empty((2, 2))
    for i in range(found.shape[0]):
        for j in range(found.shape[1]):
            for k in range(found.shape[2]):
                x, y, z = (low[0] + i) * block_m, (low[1] + j) * block_m, (low[2] + k) * block_m
                half_m = 0.5 * block_m
                for axis in range(3):
                    middle_m[axis] = (
                        m[axis, 0] * (x + half_m) + m[axis, 1] * (y + half_m) + m[axis, 2] * (z + half_m) + m[axis, 3]
                    )
                if middle_m[2] <= -radius_m or middle_m[2] >= deepest_m + radius_m:
                    continue
                if np.sqrt((middle_m * middle_m).sum()) >= max_range_m + radius_m:
                    continue
                inside = True
                for axis in range(2):
                    inside = (
                        inside
                        and middle_m[axis] - slopes[0, axis] * middle_m[2] > -radius_m * tilts[0, axis]
                        and middle_m[axis] - slopes[1, axis] * middle_m[2] < radius_m * tilts[1, axis]
                    )
                if not inside:
                    continue
                nearest_m = np.inf
                ends[0], ends[1] = np.inf, -np.inf
                for corner in range(8):
                    a = x + block_m * (corner & 1)
                    b = y + block_m * ((corner >> 1) & 1)
                    c = z + block_m * (corner >> 2)
                    depth_m = m[2, 0] * a + m[2, 1] * b + m[2, 2] * c + m[2, 3]
                    nearest_m = min(nearest_m, depth_m)
                    if nearest_m <= min_range_m:
                        break
                    for axis in range(2):
                        across_m = m[axis, 0] * a + m[axis, 1] * b + m[axis, 2] * c + m[axis, 3]
                        pixel = focal[axis] * across_m / depth_m + middle[axis]
                        ends[0, axis], ends[1, axis] = min(ends[0, axis], pixel), max(ends[1, axis], pixel + 1.0)
                # One that reaches to before the image is looked at voxel by voxel.
                found[i, j, k] = nearest_m <= min_range_m or _any_beyond(
                    farthest_m, ends, size, nearest_m - truncation_m
                )


@compiled()
def _any_beyond(farthest_m, ends, size, nearest_m):  # noqa: ANN001, ANN202
    """Whether a tile that a range of pixels (end, axis) meets holds a depth of at least `nearest_m`."""
    first_column, last_column = _tile(ends[0, 0], size[0]), _tile(ends[1, 0], size[0])
    for row in range(_tile(ends[0, 1], size[1]), _tile(ends[1, 1], size[1]) + 1):
        for column in range(first_column, last_column + 1):
            if farthest_m[row, column] >= nearest_m and farthest_m[row, column] > 0:
                return True
    return False


@compiled()
def _tile(pixel, size):  # noqa: ANN001, ANN202
    return int(min(max(np.floor(pixel), 0.0), size - 1.0)) // TILE_PX


@compiled()
def _integrate_block(sdf, weight, label, corner, depth_m, camera_from_world, lens, limits, sign, changed):  # noqa: ANN001, ANN202, PLR0917
    """Update one block in place; list voxels with a new label in `changed`; return how many were seen and listed."""
    voxel_m, truncation_m, surface_m, min_range_m, max_range_m, unit, heaviest, constant = limits
    fx, fy, cx, cy = lens
    height, width = depth_m.shape
    surface = surface_m / truncation_m
    touched = count = 0
    m, size, range_m = camera_from_world, (width, height), (min_range_m, max_range_m)
    for i in range(BLOCK):
        x = (corner[0] + i + 0.5) * voxel_m
        for j in range(BLOCK):
            y = (corner[1] + j + 0.5) * voxel_m
            xp, yp, zp = m[0, 0] * x + m[0, 1] * y, m[1, 0] * x + m[1, 1] * y, m[2, 0] * x + m[2, 1] * y
            start, stop = _seen_part(xp, yp, zp, corner[2], m, voxel_m, lens, size, range_m)
            for k in range(start, stop):
                z = (corner[2] + k + 0.5) * voxel_m
                zc = zp + m[2, 2] * z + m[2, 3]
                if zc < min_range_m or zc > max_range_m:
                    continue
                xc = xp + m[0, 2] * z + m[0, 3]
                yc = yp + m[1, 2] * z + m[1, 3]
                u = int(np.floor(fx * xc / zc + cx + 0.5))
                v = int(np.floor(fy * yc / zc + cy + 0.5))
                if u < 0 or v < 0 or u >= width or v >= height:
                    continue
                measured_m = depth_m[v, u]
                if not measured_m > 0.0:
                    continue
                apart_m = np.sqrt(xc * xc + yc * yc + zc * zc)
                if apart_m > max_range_m:
                    continue
                sdf_m = (measured_m / zc - 1.0) * apart_m
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


@compiled()
def _seen_part(xp, yp, zp, low, m, voxel_m, lens, size, range_m):  # noqa: ANN001, ANN202, PLR0917
    """First and last plus one of the voxels of a row along z that may be in the image; a few too many, none too few.

    What keeps a voxel out is a side of the viewing pyramid or an end of the range; both are linear along the row, of
    which `xp`, `yp` and `zp` are the parts of its camera coordinates that x and y make.
    """
    fx, fy, cx, cy = lens
    z = (low + 0.5) * voxel_m
    xc, yc, zc = xp + m[0, 2] * z + m[0, 3], yp + m[1, 2] * z + m[1, 3], zp + m[2, 2] * z + m[2, 3]
    dx, dy, dz = m[0, 2] * voxel_m, m[1, 2] * voxel_m, m[2, 2] * voxel_m
    left, right, top, bottom = cx + 0.5, size[0] - cx - 0.5, cy + 0.5, size[1] - cy - 0.5
    first, last = 0.0, BLOCK - 1.0
    for at, step in (
        (zc - range_m[0], dz),
        (range_m[1] - zc, -dz),
        (fx * xc + left * zc, fx * dx + left * dz),
        (right * zc - fx * xc, right * dz - fx * dx),
        (fy * yc + top * zc, fy * dy + top * dz),
        (bottom * zc - fy * yc, bottom * dz - fy * dy),
    ):
        # Inside where at + k * step >= 0.
        if step > 0.0:
            first = max(first, -at / step - 1.0)
        elif step < 0.0:
            last = min(last, -at / step + 1.0)
        elif at < -voxel_m:
            return 0, 0
    if last < first:  # also where a row that hardly leans to a side would cross it beyond all whole numbers
        return 0, 0
    return int(first), int(last) + 1


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

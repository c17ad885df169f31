"""Class-agnostic objects from one depth image: what is left when floor, walls and ceiling are gone (pure).

1. Points and normals on a coarse grid, turned so that z points up.
2. Structure: the lowest wide level surface, the highest one, and wide upright planes with (almost) nothing behind them.
3. What remains is cut where depth jumps; connected cells are one object. What is too wide is cut once more, where
   surfaces meet at an inner edge: a table against a sideboard, cushions on a sofa.
4. On the upright planes, patches whose colour differs from the plane's: pictures, windows, doors.

It knows no categories and asks for no weights. Touching things of one depth stay one object, thin legs get lost.
"""

import msgspec
import numpy as np

from prior_sg.schemas.codec import AtLeastOne, Positive
from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.opencv import cv2

UPRIGHT, LEVEL = 0.25, 0.9  # |z| of the normals of upright and of level surfaces
COLOUR_CLOSE_CELLS = 3  # gaps inside a coloured patch that are closed


class SegmentsConfig(msgspec.Struct, frozen=True, kw_only=True):
    """What counts as structure, and which of the rest is an object."""

    cell_px: AtLeastOne = 4  # grid of the depth image that is looked at
    max_depth_m: float = 6.0  # beyond it, depth is too coarse and crops are too small
    plane_tolerance_m: Positive = 0.05  # distance from a plane within which points are on it
    level_area_m2: float = 0.3  # least visible area of floor and ceiling
    wall_area_m2: float = 1.0  # and of a wall
    behind_share: float = 0.08  # share of the points that may lie behind a wall: doors and windows are open
    jump_share: float = 0.04  # of the depth: a larger step between neighbours separates objects
    min_cells: int = 40  # smaller segments are noise
    min_side_m: float = 0.08  # the second longest side of an object is at least this
    max_side_m: float = 2.4  # and its longest at most this
    colour_difference: float = 14.0  # in CIE Lab, between a wall and what hangs on it
    fill: float = 0.6  # least share of its bounding rectangle that a patch on a wall covers
    most: int = 8  # detections of a frame, the largest in the image first


class Segment(msgspec.Struct, frozen=True, eq=False):
    """One object's cells on the grid, and how completely the image shows it."""

    mask: np.ndarray  # bool (row, column)
    score: float  # 1 = away from the image's border


class Surfaces(msgspec.Struct, frozen=True, eq=False):
    """The visible surface on the grid, in a frame at the camera with z up."""

    points_m: np.ndarray  # (row, column, 3)
    normals: np.ndarray  # (row, column, 3), towards the camera; zero where unknown
    depths_m: np.ndarray  # (row, column), 0 = no measurement
    areas_m2: np.ndarray  # (row, column), of the surface that a cell shows


def find_segments(
    color: np.ndarray, depth_m: np.ndarray, camera: Intrinsics, level_from_camera: np.ndarray, cfg: SegmentsConfig
) -> list[Segment]:
    """Objects of one image, the largest first.

    `color` uint8 (h, w, 3) RGB, `depth_m` (h, w), 0 = no measurement, `level_from_camera` (3, 3) turns z up.
    """
    surfaces = visible_surfaces(depth_m, camera, level_from_camera, cfg)
    if not (surfaces.depths_m > 0).any():
        return []
    walls, structure = find_structure(surfaces, cfg)
    things = free_standing(surfaces, structure, cfg)
    patches = [patch for wall in walls for patch in wall_patches(_coarse_color(color, cfg), wall, surfaces, cfg)]
    found = [Segment(mask, _completeness(mask)) for mask in (*things, *patches)]
    found.sort(key=lambda segment: -int(segment.mask.sum()))
    return found[: cfg.most]


def visible_surfaces(
    depth_m: np.ndarray, camera: Intrinsics, level_from_camera: np.ndarray, cfg: SegmentsConfig
) -> Surfaces:
    """Points, normals and areas on the grid."""
    step = cfg.cell_px
    depths_m = depth_m[step // 2 :: step, step // 2 :: step].astype(np.float32)
    if (depths_m > 0).any():
        depths_m = np.where(depths_m > 0, cv2.medianBlur(np.ascontiguousarray(depths_m), 3), 0)
    depths_m = np.where(depths_m <= cfg.max_depth_m, depths_m, 0).astype(np.float32)
    v, u = np.indices(depths_m.shape, dtype=np.float32) * step + step // 2
    x, y = (u - camera.cx_px) / camera.fx_px * depths_m, (v - camera.cy_px) / camera.fy_px * depths_m
    points_m = np.stack((x, y, depths_m), axis=-1) @ level_from_camera.T.astype(np.float32)
    normals = _normals(points_m, depths_m, cfg)
    slant = np.abs((normals * points_m).sum(axis=-1)) / np.maximum(np.linalg.norm(points_m, axis=-1), 1e-6)
    cell_m2 = (depths_m * step) ** 2 / (camera.fx_px * camera.fy_px)
    return Surfaces(points_m, normals, depths_m, cell_m2 / np.maximum(slant, 0.2))


def _normals(points_m: np.ndarray, depths_m: np.ndarray, cfg: SegmentsConfig, reach: int = 2) -> np.ndarray:
    """Unit normals towards the camera by central differences; zero at holes, borders and depth jumps."""
    normals = np.zeros_like(points_m)
    core = (slice(reach, -reach), slice(reach, -reach))
    ends = [points_m[reach:-reach, 2 * reach :], points_m[reach:-reach, : -2 * reach]]
    ends += [points_m[2 * reach :, reach:-reach], points_m[: -2 * reach, reach:-reach]]
    across, down = ends[0] - ends[1], ends[2] - ends[3]
    normal = np.cross(across, down)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    normal = np.divide(normal, length, out=np.zeros_like(normal), where=length > 1e-9)
    normal *= np.where((normal * points_m[core]).sum(axis=-1, keepdims=True) > 0, -1, 1)
    z = depths_m
    sides = (z[reach:-reach, 2 * reach :], z[reach:-reach, : -2 * reach])
    around = np.stack((*sides, z[2 * reach :, reach:-reach], z[: -2 * reach, reach:-reach]))
    jump = np.abs(around - z[core]).max(axis=0) > 3 * cfg.jump_share * z[core]
    known = (z[core] > 0) & (around > 0).all(axis=0) & ~jump
    normals[core] = np.where(known[..., None], normal, 0)
    return normals


def find_structure(surfaces: Surfaces, cfg: SegmentsConfig) -> tuple[list[np.ndarray], np.ndarray]:
    """Masks of the walls, and one mask of floor, ceiling and walls together."""
    seen = surfaces.depths_m > 0
    heights_m = surfaces.points_m[..., 2]
    level = seen & (np.abs(surfaces.normals[..., 2]) > LEVEL)
    structure = np.zeros(seen.shape, bool)
    for sign in (1.0, -1.0):  # floor, ceiling
        peak_m = _outermost_level(sign * heights_m, level & (sign * surfaces.normals[..., 2] > 0), surfaces, cfg)
        if peak_m is not None:
            structure |= seen & (sign * heights_m < peak_m + cfg.plane_tolerance_m)
    walls = []
    upright = seen & ~structure & (np.abs(surfaces.normals[..., 2]) < UPRIGHT) & (surfaces.normals != 0).any(axis=-1)
    for _ in range(6):
        plane = _widest_upright(surfaces, upright, cfg)
        if plane is None:
            break
        normal, offset_m = plane
        distance_m = surfaces.points_m @ normal - offset_m  # positive in front
        on = seen & ~structure & (np.abs(distance_m) < cfg.plane_tolerance_m)
        aligned = surfaces.normals @ normal > 0.8
        upright &= ~(on & aligned)
        behind = (distance_m[seen] < -3 * cfg.plane_tolerance_m).mean()
        if behind <= cfg.behind_share:
            wall = on & (aligned | ~(surfaces.normals != 0).any(axis=-1))
            if wall.any():
                walls.append(wall)
            structure |= wall | (seen & (distance_m < cfg.plane_tolerance_m))
    return walls, structure


def _outermost_level(heights_m: np.ndarray, level: np.ndarray, surfaces: Surfaces, cfg: SegmentsConfig) -> float | None:
    """Height of the lowest wide level surface below the camera with almost nothing beneath it."""
    rows = level & (heights_m < -0.2)
    if not rows.any():
        return None
    bins = np.round(heights_m[rows] / cfg.plane_tolerance_m).astype(int)
    first = bins.min()
    areas = np.convolve(np.bincount(bins - first, surfaces.areas_m2[rows]), np.ones(3), "same")
    wide = np.flatnonzero(areas >= cfg.level_area_m2)
    if not len(wide):
        return None
    lowest = wide[0] + int(areas[wide[0] : wide[0] + 3].argmax())
    peak_m = (lowest + first) * cfg.plane_tolerance_m
    beneath = (heights_m[surfaces.depths_m > 0] < peak_m - 3 * cfg.plane_tolerance_m).mean()
    return float(peak_m) if beneath <= cfg.behind_share else None


def _widest_upright(surfaces: Surfaces, upright: np.ndarray, cfg: SegmentsConfig) -> tuple[np.ndarray, float] | None:
    """Normal (3,) and offset of the upright plane with the largest visible area."""
    normals, points_m, areas = surfaces.normals[upright], surfaces.points_m[upright], surfaces.areas_m2[upright]
    if areas.sum() < cfg.wall_area_m2:
        return None
    turn = np.arctan2(normals[:, 1], normals[:, 0])
    counts = np.bincount((np.round(turn / np.radians(6)).astype(int) + 30) % 60, areas, minlength=60)
    best = (counts + np.roll(counts, 1) + np.roll(counts, -1)).argmax()
    near = np.abs((np.round(turn / np.radians(6)).astype(int) + 30 - best + 30) % 60 - 30) <= 1
    normal = (normals[near] * areas[near, None]).sum(axis=0) * (1, 1, 0)
    normal /= np.linalg.norm(normal)
    offsets = np.round(points_m[near] @ normal / cfg.plane_tolerance_m).astype(int)
    area = np.convolve(np.bincount(offsets - offsets.min(), areas[near]), np.ones(3), "same")
    if area.max() < cfg.wall_area_m2:
        return None
    close = np.abs(offsets - offsets.min() - area.argmax()) <= 1
    return normal, float(np.average(points_m[near][close] @ normal, weights=areas[near][close]))


def free_standing(surfaces: Surfaces, structure: np.ndarray, cfg: SegmentsConfig) -> list[np.ndarray]:
    """Masks of connected surfaces that are not structure and have an object's size."""
    rest = (surfaces.depths_m > 0) & ~structure
    cut = rest & ~_jumps(surfaces.depths_m, cfg)
    found = []
    for mask in _components(cut, cfg):
        if _sides_m(surfaces, mask)[2] > cfg.max_side_m:
            found += _components(mask & ~_inner_edges(surfaces), cfg)
        else:
            found.append(mask)
    return [mask for mask in found if _has_size(surfaces, mask, cfg)]


def _jumps(depths_m: np.ndarray, cfg: SegmentsConfig) -> np.ndarray:
    """Cells behind a step of depth towards a neighbour: the farther side of each step."""
    nearest = cv2.erode(np.where(depths_m > 0, depths_m, np.inf).astype(np.float32), np.ones((3, 3), np.uint8))
    return depths_m - nearest > cfg.jump_share * depths_m + 0.02


def _inner_edges(surfaces: Surfaces, reach: int = 2) -> np.ndarray:
    """Cells where the surface bends inwards by more than about 30 degrees, as where a thing stands on another."""
    edges = np.zeros(surfaces.depths_m.shape, bool)
    for axis in (0, 1):
        step_m = np.roll(surfaces.points_m, -reach, axis) - np.roll(surfaces.points_m, reach, axis)
        bend = np.roll(surfaces.normals, -reach, axis) - np.roll(surfaces.normals, reach, axis)
        length_m = np.maximum(np.linalg.norm(step_m, axis=-1), 1e-6)
        edges |= (bend * step_m).sum(axis=-1) / length_m < -0.35
    return edges


def wall_patches(color: np.ndarray, wall: np.ndarray, surfaces: Surfaces, cfg: SegmentsConfig) -> list[np.ndarray]:
    """Masks of patches on a wall whose colour differs from the wall's; `color` float32 (row, column, 3) CIE Lab."""
    usual = np.median(color[wall], axis=0)
    different = wall & (np.abs(color - usual).sum(axis=-1) > cfg.colour_difference)
    kernel = np.ones((COLOUR_CLOSE_CELLS, COLOUR_CLOSE_CELLS), np.uint8)
    closed = cv2.morphologyEx(different.astype(np.uint8), cv2.MORPH_CLOSE, kernel) > 0
    patches = []
    for mask in _components(closed & wall, cfg):
        filled = _filled(mask)
        rows, columns = np.nonzero(filled)
        box = (np.ptp(rows) + 1) * (np.ptp(columns) + 1)
        if filled.sum() >= cfg.fill * box and filled.sum() < 0.5 * wall.sum() and _has_size(surfaces, filled, cfg):
            patches.append(filled)
    return patches


def _filled(mask: np.ndarray) -> np.ndarray:
    """The mask with its holes closed: a window is its frame and its panes."""
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return cv2.drawContours(np.zeros(mask.shape, np.uint8), contours, -1, 1, cv2.FILLED) > 0


def _coarse_color(color: np.ndarray, cfg: SegmentsConfig) -> np.ndarray:
    step = cfg.cell_px
    height, width = (-(-(side - step // 2) // step) for side in color.shape[:2])
    small = cv2.resize(color, (width, height), interpolation=cv2.INTER_AREA)
    return cv2.cvtColor(small.astype(np.float32) / 255, cv2.COLOR_RGB2Lab)


def _components(mask: np.ndarray, cfg: SegmentsConfig) -> list[np.ndarray]:
    count, numbers, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    return [numbers == index for index in range(1, count) if stats[index, cv2.CC_STAT_AREA] >= cfg.min_cells]


def _sides_m(surfaces: Surfaces, mask: np.ndarray) -> np.ndarray:
    """Sides (3,) of the upright box around most of a segment's points, shortest first."""
    low, high = np.percentile(surfaces.points_m[mask], (2, 98), axis=0)
    return np.sort(high - low)


def _has_size(surfaces: Surfaces, mask: np.ndarray, cfg: SegmentsConfig) -> bool:
    sides = _sides_m(surfaces, mask & (surfaces.depths_m > 0))
    return bool(sides[1] >= cfg.min_side_m and sides[2] <= cfg.max_side_m)


def _completeness(mask: np.ndarray) -> float:
    """1 minus the share of the segment's outline that the image's border cuts, roughly."""
    rim = mask[0].sum() + mask[-1].sum() + mask[:, 0].sum() + mask[:, -1].sum()
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return 1.0 - min(1.0, float(rim) / max(sum(map(len, contours)), 1))

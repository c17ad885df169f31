"""How what was found in an image becomes 3D, and what of the image shows it (pure)."""

from collections.abc import Sequence
from typing import Protocol, TypeVar

import msgspec
import numpy as np

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.feature_pyramid.core.config import Config
from prior_sg.services.feature_pyramid.core.crops import Crops

CONTEXT = 1.2  # side of the square crop that is encoded, in longer sides of the box


class Outlined(Protocol):
    """Where an image shows one object."""

    @property
    def box_px(self) -> np.ndarray:
        """Left, top, right, bottom edge: float32 (4,)."""

    @property
    def mask(self) -> np.ndarray:
        """The cells of the grid that show it: bool (row, column)."""


F = TypeVar("F", bound=Outlined)


class Grid(msgspec.Struct, frozen=True, eq=False):
    """Every `cell_px`-th pixel of a depth image."""

    depths_m: np.ndarray  # float32 (row, column), 0 = no measurement
    cell_px: int

    @classmethod
    def of(cls, depth_m: np.ndarray, cell_px: int) -> "Grid":
        """The grid of a depth image (h, w); its cell (0, 0) is the pixel in the middle of the first square."""
        return cls(depth_m[cell_px // 2 :: cell_px, cell_px // 2 :: cell_px].astype(np.float32), cell_px)

    def points_camera_m(self, mask: np.ndarray, camera: Intrinsics) -> np.ndarray:
        """Points (point, 3) of the measured cells of a mask, float32."""
        rows, columns = np.nonzero(mask & (self.depths_m > 0))
        z = self.depths_m[rows, columns]
        u, v = (index * self.cell_px + self.cell_px // 2 for index in (columns, rows))
        x, y = (u - camera.cx_px) / camera.fx_px * z, (v - camera.cy_px) / camera.fy_px * z
        return np.stack((x, y, z), axis=1).astype(np.float32)


def lift(found: list[F], depth_m: np.ndarray, camera: Intrinsics, cfg: Config) -> tuple[list[F], list[np.ndarray]]:
    """Points in the camera frame, float32 (point, 3), of each object with any; one per cube of `object_point_m`."""
    grid = Grid.of(depth_m, cfg.segments.cell_px)
    pairs = [(one, _thinned(grid.points_camera_m(one.mask, camera), cfg.object_point_m)) for one in found]
    pairs = [(one, points_m) for one, points_m in pairs if len(points_m)]
    return [one for one, _ in pairs], [points_m for _, points_m in pairs]


def object_crops(found: Sequence[Outlined], width_px: int, height_px: int) -> Crops:
    """Squares around the boxes with some of their surroundings, inside the image."""
    boxes_px = np.array([one.box_px for one in found], np.float32).reshape(-1, 4)
    longest_px = (boxes_px[:, 2:] - boxes_px[:, :2]).max(axis=1, initial=1)
    side_px = np.clip(np.round(CONTEXT * longest_px), 1, min(width_px, height_px)).astype(np.int32)
    corner_px = np.round((boxes_px[:, :2] + boxes_px[:, 2:] - side_px[:, None]) / 2).astype(np.int32)
    left_px, top_px = (
        np.clip(corner_px[:, axis], 0, size_px - side_px) for axis, size_px in enumerate((width_px, height_px))
    )
    return Crops(left_px, top_px, side_px, np.zeros(len(found), np.uint8))


def box_of(mask: np.ndarray, cell_px: int, width_px: int, height_px: int) -> np.ndarray:
    """Edges of the cells of a mask: left, top, right, bottom, float32."""
    rows, columns = np.nonzero(mask)
    edges = np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]) * cell_px
    return np.minimum(edges, (width_px, height_px, width_px, height_px)).astype(np.float32)


def mask_in_box(box_px: np.ndarray, grid: Grid, camera: Intrinsics) -> np.ndarray:
    """Cells in a box whose depth goes with its middle: the object in front of or amid other things.

    A thing is taken to be at most as deep as its box is wide or high; all zero where the middle has no measurement.
    """
    mask = np.zeros(grid.depths_m.shape, bool)
    left, top, right, bottom = box_px / grid.cell_px
    inside = _window(mask, left, top, right, bottom)
    quarter_x, quarter_y = (right - left) / 4, (bottom - top) / 4
    middle = _window(grid.depths_m, left + quarter_x, top + quarter_y, right - quarter_x, bottom - quarter_y)
    depths_m = grid.depths_m[middle]
    depths_m = depths_m[depths_m > 0]
    if not len(depths_m):
        return mask
    depth_m = float(np.median(depths_m))
    size_px = max(box_px[2] - box_px[0], box_px[3] - box_px[1])
    reach_m = max(0.1, size_px / camera.fx_px * depth_m / 2)
    inner_m = grid.depths_m[inside]
    mask[inside] = (inner_m > 0) & (np.abs(inner_m - depth_m) <= reach_m)
    return mask


def without_doubles(boxes_px: np.ndarray, scores: np.ndarray, most_overlap: float = 0.5) -> np.ndarray:
    """Indices of the boxes (n, 4) that overlap no better one by more than `most_overlap` of their union, best first."""
    kept: list[int] = []
    areas = (boxes_px[:, 2:] - boxes_px[:, :2]).prod(axis=1)
    for index in np.argsort(-scores, kind="stable").tolist():
        corner = np.maximum(boxes_px[kept, :2], boxes_px[index, :2])
        common = np.clip(np.minimum(boxes_px[kept, 2:], boxes_px[index, 2:]) - corner, 0, None).prod(axis=1)
        if not (common > most_overlap * (areas[kept] + areas[index] - common)).any():
            kept.append(index)
    return np.array(kept, np.int64)


def _thinned(points_m: np.ndarray, cell_m: float) -> np.ndarray:
    """The first point in every cube."""
    _, first = np.unique(np.floor(points_m / cell_m).astype(np.int64), axis=0, return_index=True)
    return points_m[np.sort(first)]


def _window(grid: np.ndarray, left: float, top: float, right: float, bottom: float) -> tuple[slice, slice]:
    """The cells between edges in cells, at least one."""
    ends = []
    for low, high, size in ((top, bottom, grid.shape[0]), (left, right, grid.shape[1])):
        first = int(np.clip(np.floor(low), 0, size - 1))
        ends.append(slice(first, max(first + 1, min(size, int(np.ceil(high))))))
    return ends[0], ends[1]

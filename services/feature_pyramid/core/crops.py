"""Which crops of a keyframe are worth encoding (paper, Multi-Scale Feature Pyramid): geometry and depth (pure)."""

import msgspec
import numpy as np

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.feature_pyramid.core.config import Config
from prior_sg.services.feature_pyramid.core.medians import patch_medians

PUBLISHED_CROP_PX = 224  # the paper's, for CLIP
SCENE_CROP_PX = 448  # for conse: its network classifies pictures of whole scenes; chosen on split dev


class Crops(msgspec.Struct, frozen=True, eq=False):
    """Square candidate crops: pixels left_px <= u < left_px + side_px, likewise downwards."""

    left_px: np.ndarray  # int32 (crop,)
    top_px: np.ndarray  # int32 (crop,)
    side_px: np.ndarray  # int32 (crop,)
    layers: np.ndarray  # uint8 (crop,)

    def __len__(self) -> int:
        return len(self.side_px)

    @property
    def sigmas_px(self) -> np.ndarray:
        """Scale of each crop, half its side: float32 (crop,)."""
        return (self.side_px / 2).astype(np.float32)

    @property
    def centers_px(self) -> np.ndarray:
        """Centre u, v of each crop: float32 (crop, 2). Pixel (0, 0) is the centre of the upper left pixel."""
        corner = np.stack((self.left_px, self.top_px), axis=1)
        return (corner + (self.side_px[:, None] - 1) / 2).astype(np.float32)

    def take(self, keep: np.ndarray) -> "Crops":
        """The crops that a mask or an index selects."""
        return Crops(self.left_px[keep], self.top_px[keep], self.side_px[keep], self.layers[keep])

    def cut(self, image: np.ndarray) -> list[np.ndarray]:
        """Views of an image (h, w, ...), one per crop."""
        boxes = zip(self.left_px.tolist(), self.top_px.tolist(), self.side_px.tolist(), strict=True)
        return [image[top : top + side, left : left + side] for left, top, side in boxes]


class Selection(msgspec.Struct, frozen=True, eq=False):
    """The crops of one frame that survive the area filter."""

    crops: Crops
    depths_m: np.ndarray  # float32 (crop,), median depth
    candidates: int  # before the filter


def select_crops(depth_m: np.ndarray, camera: Intrinsics, cfg: Config) -> Selection:
    """Crops of the pyramid that see enough space (eqs. physical_area, feature_pyramid without the encoder).

    `depth_m` (h, w), 0 = no measurement. A crop without any measurement has no median and is dropped: its physical
    size is unknown.
    """
    crops = pyramid_crops(camera.width_px, camera.height_px, cfg)
    boxes = np.stack((crops.left_px, crops.top_px, crops.side_px), axis=1)
    depths_m = patch_medians(np.ascontiguousarray(depth_m, np.float32), boxes)
    keep = (depths_m > 0.0) & (physical_area(crops.sigmas_px, depths_m, camera) >= cfg.min_area_m2)
    return Selection(crops.take(keep), depths_m[keep], len(crops))


def pyramid_crops(width_px: int, height_px: int, cfg: Config) -> Crops:
    """All candidate crops of an image, layer by layer and row by row; each layer covers the whole image."""
    boxes = [
        (left, top, side, layer)
        for layer, side in enumerate(layer_sides(min(width_px, height_px), cfg))
        for top in crop_starts(height_px, side, cfg.overlap)
        for left in crop_starts(width_px, side, cfg.overlap)
    ]
    left, top, side, layers = np.array(boxes, np.int32).T
    return Crops(left, top, side, layers.astype(np.uint8))


def layer_sides(shorter_px: int, cfg: Config) -> list[int]:
    """Side of the crops of each layer, growing linearly up to the image's shorter side."""
    smallest = min(smallest_crop_px(cfg), shorter_px)
    layers = cfg.layers if smallest < shorter_px else 1
    if layers == 1:
        return [smallest]
    return sorted({round(side) for side in np.linspace(smallest, shorter_px, layers).tolist()})


def smallest_crop_px(cfg: Config) -> int:
    """Side of layer 0 as set, or else what suits the embedding space's family."""
    return cfg.smallest_crop_px or (SCENE_CROP_PX if cfg.space.startswith("conse/") else PUBLISHED_CROP_PX)


def crop_starts(length_px: int, side_px: int, overlap: float) -> list[int]:
    """First pixels of evenly spread crops that cover `length_px` and overlap by at least `overlap` of their side."""
    stride = max(1, int(side_px * (1.0 - overlap)))
    steps = -(-(length_px - side_px) // stride)
    return [round(index * (length_px - side_px) / steps) for index in range(steps + 1)] if steps else [0]


def physical_area(sigmas_px: np.ndarray, depths_m: np.ndarray, camera: Intrinsics) -> np.ndarray:
    """Area in m² that a crop spans at its median depth (eq. physical_area, f² = fx fy)."""
    return (2.0 * sigmas_px * depths_m) ** 2 / (camera.fx_px * camera.fy_px)


def coarse_surface(depth_m: np.ndarray, cell_px: int) -> np.ndarray:
    """Depth surface with one value per cell: float32 (ceil(h / cell), ceil(w / cell)), 0 = no measurement.

    The value is the lower median of the cell's measurements: a depth that was measured, never one between the front
    and the back of an edge.
    """
    height, width = depth_m.shape
    rows, columns = -(-height // cell_px), -(-width // cell_px)
    padded = np.full((rows * cell_px, columns * cell_px), np.inf, np.float32)
    padded[:height, :width] = np.where(depth_m > 0.0, depth_m, np.inf)
    cells = padded.reshape(rows, cell_px, columns, cell_px).swapaxes(1, 2).reshape(rows, columns, cell_px * cell_px)
    cells.sort(axis=2)
    measured = np.isfinite(cells).sum(axis=2)
    middle = np.maximum(measured - 1, 0) // 2
    value = np.take_along_axis(cells, middle[..., None], axis=2)[..., 0]
    return np.where(measured > 0, value, 0.0).astype(np.float32)

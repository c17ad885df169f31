"""Which crops of a keyframe are worth encoding (paper, Multi-Scale Feature Pyramid); pure geometry and depth."""

import msgspec
import numpy as np

from prior_sg.schemas.features import DEFAULT_SPACE
from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.feature_pyramid.core.medians import patch_medians
from prior_sg.services.feature_pyramid.core.segments import SegmentsConfig

PUBLISHED_CROP_PX = 224  # the paper's, for CLIP
SCENE_CROP_PX = 448  # for conse: its network classifies pictures of whole scenes; chosen on split dev


class Config(msgspec.Struct, frozen=True, kw_only=True):
    """Settings of the feature pyramid; one embedding space per worker."""

    space: str = DEFAULT_SPACE  # the encoder: conse/…, open_clip/MODEL/PRETRAINED, onnx:FOLDER
    runtime: str = "onnx"  # or torch: what runs the networks of conse
    device: str = "auto"  # cpu, cuda, or auto: cuda where there is one
    smallest_crop_px: int = 0  # side of layer 0; smaller images use their shorter side; 0 = what suits the encoder
    layers: int = 3  # sides grow linearly from the smallest crop to the shorter side of the image
    overlap: float = 0.5  # least share of a crop's side that its neighbour covers too
    min_area_m2: float = 2.25  # A_min: crops that see less physical area are not encoded
    surface_cell_px: int = 8  # cell size of the coarse depth surface
    batch_size: int = 0  # crops per forward pass, of one or several keyframes; 0 = what suits encoder and device
    threads: int = 0  # of the neural network library; 0 = its own choice (OMP_NUM_THREADS)
    detector: str = "segments"  # of objects; or none, grounding_dino:MODEL, owlv2:MODEL (a folder or a published name)
    detector_prompts: tuple[
        str, ...
    ] = ()  # names of what grounding_dino and owlv2 look for; empty = the prior's objects
    detector_masks: str = "depth"  # what cuts their boxes out: the depth in its middle, or sam:MODEL
    detector_threshold: float = 0.3  # least score of what those find; the networks' authors advise 0.2 to 0.35
    object_point_m: float = 0.05  # side of the cubes of which a detection keeps one point each
    segments: SegmentsConfig = SegmentsConfig()  # of the detector segments; its grid is every detector's

    def __post_init__(self) -> None:
        if self.smallest_crop_px < 0 or self.layers < 1 or self.surface_cell_px < 1:
            raise ValueError("layers and surface_cell_px must be at least 1, and smallest_crop_px not negative")
        if not 0.0 <= self.overlap < 1.0:
            raise ValueError("overlap must be in [0, 1)")
        if self.min_area_m2 < 0.0 or self.threads < 0 or self.batch_size < 0:
            raise ValueError("min_area_m2, threads and batch_size must not be negative")
        if self.object_point_m <= 0.0:
            raise ValueError("object_point_m must be positive")


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

"""Settings of the feature pyramid and of the objects found beside it (pure)."""

import msgspec

from prior_sg.schemas.features import DEFAULT_SPACE
from prior_sg.services.feature_pyramid.core.markers import MarkersConfig
from prior_sg.services.feature_pyramid.core.segments import SegmentsConfig
from prior_sg.services.images import MAX_PRINCIPAL_OFFSET


class Config(msgspec.Struct, frozen=True, kw_only=True):
    """Settings of the feature pyramid; one embedding space per worker."""

    space: str = DEFAULT_SPACE  # the encoder: conse/…, open_clip/MODEL/PRETRAINED, onnx:FOLDER
    runtime: str = "auto"  # what runs the networks of conse: onnx, onnx-int8, torch, or auto: the fastest of them here
    device: str = "auto"  # cpu, cuda, or auto: cuda where there is one
    smallest_crop_px: int = 0  # side of layer 0; smaller images use their shorter side; 0 = what suits the encoder
    layers: int = 3  # sides grow linearly from the smallest crop to the shorter side of the image
    overlap: float = 0.5  # least share of a crop's side that its neighbour covers too
    min_area_m2: float = 2.25  # A_min: crops that see less physical area are not encoded
    surface_cell_px: int = 8  # cell size of the coarse depth surface
    max_principal_offset: float = MAX_PRINCIPAL_OFFSET  # as of place_graph: beyond it, a keyframe is not encoded
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
    markers: MarkersConfig = MarkersConfig()  # printed ones, by which maps of several robots find together

    def __post_init__(self) -> None:
        if self.smallest_crop_px < 0 or self.layers < 1 or self.surface_cell_px < 1:
            raise ValueError("layers and surface_cell_px must be at least 1, and smallest_crop_px not negative")
        if not 0.0 <= self.overlap < 1.0:
            raise ValueError("overlap must be in [0, 1)")
        if self.min_area_m2 < 0.0 or self.threads < 0 or self.batch_size < 0:
            raise ValueError("min_area_m2, threads and batch_size must not be negative")
        if self.object_point_m <= 0.0:
            raise ValueError("object_point_m must be positive")

"""A detector that is asked for nothing by name: whatever stands or hangs in a room."""

from prior_sg.services.feature_pyramid.core.lift import box_of
from prior_sg.services.feature_pyramid.core.segments import SegmentsConfig, find_segments
from prior_sg.services.feature_pyramid.detectors.base import Detector, Found, Shot


class Segments(Detector):
    """Class-agnostic segments of the depth image (core/segments.py)."""

    name = "segments"

    def __init__(self, cfg: SegmentsConfig) -> None:
        self.cfg = cfg

    def detect(self, shot: Shot, sought: tuple[str, ...] = ()) -> list[Found]:
        segments = find_segments(shot.color, shot.depth_m, shot.camera, shot.world_from_camera[:3, :3], self.cfg)
        height_px, width_px = shot.depth_m.shape
        return [Found(box_of(one.mask, self.cfg.cell_px, width_px, height_px), one.mask, one.score) for one in segments]

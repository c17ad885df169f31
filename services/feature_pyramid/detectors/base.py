"""What a detector is, what it looks at, and what it finds."""

import msgspec
import numpy as np

from prior_sg.schemas.frames import Intrinsics


class Found(msgspec.Struct, frozen=True, eq=False):
    """One object in one image."""

    box_px: np.ndarray  # float32 (4,): left, top, right, bottom edge
    mask: np.ndarray  # bool (row, column) on the grid
    score: float  # in [0, 1]
    name: int = 0  # index among the names that were sought; means nothing where none were


class Shot(msgspec.Struct, frozen=True, eq=False):
    """One posed image with depth."""

    color: np.ndarray  # uint8 (h, w, 3) RGB
    depth_m: np.ndarray  # (h, w), 0 = no measurement
    camera: Intrinsics
    world_from_camera: np.ndarray  # (4, 4), world z is up


class Detector:
    """Finds objects in a colour image with depth. Subclasses say how; this one finds none."""

    name = "none"
    prompted = False  # whether it looks for objects by name; without names it finds none then

    def detect(self, shot: Shot, sought: tuple[str, ...] = ()) -> list[Found]:
        """Objects of one image; `sought` are the names of what a prompted detector looks for."""
        return []

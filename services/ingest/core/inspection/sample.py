"""What of a recording is looked at: every frame's stamp and pose, and the images of some (pure)."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.geometry import inverse, rotation_angle_rad
from prior_sg.services.ingest.core.agreement import DepthView

MOVED_M, MOVED_RAD = 0.1, 0.07  # between the two frames of a pair
SATURATED = 65535  # many sensors write it where they measured nothing
REACH = 8  # frames after which the second of a pair is taken even if the camera has hardly moved


@dataclass(frozen=True)
class Shot:
    """One frame with its images decoded."""

    index: int  # position in the source
    intrinsics: Intrinsics
    world_from_camera: np.ndarray  # 4 x 4
    depth: np.ndarray  # (h, w), units of depth_scale_m, 0 = no measurement
    depth_scale_m: float
    grey: np.ndarray | None = None  # (h, w) uint8, the colour image; None = not decoded
    camera: str = ""  # of several that a robot has

    def view(self, factor: float = 1.0) -> DepthView:
        """Its depth in metres, times a factor; the largest value of 16 bits is no measurement."""
        depth_m = np.where(self.depth < SATURATED, self.depth, 0).astype(np.float32)
        depth_m *= np.float32(self.depth_scale_m * factor)
        return DepthView(depth_m, self.intrinsics, self.world_from_camera)


@dataclass
class Recording:
    """What is known of all frames read so far."""

    total: int  # frames in the source, 0 = unknown
    depth_unit_m: float = 0.0  # metres per unit of depth as the files hold it; 0 = as the shots say
    read: int = 0
    frame_ids: list[int] = field(default_factory=list)  # of readable frames, as the next three
    cameras: list[str] = field(default_factory=list)
    stamps_ns: list[int] = field(default_factory=list)
    world_from_camera: list[np.ndarray] = field(default_factory=list)
    unreadable: Counter[str] = field(default_factory=Counter)  # by reason
    refused: Counter[str] = field(default_factory=Counter)  # readable frames the selection does not believe, by reason
    keyframes: int = 0
    shots: list[Shot] = field(default_factory=list)
    damaged: Counter[str] = field(default_factory=Counter)  # images of the sample that could not be decoded, by reason


def has_moved(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether a camera at two poses has moved or turned enough to tell conventions apart."""
    moved = inverse(one) @ other
    return bool(np.linalg.norm(moved[:3, 3]) >= MOVED_M or rotation_angle_rad(moved) >= MOVED_RAD)


class Picker:
    """Chooses pairs of frames, spread over a recording, between which the camera has moved."""

    def __init__(self, total: int, pairs: int) -> None:
        self._spacing = max(1.0, total / pairs)
        self._begun = 0  # pairs
        self._first: tuple[int, np.ndarray] | None = None  # of the open pair

    def wants(self, index: int, world_from_camera: np.ndarray) -> bool:
        """Whether the frame belongs to the sample; frames come in their order."""
        if self._first is not None:
            if not (has_moved(self._first[1], world_from_camera) or index - self._first[0] >= REACH):
                return False
            again = index >= self._begun * self._spacing  # the second of this pair is the first of the next
            self._first = (index, world_from_camera) if again else None
            self._begun += again
            return True
        if index < self._begun * self._spacing:
            return False
        self._first = (index, world_from_camera)
        self._begun += 1
        return True


def pairs_of(shots: Sequence[Shot]) -> list[tuple[int, int]]:
    """Pairs of one camera's neighbours in a sample that lie close in the recording."""
    near = ((i, one, other) for i, (one, other) in enumerate(pairwise(shots)) if other.index - one.index <= REACH)
    return [(i, i + 1) for i, one, other in near if one.camera == other.camera]

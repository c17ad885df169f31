"""What a source hands over (pure)."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from prior_sg.schemas.codec import Message, Shape
from prior_sg.schemas.frames import Intrinsics, Pose, check_pose


class RawFrame(Message, frozen=True, kw_only=True):
    """One posed RGB-D image as a source delivers it, before selection; fields as in Keyframe."""

    frame_id: int
    stamp_ns: int
    intrinsics: Intrinsics
    world_from_camera: Pose
    color: bytes
    depth: bytes
    depth_scale_m: float
    index: int  # position in the source, from 0
    total: int  # frames in the source, 0 = unknown (live)
    mask: bytes = b""
    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    pose_only: bool = False  # of a live source, which decodes images only where a keyframe is due
    camera: str = ""  # as in Keyframe

    def check(self) -> None:
        check_pose(self.world_from_camera)
        if self.frame_id < 0:
            raise ValueError("the frame number is negative")
        if not self.depth_scale_m > 0:
            raise ValueError("depth_scale_m must be positive")


class BadFrame(Message, frozen=True, kw_only=True):
    """A frame its source could not deliver."""

    frame_id: int  # -1 = not even that is known
    reason: str
    index: int
    total: int


class Correction(Message, frozen=True, kw_only=True):
    """Corrected poses that a source carries; fields as in PoseUpdate."""

    stamp_ns: int
    frame_ids: Annotated[np.ndarray, Shape("int64", "frame")]
    world_from_camera: Annotated[np.ndarray, Shape("float64", "frame", 4, 4)]

    def check(self) -> None:
        check_pose(self.world_from_camera)


class Unused(Message, frozen=True, kw_only=True):
    """Messages of a live source that could not be used, of one kind, since the last word on them."""

    what: str  # such as "depth images"
    reason: str  # what they have in common
    count: int
    example: str  # the first one's reason, in full


class Closure(Message, frozen=True, kw_only=True):
    """A live source's poses have jumped: its SLAM has closed a loop or found its place in the map again."""

    stamp_ns: int
    after_from_before: Pose  # what the jump did to the pose of the camera, in the world

    def check(self) -> None:
        check_pose(self.after_from_before)


class Resumed(Message, frozen=True, kw_only=True):
    """The source goes on where a process that was killed had read it."""

    live: bool


class BegunAnew(Message, frozen=True, kw_only=True):
    """The source is read from its beginning, although something was kept: that was of another one."""


class EndOfSource(Message, frozen=True, kw_only=True):
    """Every frame of the source has been handed over."""


@dataclass(frozen=True)
class View:
    """What is remembered of a frame: its number, stamp and pose, and which camera took it."""

    frame_id: int
    stamp_ns: int
    world_from_camera: np.ndarray
    camera: str = ""

    @staticmethod
    def of(frame: RawFrame) -> "View":
        """A view with a pose of its own."""
        return View(frame.frame_id, frame.stamp_ns, np.array(frame.world_from_camera), frame.camera)

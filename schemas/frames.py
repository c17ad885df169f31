"""What a camera delivers: keyframes with pose, colour and depth.

World: metres, z up (against gravity). Camera: x right, y down, z forward (along the optical axis).
`world_from_camera` maps homogeneous camera coordinates to world coordinates.
"""

from typing import Annotated

import msgspec
import numpy as np

from prior_sg.schemas.codec import File, Message, Number, NumberOrNone, Shape, Stamp
from prior_sg.schemas.status import Loss

Pose = Annotated[np.ndarray, Shape("float64", 4, 4)]
ROTATION_TOLERANCE = 1e-3
MOST_KEYFRAMES = 256  # in one answer
MOST_PIXELS = 2**25  # 8K; decoded, colour and depth take 300 MB


class Intrinsics(msgspec.Struct, frozen=True):
    """Pinhole camera, pixels; pixel (0, 0) is the centre of the upper left pixel."""

    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float

    def __post_init__(self) -> None:
        if not (0 < self.width_px <= 16384 and 0 < self.height_px <= 16384):
            raise ValueError(f"image size {self.width_px} x {self.height_px} is out of range")
        if self.width_px * self.height_px > MOST_PIXELS:
            raise ValueError(f"an image of {self.width_px} x {self.height_px} has more than {MOST_PIXELS} pixels")
        if not (self.fx_px > 0 and self.fy_px > 0):
            raise ValueError("focal lengths must be positive")


def check_pose(poses: np.ndarray, name: str = "world_from_camera") -> None:
    """Raise ValueError unless the matrix, or each of several, is a rigid motion."""
    for rows in poses.reshape(-1, 4, 4).tolist():
        _check_rows(name, *rows)


def _check_rows(name: str, one: list[float], two: list[float], three: list[float], last: list[float]) -> None:
    """Plain numbers: for a single matrix, which every keyframe carries, NumPy would take five times as long."""
    (a, b, c, _), (d, e, f, _), (g, h, i, _) = one, two, three
    if not (  # also where huge entries made one of these infinite or not a number
        abs(a * a + b * b + c * c - 1) <= ROTATION_TOLERANCE
        and abs(d * d + e * e + f * f - 1) <= ROTATION_TOLERANCE
        and abs(g * g + h * h + i * i - 1) <= ROTATION_TOLERANCE
        and abs(a * d + b * e + c * f) <= ROTATION_TOLERANCE
        and abs(a * g + b * h + c * i) <= ROTATION_TOLERANCE
        and abs(d * g + e * h + f * i) <= ROTATION_TOLERANCE
    ):
        raise ValueError(f"{name}: rotation is not orthonormal")
    if a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g) <= 0:
        raise ValueError(f"{name}: rotation mirrors")
    if last != [0.0, 0.0, 0.0, 1.0]:
        raise ValueError(f"{name}: last row is not 0 0 0 1")


class Keyframe(Message, frozen=True, kw_only=True):
    """One posed RGB-D image, compressed as the source delivered it."""

    robot: str
    frame_id: Number
    stamp_ns: Stamp
    intrinsics: Intrinsics
    world_from_camera: Pose
    color: File  # a JPEG or PNG file, 8 bit RGB; empty = the sensor sees no colour
    depth: File  # a PNG file, 16 bit, 0 = no measurement; depth along the optical axis
    depth_scale_m: float  # metres per depth unit
    mask: File = b""  # a PNG file, 8 bit, not 0 = something that moves, kept out of the map; empty = nothing does
    space: str = ""  # of an encoding job: the embedding space wanted; empty = every space that has workers
    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # where this world has its zero in the source's, levelled
    camera: str = ""  # which of a robot's cameras took it; empty = its only one

    def check(self) -> None:
        check_pose(self.world_from_camera)
        if self.frame_id < 0:
            raise ValueError("frame_id is negative")
        if not self.depth_scale_m > 0:
            raise ValueError("depth_scale_m must be positive")


class PoseUpdate(Message, frozen=True, kw_only=True):
    """Better poses of keyframes already seen, as a loop closure or an external SLAM gives them.

    Each named keyframe stands corrected from now on; all others keep the pose they have. A keyframe may be named before
    it arrives. Per epoch the revision rises; a repeat is ignored.
    """

    robot: str
    epoch: Number  # new at every start of the writer
    revision: Number  # rises per update of this writer, from 0
    stamp_ns: Stamp  # when the correction was made
    frame_ids: Annotated[np.ndarray, Shape("int64", "frame")]
    world_from_camera: Annotated[np.ndarray, Shape("float64", "frame", 4, 4)]

    def check(self) -> None:
        check_pose(self.world_from_camera)
        if (self.frame_ids < 0).any():
            raise ValueError("frame_ids: a number is negative")
        if len(np.unique(self.frame_ids)) != len(self.frame_ids):
            raise ValueError("frame_ids: a number repeats")


class CameraState(Message, frozen=True, kw_only=True):
    """Where the camera is now, also between keyframes."""

    robot: str
    stamp_ns: Stamp
    world_from_camera: Pose

    def check(self) -> None:
        check_pose(self.world_from_camera)


class IngestState(Message, frozen=True, kw_only=True):
    """How far the source is; `finished` when every keyframe has been published and encoded."""

    robot: str
    stamp_ns: Stamp
    frames_read: Number
    frames_total: Number  # 0 = unknown (live)
    keyframes: Number
    encoded: Number
    rejected: Number  # frames refused by the source or the keyframe selection; `losses` says why
    finished: bool
    skipped: Number = 0  # keyframes that nobody encoded: a newer one came first, or no worker could
    losses: list[Loss] = []  # what of the source could not be used, most frequent first


class ArchiveRequest(Message, frozen=True, kw_only=True):
    """Keyframes with first_frame_id <= frame_id < end_frame_id, at most `limit` of them, oldest first."""

    robot: str
    first_frame_id: Number = 0
    end_frame_id: Number = 2**62
    limit: Annotated[int, msgspec.Meta(ge=1, le=MOST_KEYFRAMES)] = 16


class ArchiveReply(Message, frozen=True, kw_only=True):
    """Archived keyframes; `oldest_frame_id` says where the ring begins (-1 = empty)."""

    robot: str
    oldest_frame_id: NumberOrNone
    keyframes: list[Keyframe]

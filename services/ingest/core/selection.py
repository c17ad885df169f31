"""Which frames of a posed RGB-D stream become keyframes, and which cannot be true (pure).

A frame is refused when it cannot follow its predecessors: its stamp or number does not rise, or its pose jumps faster
than the camera can move. Of the others a frame becomes a keyframe when the camera has moved or turned enough since the
last keyframe, or enough time has passed. Keyframes go to the map (KEYFRAME), to the pool of encoders (ENCODE), and into
an archive from which late readers may ask for them again (ARCHIVE).
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import islice
from typing import Annotated

import msgspec
import numpy as np

from prior_sg.schemas.codec import Message, Shape
from prior_sg.schemas.features import Backfill
from prior_sg.schemas.frames import (
    ArchiveReply,
    ArchiveRequest,
    CameraState,
    IngestState,
    Intrinsics,
    Keyframe,
    Pose,
    PoseUpdate,
    check_pose,
)
from prior_sg.schemas.status import JobDone
from prior_sg.schemas.topics import CAMERA_STATE, ENCODE, INGEST_STATE, KEYFRAME, POSE_UPDATE, Topic
from prior_sg.services.geometry import inverse, rotation_angle_rad
from prior_sg.services.ingest.core.archive import KeyframeArchive
from prior_sg.services.ingest.core.config import Config

Written = tuple[Topic, Message]


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


class EndOfSource(Message, frozen=True, kw_only=True):
    """Every frame of the source has been handed over."""


@dataclass(frozen=True)
class View:
    """What is remembered of a frame: its number, stamp and pose."""

    frame_id: int
    stamp_ns: int
    world_from_camera: np.ndarray

    @staticmethod
    def of(frame: RawFrame) -> "View":
        """A view with a pose of its own."""
        return View(frame.frame_id, frame.stamp_ns, np.array(frame.world_from_camera))


@dataclass
class State:
    """Progress of one source."""

    robot: str
    epoch: int = 0
    last: View | None = None  # newest frame believed
    jumped: View | None = None  # frame refused because its pose jumped, if that was the newest frame
    keyframe: View | None = None  # newest keyframe
    read: int = 0
    total: int = 0
    rejected: int = 0
    keyframes: int = 0
    encoded: int = 0
    skipped: int = 0
    corrections: int = 0  # pose updates published
    encoding: set[int] = field(default_factory=set)  # numbers of keyframes whose job is not done
    ended: bool = False
    archive: KeyframeArchive = field(default_factory=KeyframeArchive)


def refusal(state: State, frame: RawFrame, cfg: Config) -> str | None:
    """Why this frame cannot follow the ones before it; None when it can."""
    last = state.last
    if last is None:
        return None
    if frame.stamp_ns <= last.stamp_ns:
        return f"its stamp is {(last.stamp_ns - frame.stamp_ns) / 1e9:.3f} s before the previous frame's"
    if frame.frame_id <= last.frame_id:
        return f"its number does not rise: frame {last.frame_id} came before"
    if _reachable(last, frame, cfg) or (state.jumped is not None and _reachable(state.jumped, frame, cfg)):
        return None  # a tracker that stays where it jumped to has found its place again
    distance_m = np.linalg.norm(frame.world_from_camera[:3, 3] - last.world_from_camera[:3, 3])
    return f"its pose jumps by {distance_m:.2f} m in {(frame.stamp_ns - last.stamp_ns) / 1e9:.3f} s"


def refuse(state: State, frame: RawFrame) -> Iterator[Written]:
    """Count a frame that `refusal` named."""
    forward = state.last is not None and frame.stamp_ns > state.last.stamp_ns and frame.frame_id > state.last.frame_id
    state.jumped = View.of(frame) if forward else state.jumped
    yield from _lose(state, frame.total)


def lose(state: State, bad: BadFrame) -> Iterator[Written]:
    """Count a frame that the source could not deliver."""
    yield from _lose(state, bad.total)


def accept(state: State, frame: RawFrame, cfg: Config) -> Iterator[Written]:
    """Report the camera, and make the frame a keyframe when it is due."""
    state.read, state.total = state.read + 1, frame.total
    state.last, state.jumped = View.of(frame), None
    yield (
        CAMERA_STATE,
        CameraState(robot=state.robot, stamp_ns=frame.stamp_ns, world_from_camera=frame.world_from_camera),
    )
    if due(state.keyframe, frame, cfg):
        state.keyframe = state.last
        keyframe = _keyframe(state, frame)
        state.archive.put(keyframe, cfg.archive_mb * 1e6)
        state.keyframes += 1
        state.encoding.add(keyframe.frame_id)
        yield KEYFRAME, keyframe
        yield ENCODE, keyframe
    yield progress(state)


def due(keyframe: View | None, frame: RawFrame, cfg: Config) -> bool:
    """Whether the camera has moved, turned or waited enough since the last keyframe."""
    if keyframe is None or cfg.every_frame:
        return True
    keyframe_from_camera = inverse(keyframe.world_from_camera) @ frame.world_from_camera
    waited_s = (frame.stamp_ns - keyframe.stamp_ns) / 1e9
    return bool(
        np.linalg.norm(keyframe_from_camera[:3, 3]) >= cfg.min_translation_m
        or math.degrees(rotation_angle_rad(keyframe_from_camera)) >= cfg.min_rotation_deg
        or 0 < cfg.max_interval_s <= waited_s
    )


def encoded(state: State, done: JobDone) -> Iterator[Written]:
    """Count a keyframe that a worker has encoded, or that was given up; a second report of the same changes nothing."""
    if done.frame_id in state.encoding:
        state.encoding.remove(done.frame_id)
        state.encoded += not done.error
        state.skipped += bool(done.error)
        yield progress(state)


def backfill(state: State, wish: Backfill) -> Iterator[Written]:
    """Encode archived keyframes again, in one space: those that the asking reader lacks. They give way to new ones."""
    for keyframe in state.archive.lacked(wish):
        yield ENCODE, msgspec.structs.replace(keyframe, space=wish.space)


def announce(state: State, correction: Correction) -> Iterator[Written]:
    """Publish corrected poses of the source; the archive follows when the update comes back, as anybody's does."""
    yield (
        POSE_UPDATE,
        PoseUpdate(
            robot=state.robot,
            epoch=state.epoch,
            revision=state.corrections,
            stamp_ns=correction.stamp_ns,
            frame_ids=correction.frame_ids,
            world_from_camera=correction.world_from_camera,
        ),
    )
    state.corrections += 1


def correct(state: State, update: PoseUpdate) -> None:
    """Give archived keyframes their corrected poses, so that whoever fetches them later maps them where they are."""
    state.archive.correct(dict(zip(update.frame_ids.tolist(), update.world_from_camera, strict=True)))


def end(state: State) -> Iterator[Written]:
    """Remember that nothing more comes."""
    state.ended = True
    yield progress(state)


def progress(state: State) -> Written:
    """How far the source is."""
    return INGEST_STATE, IngestState(
        robot=state.robot,
        stamp_ns=0 if state.last is None else state.last.stamp_ns,
        frames_read=state.read,
        frames_total=state.total,
        keyframes=state.keyframes,
        encoded=state.encoded,
        rejected=state.rejected,
        skipped=state.skipped,
        finished=state.ended and not state.encoding,
    )


def archived(state: State, request: ArchiveRequest, cfg: Config) -> ArchiveReply:
    """Archived keyframes within the requested numbers, oldest first."""
    return ArchiveReply(
        robot=state.robot,
        oldest_frame_id=state.archive.oldest_frame_id,
        keyframes=list(
            islice(state.archive.between(request.first_frame_id, request.end_frame_id), max(0, request.limit))
        ),
    )


def _reachable(view: View, frame: RawFrame, cfg: Config) -> bool:
    if cfg.max_speed_m_s <= 0:
        return True
    distance_m = np.linalg.norm(frame.world_from_camera[:3, 3] - view.world_from_camera[:3, 3])
    return bool(distance_m <= cfg.max_speed_m_s * (frame.stamp_ns - view.stamp_ns) / 1e9)


def _lose(state: State, total: int) -> Iterator[Written]:
    state.read, state.total, state.rejected = state.read + 1, total, state.rejected + 1
    yield progress(state)


def _keyframe(state: State, frame: RawFrame) -> Keyframe:
    return Keyframe(
        robot=state.robot,
        frame_id=frame.frame_id,
        stamp_ns=frame.stamp_ns,
        intrinsics=frame.intrinsics,
        world_from_camera=np.array(frame.world_from_camera),
        color=frame.color,
        depth=frame.depth,
        depth_scale_m=frame.depth_scale_m,
        mask=frame.mask,
        origin_m=frame.origin_m,
    )

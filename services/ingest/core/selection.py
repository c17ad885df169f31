"""Which frames of a posed RGB-D stream become keyframes, and which cannot be true (pure).

A frame is refused when it cannot follow its predecessors: its stamp or number does not rise, or its pose jumps faster
than the camera can move. Of the others a frame becomes a keyframe when the camera has moved or turned enough since the
last keyframe, or enough time has passed. Keyframes go to the map (KEYFRAME), to the pool of encoders (ENCODE), and into
a ring from which late readers may ask for them again (ARCHIVE).
"""

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Annotated, Literal

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
from prior_sg.services.ingest.core.options import ReadOptions

ON_THE_WAY = 16  # keyframes whose pyramids may overtake each other
Written = tuple[Topic, Message]


class Config(ReadOptions, frozen=True, kw_only=True):
    """Where frames come from, how they are read, and which of them become keyframes.

    The paper does not publish its selection; this one is chosen on the development sequences so that neighbouring
    keyframes overlap by more than half at 60 to 75 degrees of view.
    """

    source: str = ""  # a folder of a layout in docs/sources.md, or an MCAP log; empty = no source
    speed: float = 0.0  # times real time, by stamps; 0 = as fast as the pipeline drains
    when_behind: Literal["wait", "skip"] = "wait"  # wait for slow workers, or keep pace and encode only the newest
    window: int = (
        8  # keyframes under way before the source waits, or older ones are skipped; below the publisher's cache
    )
    every_frame: bool = False  # make every frame a keyframe
    min_translation_m: float = 0.25  # camera motion since the last keyframe that makes the next
    min_rotation_deg: float = 12.0  # the same for turning
    max_interval_s: float = 2.0  # the same for time, so that a resting camera still reports; 0 = never
    max_speed_m_s: float = 10.0  # faster camera motion is a jump of the tracker, and refused; 0 = believe everything
    archive_mb: float = 256.0  # compressed keyframes kept for ARCHIVE, oldest dropped first


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
    archive: deque[Keyframe] = field(default_factory=deque)
    archive_bytes: int = 0


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
        _archive(state, keyframe, cfg)
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
    """Encode archived keyframes again, in one space: those that the asking reader lacks. They give way to new ones.

    Unless the reader has settled, the newest ones are left out: their pyramids may be on the way to it. Those older
    than all it knows are not: they were there before it, or before the workers of that space.
    """
    known = set(wish.frame_ids.tolist())
    oldest, newest = min(known, default=0), max(known, default=-1)
    later = [keyframe for keyframe in state.archive if oldest <= keyframe.frame_id <= newest]
    unwanted = known if wish.settled else known | {keyframe.frame_id for keyframe in later[-ON_THE_WAY:]}
    for keyframe in state.archive:
        wanted = wish.settled or keyframe.frame_id <= newest
        if wanted and keyframe.frame_id not in unwanted:
            yield ENCODE, msgspec.structs.replace(keyframe, space=wish.space)


def announce(state: State, correction: Correction) -> Iterator[Written]:
    """Publish corrected poses of the source; the ring follows when the update comes back, as anybody's does."""
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
    poses = dict(zip(update.frame_ids.tolist(), update.world_from_camera, strict=True))
    for position, keyframe in enumerate(state.archive):
        if keyframe.frame_id in poses:
            pose = np.array(poses[keyframe.frame_id])
            state.archive[position] = msgspec.structs.replace(keyframe, world_from_camera=pose)


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
    """Keyframes of the ring within the requested numbers, oldest first."""
    wanted = (k for k in state.archive if request.first_frame_id <= k.frame_id < request.end_frame_id)
    return ArchiveReply(
        robot=state.robot,
        oldest_frame_id=state.archive[0].frame_id if state.archive else -1,
        keyframes=[keyframe for _, keyframe in zip(range(request.limit), wanted, strict=False)],
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
    )


def _archive(state: State, keyframe: Keyframe, cfg: Config) -> None:
    state.archive.append(keyframe)
    state.archive_bytes += _size(keyframe)
    while state.archive_bytes > cfg.archive_mb * 1e6:
        state.archive_bytes -= _size(state.archive.popleft())


def _size(keyframe: Keyframe) -> int:
    return len(keyframe.color) + len(keyframe.depth) + len(keyframe.mask)

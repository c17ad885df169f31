"""Which frames of a posed RGB-D stream become keyframes, and which cannot be true (pure).

A frame is refused when it cannot follow its predecessors: its stamp or number does not rise (but see continuity.py), or
its pose jumps faster than the camera can move. Of the others a frame becomes a keyframe when the camera has moved or
turned enough since the last keyframe, or enough time has passed. Keyframes go to the map (KEYFRAME), to the pool of
encoders (ENCODE), and into an archive from which late readers may ask for them again (ARCHIVE).
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import islice

import msgspec
import numpy as np

from prior_sg.schemas.codec import Message
from prior_sg.schemas.features import Backfill
from prior_sg.schemas.frames import (
    ArchiveReply,
    ArchiveRequest,
    CameraState,
    IngestState,
    Keyframe,
    PoseUpdate,
)
from prior_sg.schemas.status import JobDone, Loss
from prior_sg.schemas.topics import CAMERA_STATE, ENCODE, INGEST_STATE, KEYFRAME, POSE_UPDATE, Topic
from prior_sg.services.geometry import inverse, rotation_angle_rad
from prior_sg.services.ingest.core.archive import KeyframeArchive
from prior_sg.services.ingest.core.checkpoint import Checkpoint, Keeper
from prior_sg.services.ingest.core.closures import spread
from prior_sg.services.ingest.core.config import Config
from prior_sg.services.ingest.core.continuity import BELIEVED_AFTER, POSES_JUMP, Continuity, Held, Refusal, reachable
from prior_sg.services.ingest.core.frames import BadFrame, Closure, Correction, RawFrame, Unused, View
from prior_sg.services.losses import Losses

Written = tuple[Topic, Message]
REFUSED, UNREADABLE, GIVEN_UP, CLOCK_JUMPS = "frames refused", "frames unreadable", "keyframes given up", "clock jumps"


@dataclass
class State:
    """Progress of one source."""

    robot: str
    epoch: int = 0
    last: View | None = None  # newest frame believed
    cameras: dict[str, "Camera"] = field(default_factory=dict)  # of the robot, by name
    index: int = -1  # position in the source of the newest frame believed
    read: int = 0
    total: int = 0
    rejected: int = 0
    keyframes: int = 0
    encoded: int = 0
    skipped: int = 0
    corrections: int = 0  # pose updates published
    encoding: set[int] = field(default_factory=set)  # numbers of keyframes whose job is not done
    backfilled: tuple[int, int] = (-1, -1)  # epoch and number of the newest wish of a reader that was heard
    ended: bool = False
    trail: list[View] = field(default_factory=list)  # keyframes since the poses last jumped
    continuity: Continuity = field(default_factory=Continuity)
    losses: Losses = field(default_factory=Losses)
    archive: KeyframeArchive = field(default_factory=KeyframeArchive)
    keeper: Keeper | None = None  # of the archive beyond the end of the process
    checkpoint: Checkpoint | None = None  # as it would be kept
    not_kept: str = ""  # why nothing can be kept any more; empty = it can, or is not meant to be


@dataclass
class Camera:
    """What is remembered of one of a robot's cameras, each of which goes its own way."""

    last: View | None = None  # newest frame believed
    jumped: View | None = None  # frame refused because its pose jumped, if that was the newest frame
    keyframe: View | None = None  # newest keyframe


@dataclass(frozen=True)
class Verdict:
    """What becomes of a frame, and of those that were held back for it. All but `held` have the stream's numbers."""

    accepted: list[RawFrame] = field(default_factory=list)
    refused: list[Held] = field(default_factory=list)
    held: Refusal | None = None  # why the frame is held back
    jump: str = ""  # how the clock or the count jumped that is believed again


def judge(state: State, frame: RawFrame, cfg: Config) -> Verdict:
    """Whether a frame can follow the ones before it; nobody hears of it before `accept` or `refuse`."""
    line, last, shifted = state.continuity, state.last, state.continuity.shifted(frame)
    state.total = frame.total
    refusal = None if last is None else line.out_of_line(last, shifted)
    if last is None or refusal is None:
        waiting = line.release()
        if (jump := _jump(camera_of(state, shifted.camera), shifted, cfg)) is not None:
            return Verdict(refused=[*waiting, Held(shifted, jump)])
        line.interval_ns = 0 if last is None else shifted.stamp_ns - last.stamp_ns
        return Verdict([shifted], waiting)
    dropped = line.hold(frame, refusal, cfg)
    if len(line.held) < BELIEVED_AFTER:
        return Verdict(refused=dropped, held=refusal)
    frames, jump_text = line.believe(last)
    state.losses.add(CLOCK_JUMPS, jump_text, reason="believed again")
    return Verdict(frames, dropped, jump=jump_text)


def refuse(state: State, held: Held) -> Iterator[Written]:
    """Count a frame that `judge` refused."""
    if held.refusal.kind == POSES_JUMP:
        camera_of(state, held.frame.camera).jumped = View.of(held.frame)
    _count_refused(state.losses, held)
    yield from _lose(state, held.frame.total)


def lose(state: State, bad: BadFrame) -> Iterator[Written]:
    """Count a frame that the source could not deliver."""
    state.losses.add(UNREADABLE, bad.reason, of=f"frame {bad.frame_id}" if bad.frame_id >= 0 else "")
    yield from _lose(state, bad.total)


def pass_over(state: State, unused: Unused) -> Iterator[Written]:
    """Count messages that a live source could not use."""
    state.losses.add(unused.what, unused.example, reason=unused.reason, count=unused.count)
    yield progress(state)


def accept(state: State, frame: RawFrame, cfg: Config) -> Iterator[Written]:
    """Report the camera, and make the frame a keyframe when it is due."""
    state.read, state.total, state.index = state.read + 1, frame.total, frame.index
    camera = camera_of(state, frame.camera)
    state.last = camera.last = View.of(frame)
    camera.jumped = None
    yield (
        CAMERA_STATE,
        CameraState(robot=state.robot, stamp_ns=frame.stamp_ns, world_from_camera=frame.world_from_camera),
    )
    if not frame.pose_only and due(camera.keyframe, frame, cfg):
        camera.keyframe = state.last
        state.trail.append(state.last)
        keyframe = _keyframe(state, frame)
        state.archive.put(keyframe, cfg.archive_mb * 1e6)
        state.keyframes += 1
        yield KEYFRAME, keyframe
        if keyframe.color:  # a lidar alone sees nothing that could be encoded
            state.encoding.add(keyframe.frame_id)
            yield ENCODE, keyframe
    yield progress(state)


def due(keyframe: View | None, frame: RawFrame | View, cfg: Config) -> bool:
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
        if done.error:
            state.skipped += 1
            state.losses.add(GIVEN_UP, done.error, of=f"keyframe {done.frame_id}")
        yield progress(state)


def backfill(state: State, wish: Backfill) -> Iterator[Written]:
    """Encode archived keyframes again, in one space: those that the asking reader lacks. They give way to new ones.

    A wish that was heard before this process began comes again from its writer's cache: what it asked for is done.
    """
    if wish.epoch > 0 and (wish.epoch, wish.number) <= state.backfilled:
        return
    state.backfilled = max(state.backfilled, (wish.epoch, wish.number))
    for keyframe in state.archive.lacked(wish):
        if not keyframe.color:
            continue
        yield ENCODE, msgspec.structs.replace(keyframe, space=wish.space)


def announce(state: State, correction: Correction) -> Iterator[Written]:
    """Publish corrected poses of the source; the archive follows when the update comes back, as anybody's does."""
    ids = correction.frame_ids + state.continuity.number_offset
    yield from _update(state, correction.stamp_ns, ids, correction.world_from_camera)


def close_loop(state: State, closure: Closure) -> Iterator[Written]:
    """Publish what a jump of a live source's poses says of the keyframes before it."""
    if state.last is None or not state.trail:
        return
    moved = np.array(closure.after_from_before)
    poses = spread(state.trail, state.last, moved)
    trail, state.trail = state.trail, []
    state.last = _moved(state.last, moved)
    for camera in state.cameras.values():
        camera.last = _moved(camera.last, moved) if camera.last is not None else None
    for view, pose in zip(trail, poses, strict=True):
        camera_of(state, view.camera).keyframe = replace(view, world_from_camera=pose)
    ids = np.array([view.frame_id for view in trail], np.int64)
    yield from _update(state, closure.stamp_ns, ids, np.stack(poses))


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
        frames_read=state.read + len(state.continuity.held),
        frames_total=state.total,
        keyframes=state.keyframes,
        encoded=state.encoded,
        rejected=state.rejected + len(state.continuity.held),
        skipped=state.skipped,
        finished=state.ended and not state.encoding,
        losses=losses(state),
    )


def losses(state: State) -> list[Loss]:
    """What could not be used; frames held back are among it until those after them are known."""
    counted = state.losses.copy()
    for held in state.continuity.held:
        _count_refused(counted, held)
    return counted.told


def archived(state: State, request: ArchiveRequest, cfg: Config) -> ArchiveReply:
    """Archived keyframes within the requested numbers, oldest first."""
    return ArchiveReply(
        robot=state.robot,
        oldest_frame_id=state.archive.oldest_frame_id,
        keyframes=list(
            islice(state.archive.between(request.first_frame_id, request.end_frame_id), max(0, request.limit))
        ),
    )


def _update(state: State, stamp_ns: int, frame_ids: np.ndarray, world_from_camera: np.ndarray) -> Iterator[Written]:
    """The next pose update: numbers (n,) of the stream, poses (n, 4, 4)."""
    yield (
        POSE_UPDATE,
        PoseUpdate(
            robot=state.robot,
            epoch=state.epoch,
            revision=state.corrections,
            stamp_ns=stamp_ns,
            frame_ids=frame_ids,
            world_from_camera=world_from_camera,
        ),
    )
    state.corrections += 1


def camera_of(state: State, name: str) -> Camera:
    """What is remembered of a camera, by its name."""
    return state.cameras.setdefault(name, Camera())


def _moved(view: View, motion: np.ndarray) -> View:
    return replace(view, world_from_camera=motion @ view.world_from_camera)


def _jump(camera: Camera, frame: RawFrame, cfg: Config) -> Refusal | None:
    """Why the pose cannot follow; a tracker that stays where it jumped to has found its place again."""
    last, jumped = camera.last, camera.jumped
    if last is None or reachable(last, frame, cfg) or (jumped is not None and reachable(jumped, frame, cfg)):
        return None
    distance_m = np.linalg.norm(frame.world_from_camera[:3, 3] - last.world_from_camera[:3, 3])
    text = f"its pose jumps by {distance_m:.2f} m in {(frame.stamp_ns - last.stamp_ns) / 1e9:.3f} s"
    return Refusal(POSES_JUMP, text)


def _count_refused(losses: Losses, held: Held) -> None:
    losses.add(REFUSED, held.refusal.text, reason=held.refusal.kind, of=f"frame {held.frame.frame_id}")


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
        camera=frame.camera,
    )

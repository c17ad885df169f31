"""What is handed to the keeper of the archive, and when (pure but for the keeper)."""

from collections.abc import Callable

import msgspec
import numpy as np

from prior_sg.schemas.codec import Message
from prior_sg.schemas.features import Backfill
from prior_sg.schemas.frames import Keyframe, PoseUpdate
from prior_sg.schemas.status import JobDone
from prior_sg.services.ingest.core.checkpoint import Checkpoint, Keeper, NotKeptError, Sight
from prior_sg.services.ingest.core.frames import BegunAnew, Closure, View
from prior_sg.services.ingest.core.selection import State

NOT_KEPT = "keyframes not kept on disk"


def keep(state: State, keyframe: Keyframe) -> None:
    """Keep a keyframe that nobody has heard of yet: then no number is ever given twice."""
    known = state.checkpoint = checkpoint_of(state)
    _with_keeper(state, lambda keeper: keeper.keep(keyframe, state.archive.oldest_frame_id, known))
    if state.not_kept:
        state.losses.add(NOT_KEPT, state.not_kept, of=f"keyframe {keyframe.frame_id}")


def keep_after(state: State, message: Message) -> None:
    """Keep what another input has changed."""
    known = state.checkpoint
    match message:
        case BegunAnew():
            _with_keeper(state, lambda keeper: keeper.begin())
        case PoseUpdate():
            moved = set(message.frame_ids.tolist())
            keyframes = [keyframe for keyframe in state.archive if keyframe.frame_id in moved]
            _with_keeper(state, lambda keeper: keeper.correct(keyframes))
        case JobDone() if known is not None:
            counted = state.checkpoint = _counted(known, state)
            _with_keeper(state, lambda keeper: keeper.ended(message.frame_id, counted))
        case Backfill() if known is not None:
            counted = state.checkpoint = _counted(known, state)
            _with_keeper(state, lambda keeper: keeper.mark(counted))
        case Closure() if known is not None:
            jumped = state.checkpoint = checkpoint_of(state)
            _with_keeper(state, lambda keeper: keeper.mark(jumped))


def checkpoint_of(state: State) -> Checkpoint:
    """The state as it is when a keyframe has just been accepted, or the poses have jumped."""
    line = state.continuity
    newest = [camera.last for camera in state.cameras.values() if camera.last is not None]
    keyframes = [camera.keyframe for camera in state.cameras.values() if camera.keyframe is not None]
    return Checkpoint(
        index=state.index,
        frames=[_sight(view) for view in sorted(newest, key=lambda view: view.frame_id)],
        keyframes_seen=[_sight(view) for view in keyframes],
        trail_from=state.trail[0].frame_id if state.trail else -1,
        offset_ns=line.offset_ns,
        number_offset=line.number_offset,
        interval_ns=line.interval_ns,
        read=state.read,
        total=state.total,
        rejected=state.rejected,
        keyframes=state.keyframes,
        encoded=state.encoded,
        skipped=state.skipped,
        backfilled=state.backfilled,
        losses=state.losses.told,
    )


def _sight(view: View) -> Sight:
    return Sight(
        camera=view.camera,
        frame_id=view.frame_id,
        stamp_ns=view.stamp_ns,
        world_from_camera=np.array(view.world_from_camera),
    )


def _counted(checkpoint: Checkpoint, state: State) -> Checkpoint:
    """The same place in the source: the frames since will be read again, so that what they were counted for is left
    out."""
    return msgspec.structs.replace(
        checkpoint, encoded=state.encoded, skipped=state.skipped, backfilled=state.backfilled
    )


def _with_keeper(state: State, does: Callable[[Keeper], None]) -> None:
    if state.keeper is None:
        return
    try:
        does(state.keeper)
    except NotKeptError as error:
        state.keeper, state.not_kept = None, str(error)

"""Going on where the process before was (pure but for the keeper)."""

from collections import deque
from collections.abc import Iterator
from dataclasses import fields

import numpy as np

from prior_sg.schemas.frames import Keyframe
from prior_sg.schemas.topics import ENCODE, KEYFRAME
from prior_sg.services.ingest.core.checkpoint import Kept, Sight
from prior_sg.services.ingest.core.config import Config
from prior_sg.services.ingest.core.continuity import Continuity
from prior_sg.services.ingest.core.frames import View
from prior_sg.services.ingest.core.selection import State, Written, camera_of, progress
from prior_sg.services.losses import Losses

AS_KEPT = ("index", "read", "total", "rejected", "keyframes", "encoded", "skipped", "backfilled")


def resume(state: State, kept: Kept, cfg: Config) -> None:
    """Make an empty state go on from what was kept."""
    known = state.checkpoint = kept.checkpoint
    for sight in known.frames:
        state.last = camera_of(state, sight.camera).last = _view(sight)
    for sight in known.keyframes_seen:
        camera_of(state, sight.camera).keyframe = _view(sight)
    state.continuity = Continuity(known.offset_ns, known.number_offset, known.interval_ns)
    state.losses = Losses.of(known.losses)
    for name in AS_KEPT:
        setattr(state, name, getattr(known, name))
    for keyframe in kept.keyframes:
        state.archive.put(keyframe, cfg.archive_mb * 1e6)
    if known.trail_from >= 0:
        trail = state.archive.between(known.trail_from, known.frame_id + 1)
        state.trail = [_view(one) for one in trail]
    state.encoding = kept.owed & {keyframe.frame_id for keyframe in state.archive}
    state.skipped += len(kept.owed - state.encoding)


def tell_again(state: State, live: bool) -> Iterator[Written]:
    """Publish what readers would have found in the publisher's cache of the process before, and the jobs not done.

    A live source numbers its frames from zero: its numbers go on from the newest.
    """
    if live and state.last is not None:
        state.continuity.number_offset = state.last.frame_id + 1
        state.continuity.interval_ns = 0
    yield from ((KEYFRAME, keyframe) for keyframe in deque(state.archive, KEYFRAME.cache))
    yield from ((ENCODE, keyframe) for keyframe in state.archive if keyframe.frame_id in state.encoding)
    yield progress(state)


def forget(state: State) -> None:
    """Make it the state of a source of which nothing was read; what was kept is overwritten with the next keyframe."""
    fresh = State(state.robot, state.epoch, keeper=state.keeper)
    for one in fields(State):
        setattr(state, one.name, getattr(fresh, one.name))


def _view(seen: Sight | Keyframe) -> View:
    return View(seen.frame_id, seen.stamp_ns, np.array(seen.world_from_camera), seen.camera)

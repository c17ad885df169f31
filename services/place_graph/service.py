"""Reads keyframes, keeps the map and the place graph, writes what changed."""

import logging
from collections.abc import Iterator

from prior_sg.schemas.codec import Message
from prior_sg.schemas.frames import ArchiveReply, ArchiveRequest, Keyframe, PoseUpdate
from prior_sg.schemas.places import MapRequest, PlaceDelta, SnapshotRequest, VoxelMap
from prior_sg.schemas.topics import ARCHIVE, EPOCH, KEYFRAME, PLACE_DELTA, PLACE_SNAPSHOT, POSE_UPDATE, VOXEL_MAP
from prior_sg.services.place_graph.core import publishing, update
from prior_sg.services.place_graph.core.config import Config
from prior_sg.services.place_graph.core.state import State, empty
from prior_sg.services.refusals import NotYet
from prior_sg.services.runtime.service import Ask, Identity, Output, Service

log = logging.getLogger(__name__)


def init(cfg: Config, identity: Identity) -> State:
    """An empty map."""
    return empty(identity.robot, identity.epoch, cfg)


def step(state: State, message: Message, cfg: Config) -> Iterator[Output]:
    """One keyframe gives one delta, with or without changes; a repeated keyframe gives nothing.

    A process that joins in mid-stream fetches what it has missed from the archive, page by page. Until it has, it tells
    nothing, so that readers keep the map of its predecessor, and then everything at once.
    """
    match message:
        case Keyframe():
            if not state.seen and message.frame_id > 0:
                state.joined_frame_id, state.behind = message.frame_id, True
                yield _ask_archive(state.robot, 0, message.frame_id)
            yield from _map(state, message, cfg)
            yield from _waited(state, cfg)
        case PoseUpdate():
            yield from _told(state, update.correct(state, message, cfg))
        case ArchiveReply():
            for keyframe in message.keyframes:
                yield from _map(state, keyframe, cfg)
            state.unanswered = 0
            if message.keyframes:
                yield _ask_archive(state.robot, message.keyframes[-1].frame_id + 1, state.joined_frame_id)
            else:
                yield from _caught_up(state, cfg)


def _waited(state: State, cfg: Config) -> Iterator[Output]:
    """An archive that does not answer is not waited for without end."""
    state.unanswered += 1
    if state.behind and state.unanswered >= cfg.archive_patience:
        log.warning("the archive does not answer: the map is told as it is", extra={"keyframes": len(state.seen)})
        yield from _caught_up(state, cfg)


def _caught_up(state: State, cfg: Config) -> Iterator[Output]:
    if state.behind:
        state.behind = False
        yield PLACE_DELTA, publishing.snapshot(state, cfg)


def _ask_archive(robot: str, first_frame_id: int, end_frame_id: int) -> Ask:
    return Ask(ARCHIVE, ArchiveRequest(robot=robot, first_frame_id=first_frame_id, end_frame_id=end_frame_id))


def _map(state: State, keyframe: Keyframe, cfg: Config) -> Iterator[Output]:
    if keyframe.frame_id not in state.seen:
        yield from _told(state, update.integrate(state, keyframe, cfg))


def _told(state: State, delta: PlaceDelta | None) -> Iterator[Output]:
    """Publish a delta, unless the map is not caught up; what was wrong goes to the log too."""
    if delta is not None:
        if delta.event:
            log.warning(delta.event, extra={"frame": delta.frame_id})
        if not state.behind:
            yield PLACE_DELTA, delta


def _snapshot(state: State, request: SnapshotRequest, cfg: Config) -> PlaceDelta:
    if state.behind:
        raise NotYet("the map is being built again from the archive; ask again")
    return publishing.snapshot(state, cfg)


def _voxel_map(state: State, request: MapRequest, cfg: Config) -> VoxelMap:
    return publishing.voxel_map(state, cfg)


SERVICE = Service(
    "place_graph",
    purpose=__doc__ or "",
    scope="robot",
    config=Config,
    init=init,
    step=step,
    reads=(KEYFRAME, POSE_UPDATE),
    writes=(PLACE_DELTA,),
    asks=(ARCHIVE, EPOCH),
    losses=State.losses,
    answers={PLACE_SNAPSHOT: _snapshot, VOXEL_MAP: _voxel_map},
)

"""Reads keyframes, keeps the map and the place graph, writes what changed."""

import logging
from collections.abc import Iterator

from prior_sg.schemas.codec import LAST_NUMBER, Message
from prior_sg.schemas.frames import ArchiveReply, ArchiveRequest, Keyframe, PoseUpdate
from prior_sg.schemas.places import MapRequest, PlaceDelta, SnapshotRequest, VoxelMap
from prior_sg.schemas.scene import Scene, SceneRequest
from prior_sg.schemas.succession import Bequest, Succession, TakesOver
from prior_sg.schemas.topics import ARCHIVE, EPOCH, KEYFRAME, PLACE_DELTA, PLACE_SNAPSHOT, POSE_UPDATE, SCENE, VOXEL_MAP
from prior_sg.services.place_graph.core import publishing, succession, update
from prior_sg.services.place_graph.core.config import Config
from prior_sg.services.place_graph.core.state import Legacy, State, empty
from prior_sg.services.refusals import NotYet
from prior_sg.services.runtime.service import Ask, Handover, Identity, Output, Pause, Service

log = logging.getLogger(__name__)


def init(cfg: Config, identity: Identity) -> State:
    """An empty map."""
    return empty(identity.robot, identity.epoch, cfg)


def step(state: State, message: Message, cfg: Config) -> Iterator[Output]:
    """One keyframe gives one delta, with or without changes, a large one several; a repeated keyframe gives nothing.

    A process that joins in mid-stream fetches what it has missed from the archive, page by page, and hears from its
    predecessor, or from the store, which ids places have. Until it has, and while another is in charge, it tells
    nothing, so that readers keep the map they have; then everything at once.
    """
    tells = not state.silent
    match message:
        case Keyframe():
            if not state.seen and not state.behind and message.frame_id > 0:
                yield from _catch_up(state, message.frame_id)
                tells = False
            yield from _map(state, message, cfg, tells)
            _wait(state, cfg)
        case PoseUpdate():
            yield from _told(update.correct(state, message, cfg), tells)
        case ArchiveReply():
            yield from _page(state, message, cfg)
        case Succession():
            state.stands_by, state.unnamed = bool(message.predecessor), True
            yield _ask_former(state)
        case PlaceDelta() | Scene():
            yield from _hear_former(state, succession.legacy_of(message))
        case TakesOver():
            state.stands_by, state.unanswered = False, 0
            if message.bequest is not None and (told := message.bequest.places) is not None:
                legacy = succession.legacy_of(told, message.bequest.next_ids.get("places", 0))
                yield from _hear_former(state, legacy)
    if not tells and not state.silent:
        succession.inherit(state, cfg)
        if state.seen:
            yield PLACE_DELTA, publishing.snapshot(state, cfg)


def _ask_former(state: State) -> Ask:
    if state.stands_by:
        return Ask(PLACE_SNAPSHOT, SnapshotRequest(robot=state.robot))
    return Ask(SCENE, SceneRequest(robot=state.robot))


def _hear_former(state: State, legacy: Legacy) -> Iterator[Output]:
    state.legacy, state.unnamed = legacy, False
    if state.behind:
        return
    if state.lacking:
        yield from _catch_up(state, max(state.lacking) + 1)
    elif len(legacy.ids) and not state.seen:
        # No keyframe need come by itself: the source may be at its end, and its reader may have begun anew.
        yield from _catch_up(state, LAST_NUMBER)


def _catch_up(state: State, end_frame_id: int) -> Iterator[Output]:
    state.joined_frame_id, state.behind = end_frame_id, True
    yield _ask_archive(state.robot, min(state.lacking, default=0), end_frame_id)


def _page(state: State, page: ArchiveReply, cfg: Config) -> Iterator[Output]:
    for keyframe in page.keyframes:
        yield from _map(state, keyframe, cfg, tells=False)
    state.unanswered = 0
    if page.keyframes:
        yield _ask_archive(state.robot, page.keyframes[-1].frame_id + 1, state.joined_frame_id)
    else:
        state.behind = False


def _wait(state: State, cfg: Config) -> None:
    """Who does not answer is not waited for without end, once this process is in charge."""
    state.unanswered += 1
    if not state.stands_by and state.incomplete and state.unanswered >= cfg.archive_patience:
        log.warning("not all is known of the map before: it is told as it is", extra={"keyframes": len(state.seen)})
        state.behind = state.unnamed = False
        if state.legacy is not None:
            state.legacy.frame_ids = frozenset()


def _ask_archive(robot: str, first_frame_id: int, end_frame_id: int) -> Ask:
    return Ask(ARCHIVE, ArchiveRequest(robot=robot, first_frame_id=first_frame_id, end_frame_id=end_frame_id))


def _map(state: State, keyframe: Keyframe, cfg: Config, tells: bool) -> Iterator[Output]:
    if keyframe.frame_id not in state.seen:
        for delta in update.integrate(state, keyframe, cfg):
            yield from _told(delta, tells)
            if keyframe.frame_id not in state.seen:
                yield Pause()


def _told(delta: PlaceDelta | None, tells: bool) -> Iterator[Output]:
    """Publish a delta, unless readers keep what they have; what was wrong goes to the log too."""
    if delta is not None:
        if delta.event:
            log.warning(delta.event, extra={"frame": delta.frame_id})
        if tells:
            yield PLACE_DELTA, delta


def _snapshot(state: State, request: SnapshotRequest, cfg: Config) -> PlaceDelta:
    if state.silent:
        raise NotYet("the map is being built again from the archive; ask again")
    return publishing.snapshot(state, cfg)


def lacks(state: State, cfg: Config) -> str:
    """What is still missing of the map of the predecessor."""
    if state.unnamed:
        return "what its predecessor tells of the map"
    if state.lacking:
        return f"{len(state.lacking)} keyframes of its predecessor's map (see ingest.archive_mb)"
    return f"keyframes of the archive beside the {len(state.seen)} it has" if state.behind else ""


def bequest(state: State, identity: Identity, cfg: Config) -> Bequest:
    """The map as told, for the successor; without one where this process has not come so far."""
    told = None if state.silent else publishing.snapshot(state, cfg)
    next_ids = {"places": state.graph.next_id}
    return Bequest(robot=state.robot, service=SERVICE.name, instance=identity.instance, places=told, next_ids=next_ids)


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
    asks=(ARCHIVE, EPOCH, PLACE_SNAPSHOT, SCENE),
    losses=State.losses,
    answers={PLACE_SNAPSHOT: _snapshot, VOXEL_MAP: _voxel_map},
    handover=Handover(lacks, bequest),
)

"""Reads places, pyramids, detections, corrected poses, tasks and priors; writes regions, beliefs and objects."""

import logging
from collections.abc import Iterator

from prior_sg.schemas.codec import Message
from prior_sg.schemas.features import TextRequest
from prior_sg.schemas.objects import ObjectDelta
from prior_sg.schemas.places import SnapshotRequest
from prior_sg.schemas.priors import PriorRequest, TaskRequest
from prior_sg.schemas.regions import PosteriorReply, PosteriorRequest, RegionDelta
from prior_sg.schemas.scene import SceneRequest
from prior_sg.schemas.status import EpochKnown, EpochRequest
from prior_sg.schemas.succession import Bequest, Evidence, EvidenceRequest, Succession
from prior_sg.schemas.topics import (
    BACKFILL,
    DETECTIONS,
    EPOCH,
    EVIDENCE,
    OBJECT_DELTA,
    OBJECT_SNAPSHOT,
    PLACE_DELTA,
    PLACE_SNAPSHOT,
    POSE_UPDATE,
    POSTERIOR,
    PRIOR,
    PRIOR_EVIDENCE,
    PRIORS,
    PYRAMID,
    REGION_DELTA,
    REGION_SNAPSHOT,
    SCENE,
    TASK,
    TASK_IN_FORCE,
    TEXT,
    topic_of,
)
from prior_sg.services.deltas import Follower
from prior_sg.services.refusals import NotYet
from prior_sg.services.runtime.service import Ask, Handover, Identity, Output, Service, ServiceError
from prior_sg.services.segmenter.core import report, succession, update
from prior_sg.services.segmenter.core.config import Config
from prior_sg.services.segmenter.core.energy.maxflow import NoSuchLibrary, min_cut_in_use
from prior_sg.services.segmenter.core.state import State, empty

log = logging.getLogger(__name__)
QUESTIONS = {
    SnapshotRequest: PLACE_SNAPSHOT,
    TextRequest: TEXT,
    PriorRequest: PRIORS,
    TaskRequest: TASK_IN_FORCE,
    EvidenceRequest: EVIDENCE,
}


def init(cfg: Config, identity: Identity) -> State:
    """Nothing is known yet. Raises ServiceError when the library for cuts is not there."""
    try:
        log.info(f"large cuts by {min_cut_in_use(cfg.solver.min_cut)}")
    except NoSuchLibrary as error:
        raise ServiceError(f"segmenter.solver: {error}") from error
    return empty(cfg, identity.robot, identity.epoch)


def step(state: State, message: Message, cfg: Config) -> Iterator[Output]:
    """One input; regions go to their topic, requests become questions."""
    if isinstance(message, Succession):
        yield from _ask_former(state, bool(message.predecessor))
    for output in update.update(state, message, cfg):
        topic = topic_of(type(output))
        yield (topic, output) if topic is not None else Ask(QUESTIONS[type(output)], output)


def _ask_former(state: State, alive: bool) -> Iterator[Ask]:
    """Ask the predecessor, or the store where it is gone, what readers know."""
    snapshot = SnapshotRequest(robot=state.robot)
    yield Ask(PLACE_SNAPSHOT, snapshot)
    if alive:
        yield Ask(REGION_SNAPSHOT, snapshot)
        yield Ask(OBJECT_SNAPSHOT, snapshot)
        yield Ask(EVIDENCE, EvidenceRequest(robot=state.robot))
    else:
        yield Ask(SCENE, SceneRequest(robot=state.robot))


def answer_snapshot(state: State, request: SnapshotRequest, cfg: Config) -> RegionDelta:
    """Everything published so far."""
    _check_told(state)
    return report.snapshot(state)


def answer_objects(state: State, request: SnapshotRequest, cfg: Config) -> ObjectDelta:
    """All objects published so far."""
    _check_told(state)
    return state.objects.ledger.snapshot(state.robot, state.epoch)


def _check_told(state: State) -> None:
    if state.catching_up.silent:
        raise NotYet("what was known before is being gathered again; ask again")


def answer_evidence(state: State, request: EvidenceRequest, cfg: Config) -> Evidence:
    """What was seen, for a successor."""
    seen, kept = state.seen, list(state.objects.tracks.archive.values())
    return succession.page(state.robot, seen.spaces.force, seen.archives, kept, request)


def bequest(state: State, identity: Identity, cfg: Config) -> Bequest:
    """Regions and objects as told, for the successor; without them where this process has not come so far."""
    silent = state.catching_up.silent
    return Bequest(
        robot=state.robot,
        service=SERVICE.name,
        instance=identity.instance,
        regions=None if silent else report.snapshot(state),
        objects=None if silent else state.objects.ledger.snapshot(state.robot, state.epoch),
        next_ids={"regions": state.regions.next_id, "objects": state.objects.tracks.next_id}
        | {str(level): next_id for level, next_id in state.layers.next_ids.items()},
    )


def answer_posterior(state: State, request: PosteriorRequest, cfg: Config) -> PosteriorReply:
    """Why a place carries its label."""
    return report.explain(state, request, cfg)


def answer_epoch(state: State, request: EpochRequest, cfg: Config) -> EpochKnown:
    """How far the epochs of the place graph have come, for its successor."""
    follower = state.map.follower if request.topic == PLACE_DELTA.name else Follower()
    return EpochKnown(robot=request.robot, topic=request.topic, epoch=follower.epoch, revision=follower.revision)


SERVICE = Service(
    "segmenter",
    purpose="Aligns places with the prior: a label and a belief for each place, and regions with lasting ids.",
    scope="robot",
    config=Config,
    init=init,
    step=step,
    reads=(PLACE_DELTA, PYRAMID, DETECTIONS, POSE_UPDATE, TASK, PRIOR),
    writes=(REGION_DELTA, OBJECT_DELTA, BACKFILL, PRIOR_EVIDENCE),
    asks=(PLACE_SNAPSHOT, TEXT, PRIORS, TASK_IN_FORCE, EPOCH, REGION_SNAPSHOT, OBJECT_SNAPSHOT, EVIDENCE, SCENE),
    answers={
        REGION_SNAPSHOT: answer_snapshot,
        OBJECT_SNAPSHOT: answer_objects,
        POSTERIOR: answer_posterior,
        EPOCH: answer_epoch,
        EVIDENCE: answer_evidence,
    },
    handover=Handover(update.lacking, bequest),
    key_fields=lambda cfg: {"keeper": "segmenter"},
    losses=lambda state: state.seen.losses.told,
    tick_s=0.5,
)

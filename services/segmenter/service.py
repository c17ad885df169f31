"""Reads places, pyramids, detections, corrected poses, tasks and priors; writes regions, beliefs and objects."""

import logging
from collections.abc import Iterator

from prior_sg.schemas.codec import Message
from prior_sg.schemas.features import TextRequest
from prior_sg.schemas.objects import ObjectDelta
from prior_sg.schemas.places import SnapshotRequest
from prior_sg.schemas.priors import PriorRequest, TaskRequest
from prior_sg.schemas.regions import PosteriorReply, PosteriorRequest, RegionDelta
from prior_sg.schemas.status import EpochKnown, EpochRequest
from prior_sg.schemas.topics import (
    BACKFILL,
    DETECTIONS,
    EPOCH,
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
    TASK,
    TASK_IN_FORCE,
    TEXT,
    topic_of,
)
from prior_sg.services.deltas import Follower
from prior_sg.services.runtime.service import Ask, Identity, Output, Service, ServiceError
from prior_sg.services.segmenter.core import report, update
from prior_sg.services.segmenter.core.config import Config
from prior_sg.services.segmenter.core.energy.maxflow import NoSuchLibrary, min_cut_in_use
from prior_sg.services.segmenter.core.state import State, empty

log = logging.getLogger(__name__)
QUESTIONS = {
    SnapshotRequest: PLACE_SNAPSHOT,
    TextRequest: TEXT,
    PriorRequest: PRIORS,
    TaskRequest: TASK_IN_FORCE,
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
    for output in update.update(state, message, cfg):
        topic = topic_of(type(output))
        yield (topic, output) if topic is not None else Ask(QUESTIONS[type(output)], output)


def answer_snapshot(state: State, request: SnapshotRequest, cfg: Config) -> RegionDelta:
    """Everything published so far."""
    return report.snapshot(state)


def answer_objects(state: State, request: SnapshotRequest, cfg: Config) -> ObjectDelta:
    """All objects published so far."""
    return state.objects.ledger.snapshot(state.robot, state.epoch)


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
    asks=(PLACE_SNAPSHOT, TEXT, PRIORS, TASK_IN_FORCE, EPOCH),
    answers={
        REGION_SNAPSHOT: answer_snapshot,
        OBJECT_SNAPSHOT: answer_objects,
        POSTERIOR: answer_posterior,
        EPOCH: answer_epoch,
    },
    key_fields=lambda cfg: {"keeper": "segmenter"},
    losses=lambda state: state.seen.losses.told,
    tick_s=0.5,
)

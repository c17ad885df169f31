"""Walks through datasets keyframe by keyframe, so that labels can be judged before their places are near."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
from scipy.spatial import cKDTree

from prior_sg.deploy.evaluation.ahead import NEAR_M, NO_LABEL, Ahead, Stop, score
from prior_sg.deploy.evaluation.errors import EvaluationError
from prior_sg.deploy.evaluation.kinds import OURS
from prior_sg.deploy.evaluation.methods import Case, Variant, labelling, put_in_force, without_pyramid
from prior_sg.deploy.truth import GroundTruth
from prior_sg.schemas.places import PlaceDelta
from prior_sg.schemas.regions import NO_REGION
from prior_sg.schemas.status import Tick
from prior_sg.schemas.topics import DETECTIONS, PLACE_DELTA, PYRAMID
from prior_sg.services.segmenter.core.config import Config
from prior_sg.services.segmenter.core.state import State

TICK_KEYFRAMES = 5  # keyframes from one tick, and one judgement, to the next
SECOND_NS = 1e9


@dataclass(frozen=True)
class Snapshot:
    """What a segmenter holds at one moment."""

    delta: PlaceDelta  # the last it has taken
    place_ids: np.ndarray  # (place,)
    positions_m: np.ndarray  # (place, 3) world
    regions: np.ndarray  # (place,) NO_REGION = not labelled
    labels: np.ndarray  # (place,) number among the names
    names: tuple[str, ...]
    trust: np.ndarray  # (place,) sum of trust


def variants(config: Config) -> dict[str, Variant]:
    """Ours, and two that see without a pyramid."""
    return {OURS: Variant(config), **without_pyramid(config)}


def judged(case: Case, deltas: Sequence[PlaceDelta], config: Config) -> dict[str, dict[str, Ahead]]:
    """Every variant on one walk, by each of NEARNESS and variant. What ours has seen counts for all variants alike.

    Raises EvaluationError where there are no keyframes.
    """
    walks = {name: snapshots(variant, case, deltas) for name, variant in variants(config).items()}
    if not walks[OURS]:
        raise EvaluationError(f"{case.perception.name} yields no keyframes: leave it out, or give one that moves")
    seen = stops(walks[OURS], deltas, case.truth, config.predicted_trust)
    visited = [replace(stop, close=stop.distances_m < NEAR_M) for stop in seen]
    labels = {name: [given_labels(held) for held in walk] for name, walk in walks.items()}
    return {
        nearness: {name: score(found, given) for name, given in labels.items()}
        for nearness, found in (("seen", seen), ("visited", visited))
    }


def snapshots(variant: Variant, case: Case, deltas: Sequence[PlaceDelta]) -> list[Snapshot]:
    """What the segmenter holds after every few keyframes and after the last, its prior in force from the start."""
    prior, perception = variant.prior(case), case.perception
    config = msgspec.structs.replace(variant.config, space=perception.space)
    robot = perception.places.robot
    pyramids = {pyramid.frame_id: pyramid for pyramid in variant.pyramids(case)}
    detections = {found.frame_id: found for found in variant.detections(case)}
    held = []
    with labelling(config, robot, lambda concepts: variant.text(perception.text(concepts))) as pipeline:
        segmenter = pipeline.of("segmenter")
        put_in_force(pipeline, robot, prior)
        for number, delta in enumerate(deltas, 1):
            pipeline.publish(PLACE_DELTA, delta)
            if delta.frame_id in pyramids:
                pipeline.publish(PYRAMID, pyramids[delta.frame_id])
            if delta.frame_id in detections:
                pipeline.publish(DETECTIONS, detections[delta.frame_id])
            if number % TICK_KEYFRAMES == 0 or number == len(deltas):
                pipeline.feed(segmenter, Tick(stamp_ns=delta.stamp_ns))
                held.append(snapshot(segmenter.state, delta))
    return held


def snapshot(state: State, delta: PlaceDelta) -> Snapshot:
    """A copy of what the segmenter holds, after this delta."""
    graph, places = state.map.graph, state.map.places
    return Snapshot(
        delta=delta,
        place_ids=graph.ids.copy(),
        positions_m=graph.positions_m.copy(),
        regions=places.regions.copy(),
        labels=places.labels.astype(np.int64),
        names=tuple(state.aim.aligned.labels) if state.aim.aligned else (),
        trust=state.seen.evidence.trust[places.slots],
    )


def stops(
    walk: Sequence[Snapshot], deltas: Sequence[PlaceDelta], truth: GroundTruth, predicted_trust: float
) -> list[Stop]:
    """The moments of a walk as they are judged; its snapshots name the labels that the truth is told in."""
    cameras_m = np.array([delta.camera_m for delta in deltas if delta.camera_m is not None], float).reshape(-1, 3)
    stamps_ns = np.array([delta.stamp_ns for delta in deltas if delta.camera_m is not None], np.int64)
    steps_m = np.linalg.norm(np.diff(cameras_m, axis=0), axis=1)
    names = {region.id: region.label for region in truth.regions}
    found = []
    for held in walk:
        count = int((stamps_ns <= held.delta.stamp_ns).sum())
        numbers = {name: number for number, name in enumerate(held.names)}
        regions = truth.region_of(held.positions_m).tolist()
        distances_m = np.full(len(held.place_ids), np.inf)
        if count and len(held.place_ids):
            distances_m, _ = cKDTree(cameras_m[:count]).query(held.positions_m)
        found.append(
            Stop(
                stamp_s=held.delta.stamp_ns / SECOND_NS,
                travelled_m=float(steps_m[: max(count - 1, 0)].sum()),
                place_ids=held.place_ids,
                true_labels=np.array([numbers.get(names.get(one, ""), NO_LABEL) for one in regions], np.int64),
                distances_m=distances_m,
                close=held.trust >= predicted_trust,
            )
        )
    return found


def given_labels(held: Snapshot) -> np.ndarray:
    """Label (place,) that each place carries, NO_LABEL = none."""
    return np.where(held.regions == NO_REGION, NO_LABEL, held.labels)

"""The same moments as the whole product has them: its own map of depth images, its own labels, its own openings."""

from dataclasses import dataclass

import msgspec
import numpy as np

from prior_sg.deploy.evaluation.ahead_walks import TICK_KEYFRAMES
from prior_sg.deploy.evaluation.datasets import Dataset, WorldName, of_world
from prior_sg.deploy.evaluation.foresight.trials import SAME, Moment, prior_of
from prior_sg.deploy.evaluation.methods import Case, Variant, labelling
from prior_sg.deploy.evaluation.perception import Perceiver
from prior_sg.deploy.settings import DEMO_TASK
from prior_sg.deploy.truth import GroundTruth
from prior_sg.schemas.places import PlaceDelta
from prior_sg.schemas.priors import Prior, Task
from prior_sg.schemas.regions import NO_REGION
from prior_sg.schemas.status import Tick
from prior_sg.schemas.topics import PLACE_DELTA, PRIOR, PYRAMID, TASK
from prior_sg.services.segmenter.core.config import Config
from prior_sg.services.segmenter.core.foresight.beyond import Views
from prior_sg.services.segmenter.core.foresight.expectation import Found
from prior_sg.services.segmenter.core.foresight.openings import Openings, openings_of
from prior_sg.services.segmenter.core.state import State

REACH_M = 1.5  # from the point beyond an opening to the places that tell what it revealed
REVEALED = 3  # the nearest of them that decide


@dataclass(frozen=True)
class Held:
    """What a segmenter held at one moment."""

    openings: Openings
    views: Views
    found: Found
    place_ids: np.ndarray
    seen: np.ndarray  # (label,) bool


def pipeline_moments(perceiver: Perceiver, name: WorldName, config: Config) -> tuple[list[Moment], Prior]:
    """One generated world, scanned. Raises EvaluationError."""
    dataset = of_world(name, DEMO_TASK)
    prior = prior_of(name.kind, dataset.prior.environment)
    perception = perceiver.perceive(dataset, None, ())
    case = Case(perception, prior, dataset.truth)
    deltas = perceiver.deltas(dataset)
    held, positions_m = walk(case, deltas, config)
    return [moment for one in held if len((moment := _moment(one, dataset, prior, positions_m)).outcomes)], prior


def walk(case: Case, deltas: list[PlaceDelta], config: Config) -> tuple[list[Held], dict[int, np.ndarray]]:
    """What the segmenter holds every few keyframes, and where every place was last."""
    variant, perception, prior = Variant(config), case.perception, case.prior
    robot = perception.places.robot
    task = Task(robot=robot, stamp_ns=0, environment=prior.environment, task=prior.task, regions=prior.vocabulary)
    pyramids = {pyramid.frame_id: pyramid for pyramid in variant.pyramids(case)}
    held: list[Held] = []
    positions_m: dict[int, np.ndarray] = {}
    cfg = msgspec.structs.replace(config, space=perception.space)
    with labelling(cfg, robot, lambda concepts: variant.text(perception.text(concepts))) as pipeline:
        segmenter = pipeline.of("segmenter")
        pipeline.publish(TASK, task)
        pipeline.publish(PRIOR, prior)
        for number, delta in enumerate(deltas, 1):
            pipeline.publish(PLACE_DELTA, delta)
            positions_m |= dict(zip(delta.place_ids.tolist(), delta.positions_m, strict=True))
            if delta.frame_id in pyramids:
                pipeline.publish(PYRAMID, pyramids[delta.frame_id])
            if number % TICK_KEYFRAMES == 0:
                pipeline.feed(segmenter, Tick(stamp_ns=delta.stamp_ns))
                held.append(_held(segmenter.state, cfg))
    return held, positions_m


def _held(state: State, cfg: Config) -> Held:
    places, known, labels = state.map.places, state.regions.known, state.aim.aligned.labels
    openings = openings_of(state.map.graph, places, state.map.frontiers, cfg.foresight)
    areas_m2 = np.array([known[region].area_m2 for region in openings.regions.tolist()])
    found = Found.of(known.values(), labels, cfg.foresight.least_places)
    views = Views(openings.beliefs, openings.widths_m, areas_m2)
    return Held(openings, views, found, state.map.graph.ids.copy(), found.regions > 0)


def _moment(held: Held, dataset: Dataset, prior: Prior, positions_m: dict[int, np.ndarray]) -> Moment:
    """What each opening revealed later on: the true region of the nearest places that came beyond it."""
    later = sorted(positions_m.keys() - set(held.place_ids.tolist()))
    points_m = np.array([positions_m[place] for place in later], np.float64).reshape(-1, 3)
    numbers = {region.name: number for number, region in enumerate(prior.regions)}
    label_of = {region.id: numbers.get(region.label, NO_REGION) for region in dataset.truth.regions}
    own = dataset.truth.region_of(held.openings.positions_m)
    kept, outcomes = [], []
    for row, region in enumerate(own.tolist()):
        came = _revealed(held.openings, row, points_m, dataset.truth)
        if NO_REGION in (region, came) or label_of[came] == NO_REGION:
            continue
        kept.append(row)
        outcomes.append(SAME if came == region else label_of[came])
    views = Views(held.views.beliefs[kept], held.views.widths_m[kept], held.views.areas_m2[kept])
    there = np.bincount([label for label in label_of.values() if label >= 0], minlength=len(prior.regions))
    return Moment(views, held.found, np.array(outcomes, np.int64), there > held.found.regions, held.seen)


def _revealed(openings: Openings, row: int, points_m: np.ndarray, truth: GroundTruth) -> int:
    """Id of the region that most of the nearest new places beyond an opening lie in; NO_REGION = none came."""
    outward_m = openings.beyond_m[row] - openings.positions_m[row]
    ahead = (points_m - openings.positions_m[row]) @ outward_m > 0
    away_m = np.linalg.norm(points_m - openings.beyond_m[row], axis=1)
    near = np.flatnonzero(ahead & (away_m <= REACH_M))
    near = near[np.argsort(away_m[near], kind="stable")][:REVEALED]
    regions = truth.region_of(points_m[near])
    regions = regions[regions != NO_REGION]
    return int(np.bincount(regions).argmax()) if len(regions) else NO_REGION

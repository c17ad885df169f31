"""The product's own openings along walks through worlds, and what is truly behind them.

Places, frontiers, regions and beliefs are those of place graph and segmenter. What they have seen of the true floor
plan is what the spheres of their places cover; behind an opening lies what one comes to from its edge through the rest.
Of many an opening that is nothing: a gap in depth, a corner that was never looked into.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
from scipy.spatial import cKDTree

from prior_sg.deploy.evaluation.datasets import WorldName, of_world
from prior_sg.deploy.evaluation.foresight import loops
from prior_sg.deploy.evaluation.foresight.explorer import BEYOND_CELLS, MET_M2, REACH_CELLS, Plan, plan_of, starts_of
from prior_sg.deploy.evaluation.foresight.trials import FOUND_M2, SAME, Moment
from prior_sg.deploy.evaluation.methods import Case, labelling, put_in_force
from prior_sg.deploy.evaluation.perception import Perceiver
from prior_sg.deploy.evaluation.worlds import world_of
from prior_sg.deploy.evaluation.worlds.ways import CELL_M
from prior_sg.deploy.settings import DEMO_TASK
from prior_sg.schemas.places import PlaceDelta
from prior_sg.schemas.priors import Prior
from prior_sg.schemas.regions import NO_REGION
from prior_sg.schemas.status import Tick
from prior_sg.schemas.topics import PLACE_DELTA, PYRAMID
from prior_sg.services.segmenter.core.config import Config
from prior_sg.services.segmenter.core.foresight.config import ForesightConfig
from prior_sg.services.segmenter.core.foresight.openings import Openings, openings_of
from prior_sg.services.segmenter.core.foresight.telling import found_in, views_of
from prior_sg.services.segmenter.core.map.received import ReceivedGraph
from prior_sg.services.segmenter.core.state import State

ENCODER = "simlike:0.2"
EVERY = 5  # keyframes from one moment to the next
MARGIN_M = 0.4  # around the spheres: what lies between them and walls has been seen
TALL_M = 2.2  # a place is over ground that lies at most so far below it
LED_M2 = 0.3  # of unseen floor behind an opening: it leads somewhere
BESIDE_M = 0.4  # of an opening's edge, beside half its width


@dataclass(frozen=True, eq=False)
class Ground:
    """A floor plan, and how its regions are called by the prior."""

    plan: Plan
    labels: np.ndarray  # (region,) number of the prior's region, -1 = it lacks it
    nodes: np.ndarray  # (n,) where one can stand
    points_m: np.ndarray  # (n, 3) of them
    walkable: np.ndarray  # (region,) bool


def mapped(kind: str, seed: int, perceiver: Perceiver) -> tuple[list[Moment], Prior]:
    """The moments of the walk through a world, and its prior. Raises EvaluationError."""
    dataset = of_world(WorldName(kind, seed), DEMO_TASK)
    deltas = perceiver.walk(dataset)
    case = Case(perceiver.perceive(dataset), dataset.prior, dataset.truth, dataset.objects)
    ground = ground_of(plan_of(world_of(kind, seed)), dataset.prior)
    return [_moment(state, ground, case.prior) for state in states(case, deltas)], case.prior


def states(case: Case, deltas: Sequence[PlaceDelta], config: Config = Config()) -> Iterator[State]:
    """A segmenter along a walk, every so many keyframes, while there are openings."""
    prior, perception = case.prior, case.perception
    robot, pyramids = perception.places.robot, {one.frame_id: one for one in perception.pyramids}
    with labelling(msgspec.structs.replace(config, space=perception.space), robot, perception.text) as pipeline:
        segmenter = pipeline.of("segmenter")
        put_in_force(pipeline, robot, prior)
        for number, delta in enumerate(deltas, 1):
            pipeline.publish(PLACE_DELTA, delta)
            if delta.frame_id in pyramids:
                pipeline.publish(PYRAMID, pyramids[delta.frame_id])
            if number % EVERY == 0:
                pipeline.feed(segmenter, Tick(stamp_ns=delta.stamp_ns))
                state: State = segmenter.state
                if state.regions.known and len(state.map.frontiers.held):
                    yield state


def ground_of(plan: Plan, prior: Prior) -> Ground:
    """A plan under a prior."""
    numbers = {region.name: number for number, region in enumerate(prior.regions)}
    nodes = np.flatnonzero(plan.regions != NO_REGION)
    return Ground(
        plan,
        np.array([numbers.get(label, -1) for label in plan.labels], np.int64),
        nodes,
        plan.position_m(nodes),
        np.isin(np.arange(len(plan.labels)), plan.regions[starts_of(plan)]),
    )


def _moment(state: State, ground: Ground, prior: Prior) -> Moment:
    cfg, plan = Config().foresight, ground.plan
    openings = openings_of(state.map.graph, state.map.places, state.map.frontiers, cfg)
    known = covered(ground, state.map.graph)
    seen_m2 = np.bincount(plan.regions[ground.nodes[known[ground.nodes]]], minlength=len(plan.labels)) * CELL_M**2
    new = (seen_m2 < FOUND_M2) & (ground.labels >= 0) & ground.walkable
    outcomes, met, led = behind(openings, ground, known, new, cfg)
    return Moment(
        views_of(openings, state.regions.known, cfg),
        found_in(state.regions.known, prior, cfg),
        outcomes,
        met,
        np.bincount(ground.labels[new], minlength=len(prior.regions)) > 0,
        led,
    )


def behind(
    openings: Openings, ground: Ground, known: np.ndarray, new: np.ndarray, cfg: ForesightConfig
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What each opening reveals first (opening,), as in `Moment`; whether a region of each label that is `new`
    (region,) begins within reach (opening, label); and whether anything is behind (opening,). `known` (node,) has been
    seen."""
    plan, count = ground.plan, openings.beliefs.shape[1]
    outcomes = np.full(len(openings.place_ids), SAME)
    met, led = np.zeros((len(outcomes), count), bool), np.zeros(len(outcomes), bool)
    for row in range(len(outcomes)):
        edge = _edge(openings, row, ground, known, cfg.beyond_m)
        origin, first = _most(plan, edge), _nodes_behind(plan, known, edge, BEYOND_CELLS)
        led[row] = first.sum() * CELL_M**2 >= LED_M2
        shown = int(first.argmax()) if first.any() else NO_REGION
        if shown not in (NO_REGION, origin) and ground.labels[shown] >= 0:
            outcomes[row] = ground.labels[shown]
        begins = new & (_nodes_behind(plan, known, edge, REACH_CELLS) * CELL_M**2 >= MET_M2)
        met[row, ground.labels[begins]] = True
    return outcomes, met, led


def covered(ground: Ground, graph: ReceivedGraph) -> np.ndarray:
    """Whether each node (node,) of the plan lies below a sphere of free space."""
    known = np.zeros(ground.plan.heights.size, bool)
    tree = cKDTree(ground.points_m[:, :2])
    below = tree.query_ball_point(graph.positions_m[:, :2], graph.radii_m + MARGIN_M)
    for height_m, held in zip(graph.positions_m[:, 2].tolist(), below, strict=True):
        rows = np.array(held, np.int64)
        above_m = height_m - ground.points_m[rows, 2]
        known[ground.nodes[rows[(above_m > 0) & (above_m < TALL_M)]]] = True
    return known


def _edge(openings: Openings, row: int, ground: Ground, known: np.ndarray, beyond_m: float) -> np.ndarray:
    """Seen nodes (n,) where the free space of an opening ends."""
    outward = openings.beyond_m[row] - openings.positions_m[row]
    edge_m = openings.beyond_m[row] - beyond_m * outward / np.linalg.norm(outward)
    reach_m = openings.widths_m[row] / 2 + BESIDE_M
    off_m = edge_m - ground.points_m
    near = (np.linalg.norm(off_m[:, :2], axis=1) <= reach_m) & (off_m[:, 2] > -BESIDE_M) & (off_m[:, 2] < TALL_M)
    return ground.nodes[near & known[ground.nodes]]


def _nodes_behind(plan: Plan, known: np.ndarray, edge: np.ndarray, cells: int) -> np.ndarray:
    """Unseen nodes (region,) of each true region that one comes to from an edge."""
    if not len(edge):
        return np.zeros(len(plan.labels), np.int64)
    reached, *_ = loops.flooded(plan.heights, plan.clearance, known, edge, cells, plan.step)
    held = plan.regions[reached]
    return np.bincount(held[held != NO_REGION], minlength=len(plan.labels))


def _most(plan: Plan, nodes: np.ndarray) -> int:
    """Index of the true region that most of the nodes are in."""
    return int(np.bincount(plan.regions[nodes]).argmax()) if len(nodes) else NO_REGION

"""Walks through worlds of several storeys or buildings: are the levels above regions found, and do their ids last?"""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from prior_sg.deploy.evaluation.datasets import Dataset, WorldName, of_world
from prior_sg.deploy.evaluation.level_metrics import NONE, level_scores, levels_in, nodes_at, true_nodes
from prior_sg.deploy.evaluation.methods import Case, labelling, put_in_force, scene_of
from prior_sg.deploy.evaluation.metrics import evaluate
from prior_sg.deploy.truth import GroundTruth
from prior_sg.schemas.levels import LevelName, LevelNode
from prior_sg.schemas.places import PlaceDelta
from prior_sg.schemas.scene import Scene
from prior_sg.schemas.status import Tick
from prior_sg.schemas.topics import PLACE_DELTA, PYRAMID
from prior_sg.services.segmenter.core.config import Config
from prior_sg.services.segmenter.core.layers.layer_map import LayerMap
from prior_sg.services.segmenter.core.state import State

TASKS = {  # what is asked of each kind of world, so that zones have names
    "house": "find the rooms; which part of the home are they in?",
    "clinic": "find the rooms; which ward or department are they in?",
    "campus": "find the way around the campus",
}
TICK_KEYFRAMES = 5  # keyframes from one tick, and one look at the ids, to the next
TIMED = 20  # times the levels are found for one figure


@dataclass(frozen=True)
class Held:
    """Which nodes there were at one moment of a walk, and where its places were."""

    positions_m: np.ndarray  # (place, 3)
    regions: np.ndarray  # (place,)
    nodes: tuple[LevelNode, ...]


@dataclass(frozen=True)
class Walked:
    """One walk: the scene at its end, moments on the way, and what updates cost."""

    scene: Scene
    moments: tuple[Held, ...]
    update_ms: float  # mean of all updates with pyramids
    layers_ms: float  # of finding all levels at the end, which an update with a changed region does once


def walk(case: Case, deltas: Sequence[PlaceDelta], config: Config) -> Walked:
    """A segmenter along a walk, its prior in force from the start."""
    prior, perception = case.prior, case.perception
    config = msgspec.structs.replace(config, space=perception.space)
    robot = perception.places.robot
    pyramids = {pyramid.frame_id: pyramid for pyramid in perception.pyramids}
    moments, spent_s = list[Held](), list[float]()
    with labelling(config, robot, perception.text) as pipeline:
        segmenter = pipeline.of("segmenter")
        put_in_force(pipeline, robot, prior)
        for number, delta in enumerate(deltas, 1):
            pipeline.publish(PLACE_DELTA, delta)
            if delta.frame_id in pyramids:
                started_s = time.perf_counter()
                pipeline.publish(PYRAMID, pyramids[delta.frame_id])
                spent_s.append(time.perf_counter() - started_s)
            if number % TICK_KEYFRAMES == 0 or number == len(deltas):
                pipeline.feed(segmenter, Tick(stamp_ns=delta.stamp_ns))
                moments.append(_held(segmenter.state))
        for stamp_ns in (1, 2):
            pipeline.feed(segmenter, Tick(stamp_ns=stamp_ns))
        layers_ms = _layers_ms(segmenter.state, config)
        scene = scene_of(pipeline, robot)
    return Walked(scene, tuple(moments), 1e3 * float(np.mean(spent_s)), layers_ms)


def figures(walked: Walked, case: Case) -> dict[str, float]:
    """F1_S of regions, and F1_S, F1_G and kept ids of each level that the truth knows."""
    free = case.perception.voxels
    found = {"f1_s_region": evaluate(walked.scene, free, case.truth)["f1_s"]}
    for level, scores in level_scores(walked.scene, free, case.truth).items():
        found |= {f"{name}_{level}": value for name, value in scores.items()}
    found |= {f"ids_kept_{level}": ids_kept(walked.moments, case.truth, level) for level in levels_in(case.truth)}
    return found | {"update_ms": walked.update_ms, "layers_ms": walked.layers_ms}


def ids_kept(moments: Sequence[Held], truth: GroundTruth, level: LevelName) -> float:
    """Share of the steps from one moment to the next in which the node with most places of a true node has the same id;
    over all true nodes that have places at both; NaN without such a step."""
    true = [node for node in truth.nodes if node.level == level]
    kept = steps = 0
    before: dict[int, int] = {}
    for held in moments:
        columns = true_nodes(true, truth.region_of(held.positions_m))
        rows = nodes_at(held.nodes, level, held.regions)
        now = {}
        for number in range(len(true)):
            ids, counts = np.unique(rows[(columns == number) & (rows != NONE)], return_counts=True)
            if len(ids):
                now[number] = int(ids[np.argmax(counts)])
        both = now.keys() & before.keys()
        steps += len(both)
        kept += sum(now[number] == before[number] for number in both)
        before = now
    return kept / steps if steps else float("nan")


def dataset_of(world: WorldName) -> Dataset:
    """A world with the prior for its kind's task. Raises EvaluationError."""
    return of_world(world, TASKS[world.kind])


def _held(state: State) -> Held:
    places = state.map.places
    nodes = tuple(state.layers.known.values())
    return Held(state.map.graph.positions_m.copy(), places.regions.copy(), nodes)


def _layers_ms(state: State, config: Config) -> float:
    """What finding all levels takes, on the map as it is."""
    storeys = state.regions.storeys
    assert storeys is not None
    held, levels = state.map, state.aim.aligned.levels
    ground = state.regions.known, held.graph, held.places, storeys
    LayerMap().renew(*ground, levels=levels, cfg=config.layers)
    started_s = time.perf_counter()
    for _ in range(TIMED):
        LayerMap().renew(*ground, levels=levels, cfg=config.layers)
    return 1e3 * (time.perf_counter() - started_s) / TIMED

"""Keeps every robot's scene graph durably: reads deltas, writes revisions, answers with the scene."""

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, TypeVar

import msgspec

from prior_sg.schemas.codec import Message
from prior_sg.schemas.objects import ObjectDelta
from prior_sg.schemas.places import PlaceDelta, SnapshotRequest
from prior_sg.schemas.priors import Prior, Task, TaskInForce, TaskRequest
from prior_sg.schemas.queries import SceneAnswer, SceneQuery
from prior_sg.schemas.regions import RegionDelta
from prior_sg.schemas.scene import HistoryRequest, RevisionList, Scene, SceneRequest
from prior_sg.schemas.status import EpochKnown, EpochRequest, Tick
from prior_sg.schemas.topics import (
    EPOCH,
    HISTORY,
    OBJECT_DELTA,
    OBJECT_SNAPSHOT,
    PLACE_DELTA,
    PLACE_SNAPSHOT,
    PRIOR,
    REGION_DELTA,
    REGION_SNAPSHOT,
    SCENE,
    SCENE_QUERY,
    SCENE_REVISION,
    TASK,
    TASK_IN_FORCE,
    Query,
)
from prior_sg.services.deltas import Follower
from prior_sg.services.runtime.service import Ask, Identity, Output, Service
from prior_sg.services.scene_store.core import graph as core
from prior_sg.services.scene_store.core import telling
from prior_sg.services.scene_store.core.config import Config
from prior_sg.services.scene_store.core.queries.answering import reply
from prior_sg.services.scene_store.core.queries.index import Index
from prior_sg.services.scene_store.database import Database

log = logging.getLogger(__name__)
CHECKPOINT_S = 1.0  # the write-ahead log is folded into the file between deltas, not within a commit
D = TypeVar("D", PlaceDelta, RegionDelta, ObjectDelta)


@dataclass
class Robot:
    """One robot's graph and where its writers stand."""

    graph: core.Graph
    places: Follower[PlaceDelta]
    regions: Follower[RegionDelta]
    objects: Follower[ObjectDelta]
    index: Index | None = None  # of the revision that was last asked about


@dataclass
class State:
    """The open database and what it holds, by robot; `resumed` names robots whose writers have moved on meanwhile."""

    epoch: int
    database: Database
    robots: dict[str, Robot]
    resumed: list[str]


def init(cfg: Config, identity: Identity) -> State:
    """Open or create the database and resume from its cursors. Raises StoreError."""
    database = Database(cfg, identity.epoch)
    robots = {name: _robot(graph) for name, graph in database.graphs().items()}
    return State(identity.epoch, database, robots, sorted(robots))


def step(state: State, message: Message, cfg: Config) -> Iterator[Output]:
    """Make one input durable; every delta is committed before its revision is announced."""
    yield from _resume(state)
    match message:
        case PlaceDelta():
            yield from _take_places(state, _known(state, message.robot), message)
        case RegionDelta():
            yield from _take_regions(state, _known(state, message.robot), message)
        case ObjectDelta():
            yield from _take_objects(state, _known(state, message.robot), message)
        case Task():
            robot = _known(state, message.robot)
            if core.set_task(robot.graph, message):
                robot.index = None  # a task is no revision, and before the first regions the scene tells it
                state.database.put_task(robot.graph, message)
        case Prior():
            state.database.put_prior(message)
        case Tick():
            for robot in state.robots.values():
                if (task := core.mend_task(robot.graph, message.stamp_ns)) is not None:
                    log.warning("a task was stamped in the far future: it is stamped anew", extra={"robot": task.robot})
                    state.database.put_task(robot.graph, task)
            state.database.rest(robot.graph for robot in state.robots.values())


def _resume(state: State) -> Iterator[Output]:
    """After a restart the writers may be quiet already, so that no gap would show what was missed: ask at once."""
    while state.resumed:
        request = SnapshotRequest(robot=state.resumed.pop(0))
        yield Ask(PLACE_SNAPSHOT, request)
        yield Ask(REGION_SNAPSHOT, request)
        yield Ask(OBJECT_SNAPSHOT, request)


def _take_places(state: State, robot: Robot, delta: PlaceDelta) -> Iterator[Output]:
    """Where the cameras were is known even while the delta itself must wait."""
    verdict = robot.places.verdict(delta)
    cameras = core.note_cameras(robot.graph, delta)
    if cameras and verdict != "apply":
        state.database.put_cameras(robot.graph, delta)
    yield from _follow(state, robot, robot.places, delta, apply=core.apply_places, snapshot=PLACE_SNAPSHOT)


def _take_regions(state: State, robot: Robot, delta: RegionDelta) -> Iterator[Output]:
    return _follow(state, robot, robot.regions, delta, apply=core.apply_regions, snapshot=REGION_SNAPSHOT)


def _take_objects(state: State, robot: Robot, delta: ObjectDelta) -> Iterator[Output]:
    return _follow(state, robot, robot.objects, delta, apply=core.apply_objects, snapshot=OBJECT_SNAPSHOT)


def _follow(
    state: State,
    robot: Robot,
    follower: Follower[D],
    delta: D,
    *,
    apply: Callable[[core.Graph, D], core.Changes],
    snapshot: Query,
) -> Iterator[Output]:
    """Apply what is due of one writer's stream, make it durable and announce it; while deltas are missing, ask."""
    for due in follower.take(delta):
        state.database.put(robot.graph, apply(robot.graph, due), due)
        yield SCENE_REVISION, telling.revision_of(robot.graph, state.epoch)
    if follower.needs_snapshot:
        yield Ask(snapshot, SnapshotRequest(robot=robot.graph.robot))


def _known(state: State, robot: str) -> Robot:
    if robot not in state.robots:
        state.robots[robot] = _robot(core.Graph(robot))
    return state.robots[robot]


def _robot(graph: core.Graph) -> Robot:
    places, regions, objects = (
        (cursor.epoch, cursor.revision) for cursor in (graph.place_cursor, graph.region_cursor, graph.object_cursor)
    )
    return Robot(graph, Follower(*places), Follower(*regions), Follower(*objects))


def answer_scene(state: State, request: SceneRequest, cfg: Config) -> Scene:
    """The scene of one robot, now or in the past; empty when nothing is stored of it, or was by then."""
    robot = state.robots.get(request.robot)
    if request.revision is None and request.stamp_ns is None:
        return telling.scene(robot.graph if robot else core.Graph(request.robot))
    return telling.scene(
        state.database.at(request.robot, request.revision, request.stamp_ns) or core.Graph(request.robot)
    )


def answer_history(state: State, request: HistoryRequest, cfg: Config) -> RevisionList:
    """The revisions of one robot that can be asked for."""
    revisions = state.database.history(request.robot, request.limit, request.before)
    return RevisionList(robot=request.robot, revisions=revisions)


def answer_query(state: State, request: SceneQuery, cfg: Config) -> SceneAnswer:
    """Questions about one robot's scene; of one that the store has never heard of, it is empty."""

    def older(revision: int) -> Scene | None:
        found = state.database.at(request.robot, revision)
        return telling.scene(found) if found is not None and found.revision == revision else None

    return reply(_index(state.robots.get(request.robot) or _robot(core.Graph(request.robot))), request, older)


def _index(robot: Robot) -> Index:
    """The graph as it is, prepared for questions; made once for each revision and task that somebody asks about."""
    if robot.index is None or robot.index.scene.revision != robot.graph.revision:
        robot.index = Index(telling.scene(robot.graph))
    return robot.index


def answer_task(state: State, request: TaskRequest, cfg: Config) -> TaskInForce:
    """The newest task of one robot, for whoever was not there when it was given."""
    robot = state.robots.get(request.robot)
    return TaskInForce(robot=request.robot, task=robot.graph.task if robot else None)


def answer_epoch(state: State, request: EpochRequest, cfg: Config) -> EpochKnown:
    """How far a writer's epochs have come, for its successor."""
    robot = state.robots.get(request.robot) or _robot(core.Graph(request.robot))
    followers: dict[str, Follower[Any]] = {
        PLACE_DELTA.name: robot.places,
        REGION_DELTA.name: robot.regions,
        OBJECT_DELTA.name: robot.objects,
    }
    follower = followers.get(request.topic, Follower())
    return EpochKnown(robot=request.robot, topic=request.topic, epoch=follower.epoch, revision=follower.revision)


def figures(state: State) -> dict[str, float]:
    """What is kept, and the room that is left for it."""
    kept = {"revisions": sum(max(robot.graph.revision, 0) for robot in tuple(state.robots.values()))}
    return kept | state.database.storage.room()


def close(state: State) -> None:
    """Close the database."""
    state.database.close()


SERVICE = Service(
    name="scene_store",
    purpose="keeps every robot's scene graph and its history durably and answers with it",
    scope="fleet",
    config=Config,
    init=init,
    step=step,
    reads=(PLACE_DELTA, REGION_DELTA, OBJECT_DELTA, TASK, PRIOR),
    writes=(SCENE_REVISION,),
    answers={
        SCENE: answer_scene,
        SCENE_QUERY: answer_query,
        HISTORY: answer_history,
        TASK_IN_FORCE: answer_task,
        EPOCH: answer_epoch,
    },
    key_fields=lambda cfg: {"keeper": "scene_store"},
    asks=(PLACE_SNAPSHOT, REGION_SNAPSHOT, OBJECT_SNAPSHOT),
    tick_s=CHECKPOINT_S,
    figures=figures,
    close=close,
    replay_config=lambda cfg: msgspec.structs.replace(cfg, path=":memory:"),
)

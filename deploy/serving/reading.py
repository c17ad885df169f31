"""Questions over HTTP. Each handler asks the store; `revision` in an answer is the scene's that it is about."""

from collections.abc import Callable
from typing import Annotated, Any, TypeVar

import msgspec
from litestar import get, post
from litestar.datastructures import State
from litestar.params import FromPath, FromQuery, JSONBody, QueryParameter

from prior_sg.deploy.api.errors import NotInSceneError
from prior_sg.deploy.api.spots import ENDS, spot_in
from prior_sg.deploy.serving.errors import FaultyRequestError
from prior_sg.deploy.serving.parameters import FAULTS, Coordinate, Count, Distance, Label, Robot, system_of
from prior_sg.deploy.serving.system import EVERYWHERE, LONGEST_SEARCH, MOST_LIMIT, MOST_QUESTIONS
from prior_sg.schemas.answers import Answer, Details, Markers, Neighbourhood, RegionBeliefs, What, listed_of
from prior_sg.schemas.levels import LevelName
from prior_sg.schemas.names import LONGEST_NAME
from prior_sg.schemas.queries import (
    MOST_LISTED,
    MOST_RANKED,
    BeliefsOf,
    ById,
    ByLabel,
    ChangedSince,
    InBox,
    InRadius,
    MarkersOf,
    Nearest,
    NeighboursOf,
    NodesOf,
    Question,
    RouteBetween,
    SceneAnswer,
    WhatIsMissing,
    WhereToLook,
    WordsInUse,
)
from prior_sg.schemas.status import ServiceStatus

Q = TypeVar("Q")


class Questions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Questions that are answered over one revision, in their order."""

    questions: Annotated[list[Question], msgspec.Meta(max_length=MOST_QUESTIONS)]


class Answered(msgspec.Struct, frozen=True):
    """One answer and the revision that it is about."""

    robot: str
    revision: int
    stamp_ns: int
    answer: Answer
    note: str = ""  # how much the answer does not list, and how to get it


class RegionInFull(msgspec.Struct, frozen=True):
    """All about a region."""

    robot: str
    revision: int
    stamp_ns: int
    details: Details
    candidates: RegionBeliefs
    neighbours: Neighbourhood
    note: str = ""  # as in Answered, of the candidates


class Alive(msgspec.Struct, frozen=True):
    """Health of the system."""

    processes: list[ServiceStatus]
    silent: dict[str, str]  # why they do not answer, by instance


class Progress(msgspec.Struct, frozen=True):
    """How far a source is read."""

    robot: str
    frames_read: int
    frames_total: int  # 0 = unknown, as of a live source
    encoded: int  # keyframes
    finished: bool


@get("/health", responses=FAULTS)
async def health(state: State) -> Alive:
    """Every process that is alive, and of those that do not answer, why."""
    found = await system_of(state).health()
    return Alive(found.processes, found.silent)


@get("/v1/robots")
async def robots(state: State) -> list[str]:
    """The robot that this service was started for, and all others whose scene has changed since."""
    return system_of(state).robots()


@post("/v1/{robot:str}/query", status_code=200, responses=FAULTS)
async def query(state: State, robot: Robot, data: JSONBody[Questions]) -> SceneAnswer:
    """Any questions, answered over one revision."""
    return await system_of(state).answers(robot, *data.questions)


@get("/v1/{robot:str}/regions", responses=FAULTS)
async def regions(state: State, robot: Robot, label: Label = "", limit: Count = MOST_LISTED) -> Answered:
    """Regions, of a label where one is given, with their places in the world and probabilities."""
    return await _listed(state, robot, "region", label, limit)


@get("/v1/{robot:str}/objects", responses=FAULTS)
async def objects(state: State, robot: Robot, label: Label = "", limit: Count = MOST_LISTED) -> Answered:
    """Objects, of a label where one is given."""
    return await _listed(state, robot, "object", label, limit)


@get("/v1/{robot:str}/regions/{number:int}", responses=FAULTS)
async def region(state: State, robot: Robot, number: FromPath[int], limit: Count = MOST_RANKED) -> RegionInFull:
    """One region: its outline and ways out, what else it may be (`limit` labels), and where one can go from it."""
    questions = (
        _asked(ById, what="region", id=number),
        _asked(BeliefsOf, region=number, limit=limit),
        _asked(NeighboursOf, what="region", id=number),
    )
    found = await system_of(state).answers(robot, *questions)
    details, candidates, around = found.answers
    _there(details)
    note = _left_out(candidates, "limit")
    return RegionInFull(found.robot, found.revision, found.stamp_ns, details, candidates, around, note)  # type: ignore[arg-type]


@get("/v1/{robot:str}/objects/{number:int}", responses=FAULTS)
async def object_(state: State, robot: Robot, number: FromPath[int]) -> Answered:
    """One object."""
    return _there_in(await _one(state, robot, _asked(ById, what="object", id=number)))


@get("/v1/{robot:str}/places/{number:int}", responses=FAULTS)
async def place(state: State, robot: Robot, number: FromPath[int]) -> Answered:
    """One place: its radius, its beliefs, its opening to unobserved space."""
    return _there_in(await _one(state, robot, _asked(ById, what="place", id=number)))


@get("/v1/{robot:str}/levels", responses=FAULTS)
async def levels(
    state: State,
    robot: Robot,
    *,
    level: FromQuery[LevelName | None] = None,
    label: Label = "",
    region: FromQuery[int | None] = None,
    limit: Count = MOST_LISTED,
) -> Answered:
    """Zones, floors, buildings and districts with their regions: all, of one level, of a label, or those that hold a
    region."""
    return await _one(state, robot, _asked(NodesOf, level=level, label=label, region=region, limit=limit))


@get("/v1/{robot:str}/markers", responses=FAULTS)
async def markers(state: State, robot: Robot, limit: Count = MOST_LISTED) -> Answered:
    """Printed markers with their poses, the regions they hang in, and why one may be doubted."""
    return await _one(state, robot, _asked(MarkersOf, limit=limit))


@get("/v1/{robot:str}/markers/{number:int}", responses=FAULTS)
async def marker(state: State, robot: Robot, number: FromPath[int], limit: Count = MOST_LISTED) -> Answered:
    """The printed marker of a number; of several dictionaries, one of each."""
    found = await _one(state, robot, _asked(MarkersOf, id=number, limit=limit))
    if isinstance(found.answer, Markers) and not found.answer.markers:
        raise NotInSceneError(found.answer.reason)
    return found


@get("/v1/{robot:str}/near", responses=FAULTS)
async def near(
    state: State,
    robot: Robot,
    *,
    x: Coordinate,
    y: Coordinate,
    z: Coordinate,
    what: FromQuery[What] = "object",
    label: Label = "",
    k: Count = 1,
) -> Answered:
    """The nearest `k` of a kind, the nearest first."""
    return await _one(state, robot, _asked(Nearest, point_m=(x, y, z), what=what, label=label, limit=k), "k")


@get("/v1/{robot:str}/within", responses=FAULTS)
async def within(
    state: State,
    robot: Robot,
    *,
    x: Coordinate,
    y: Coordinate,
    z: Coordinate,
    radius_m: Distance,
    what: FromQuery[What | None] = None,
    label: Label = "",
    limit: Count = MOST_LISTED,
) -> Answered:
    """What is no farther from a point, the nearest first; without `what`, regions and objects."""
    question = _asked(InRadius, point_m=(x, y, z), radius_m=radius_m, what=what, label=label, limit=limit)
    return await _one(state, robot, question)


@get("/v1/{robot:str}/route", responses=FAULTS)
async def route(
    state: State,
    robot: Robot,
    start: Annotated[str, QueryParameter(name="from", max_length=120, description=ENDS)],
    goal: Annotated[str, QueryParameter(name="to", max_length=120, description=ENDS)],
    clearance_m: Distance = 0.0,
) -> Answered:
    """The shortest way over the place graph on which nothing is closer than `clearance_m`."""
    ends = {"start": _asked(spot_in, text=start), "goal": _asked(spot_in, text=goal)}
    return await _one(state, robot, _asked(RouteBetween, **ends, clearance_m=clearance_m))


@get("/v1/{robot:str}/search", responses=FAULTS)
async def search(
    state: State,
    robot: Robot,
    q: Annotated[str, QueryParameter(min_length=1, max_length=LONGEST_SEARCH)],
    what: FromQuery[What | None] = None,
    k: Count = MOST_RANKED,
) -> Answered:
    """What answers a text such as "somewhere to sit and eat", the best first; at a score of 0.5 it is as likely right
    as not. `note` says so where only words were compared."""
    return _first(await system_of(state).find(robot, q, what, k), "k")


@get("/v1/{robot:str}/unseen", responses=FAULTS)
async def unseen(
    state: State,
    robot: Robot,
    *,
    label: Annotated[str, QueryParameter(min_length=1, max_length=LONGEST_NAME)],
    start: Annotated[str, QueryParameter(name="from", max_length=120, description=ENDS)] = "here",
    clearance_m: Distance = 0.0,
    limit: Count = MOST_RANKED,
) -> Answered:
    """Behind which openings a region of a label that has not been seen is likely found first, the best to begin with
    first (by `per_metre`), and the way to the first. All of it is predicted."""
    begin = _asked(spot_in, text=start)
    return await _one(state, robot, _asked(WhereToLook, label=label, start=begin, clearance_m=clearance_m, limit=limit))


@get("/v1/{robot:str}/missing", responses=FAULTS)
async def missing(state: State, robot: Robot, limit: Count = MOST_RANKED) -> Answered:
    """Labels of regions that are probably still to be found behind the map's openings. All of it is predicted."""
    return await _one(state, robot, _asked(WhatIsMissing, limit=limit))


@get("/v1/{robot:str}/changes", responses=FAULTS)
async def changes(state: State, robot: Robot, since: Annotated[int, QueryParameter(ge=-1)]) -> Answered:
    """What is new, gone and renamed since a revision; `reason` where that one is not kept."""
    return await _one(state, robot, _asked(ChangedSince, revision=since))


@get("/v1/{robot:str}/source", responses=FAULTS)
async def source(state: State, robot: Robot) -> Progress:
    """How far the source is read; once `finished`, the map grows no more."""
    read = system_of(state).source(robot)
    return Progress(robot, read.frames_read, read.frames_total, read.encoded, read.finished)


@get("/v1/{robot:str}/task", responses=FAULTS)
async def task(state: State, robot: Robot) -> Answered:
    """The task and environment that the regions follow, with the labels that regions can have and that are in use."""
    return await _one(state, robot, WordsInUse())


READING = [
    health,
    robots,
    query,
    regions,
    objects,
    region,
    object_,
    place,
    levels,
    markers,
    marker,
    near,
    within,
    route,
    search,
    unseen,
    missing,
    changes,
    source,
    task,
]


def _asked(kind: Callable[..., Q], **fields: Any) -> Q:
    """A question. Raises FaultyRequestError where it holds what none may hold."""
    try:
        return kind(**fields)
    except ValueError as error:
        raise FaultyRequestError(str(error)) from error


async def _one(state: State, robot: str, question: Question, limit: str = "limit") -> Answered:
    return _first(await system_of(state).answers(robot, question), limit)


def _first(found: SceneAnswer, limit: str) -> Answered:
    """`limit` is what the request calls the number of things that it wants."""
    answer = found.answers[0]
    return Answered(found.robot, found.revision, found.stamp_ns, answer, _left_out(answer, limit))


def _left_out(answer: Answer, limit: str) -> str:
    listed, total = listed_of(answer)
    if len(listed) == total:
        return ""
    more = "lists all" if total <= MOST_LIMIT else "lists the most; the whole scene (scene.json) has all"
    return f"{len(listed)} of {total} are listed; {limit}={min(total, MOST_LIMIT)} {more}"


async def _listed(state: State, robot: str, what: What, label: str, limit: int) -> Answered:
    if label:
        return await _one(state, robot, ByLabel(label=label, what=what, limit=limit))
    return await _one(state, robot, InBox(**EVERYWHERE, what=what, limit=limit))


def _there(answer: Answer) -> None:
    """Raise NotInSceneError for what does not exist."""
    if isinstance(answer, Details) and answer.thing is None:
        raise NotInSceneError(answer.reason)


def _there_in(answered: Answered) -> Answered:
    _there(answered.answer)
    return answered

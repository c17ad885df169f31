"""What can be read over HTTP. Each handler asks the store; `revision` in an answer is the scene's that it is about."""

from collections.abc import AsyncIterator, Callable
from typing import Annotated, Any, TypeVar

import msgspec
from litestar import Request, Response, get, post
from litestar.datastructures import State
from litestar.openapi.datastructures import ResponseSpec
from litestar.params import Parameter
from litestar.response import ServerSentEvent, ServerSentEventMessage

from prior_sg.deploy.api.errors import NotInSceneError
from prior_sg.deploy.json_text import json_text
from prior_sg.deploy.serving.errors import FaultyRequestError
from prior_sg.deploy.serving.events import Event
from prior_sg.deploy.serving.gate import PROBLEM
from prior_sg.deploy.serving.spots import ENDS, spot_in
from prior_sg.deploy.serving.system import LONGEST_SEARCH, MOST_LIMIT, MOST_QUESTIONS, System
from prior_sg.deploy.showing.export import scene_json
from prior_sg.deploy.showing.text import LEAST_TOKENS, MOST_TOKENS, USUAL_TOKENS, scene_text
from prior_sg.schemas.codec import encode
from prior_sg.schemas.queries import (
    MOST_LISTED,
    MOST_RANKED,
    Answer,
    BeliefsOf,
    ById,
    ByLabel,
    ChangedSince,
    Details,
    InBox,
    InRadius,
    Nearest,
    Neighbourhood,
    NeighboursOf,
    Question,
    RegionBeliefs,
    RouteBetween,
    SceneAnswer,
    Things,
    What,
    Words,
    WordsInUse,
)
from prior_sg.schemas.scene import Scene
from prior_sg.schemas.status import ServiceStatus

MSGPACK = "application/vnd.msgpack"
Robot = Annotated[str, Parameter(description="Name of the robot.", min_length=1, max_length=64)]
Count = Annotated[int, Parameter(ge=1, le=MOST_LIMIT)]
Coordinate = Annotated[float, Parameter(ge=-1e9, le=1e9, description="World, metres.")]
Label = Annotated[str, Parameter(max_length=80)]
Distance = Annotated[float, Parameter(ge=0, le=1e9, description="Metres.")]
Tokens = Annotated[int, Parameter(ge=LEAST_TOKENS, le=MOST_TOKENS)]
Plain = Request[Any, Any, Any]
LOWEST, HIGHEST = (-1e9,) * 3, (1e9,) * 3
EVERY_REGION = InBox(min_m=LOWEST, max_m=HIGHEST, what="region", limit=MOST_LIMIT)
Q = TypeVar("Q")
FAULTS = {
    status: ResponseSpec(dict[str, Any], media_type=PROBLEM, description=why, generate_examples=False)
    for status, why in {
        400: "What was asked can never be answered.",
        404: "There is none such.",
        422: "It cannot be done; the sentence says why.",
        429: "Too much of this goes on; try again.",
        503: "The system does not answer.",
    }.items()
}


class Questions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Questions that are answered over one revision, in their order."""

    questions: Annotated[list[Question], msgspec.Meta(max_length=MOST_QUESTIONS)]


class Answered(msgspec.Struct, frozen=True):
    """One answer and the revision that it is about."""

    robot: str
    revision: int
    stamp_ns: int
    answer: Answer


class Summary(msgspec.Struct, frozen=True):
    """A scene in short."""

    robot: str
    revision: int
    stamp_ns: int
    words: Words
    regions: Things


class RegionInFull(msgspec.Struct, frozen=True):
    """All about a region."""

    robot: str
    revision: int
    stamp_ns: int
    details: Details
    candidates: RegionBeliefs
    neighbours: Neighbourhood


class Alive(msgspec.Struct, frozen=True):
    """Health of the system."""

    processes: list[ServiceStatus]
    silent: dict[str, str]  # why they do not answer, by instance


@get("/health", responses=FAULTS)
async def health(state: State) -> Alive:
    """Every process that is alive, and of those that do not answer, why."""
    found = await _system(state).health()
    return Alive(found.processes, found.silent)


@get("/v1/robots")
async def robots(state: State) -> list[str]:
    """The robot that this service was started for, and all others whose scene has changed since."""
    return _system(state).robots()


@get("/v1/{robot:str}/scene", responses=FAULTS)
async def scene(state: State, robot: Robot, request: Plain) -> Response[Summary | None]:
    """The scene in short: task, vocabulary and regions. Its ETag tells of changes (If-None-Match)."""
    tag = await _system(state).tag(robot)
    if _is_known(request, tag):
        return Response(None, status_code=304, headers=_tagged(tag))
    found = await _system(state).answers(robot, WordsInUse(), EVERY_REGION)
    words, regions = found.answers
    summary = Summary(found.robot, found.revision, found.stamp_ns, words, regions)  # type: ignore[arg-type]
    return Response(summary, headers=_tagged(tag))


@get("/v1/{robot:str}/scene.json", responses=FAULTS, media_type="application/json")
async def scene_in_full(state: State, robot: Robot, request: Plain) -> Response[bytes]:
    """The scene in full, in the layout of scene.json."""
    return await _written(state, robot, request, "application/json", _json)


@get("/v1/{robot:str}/scene.msgpack", responses=FAULTS, media_type=MSGPACK)
async def scene_packed(state: State, robot: Robot, request: Plain) -> Response[bytes]:
    """The scene in full, as it travels on the bus: MessagePack of `Scene`, arrays as extension type 1."""
    return await _written(state, robot, request, MSGPACK, encode)


@get("/v1/{robot:str}/scene.txt", responses=FAULTS, media_type="text/plain")
async def scene_told(state: State, robot: Robot, request: Plain, budget_tokens: Tokens = USUAL_TOKENS) -> Response[bytes]:
    """The scene in few words, for language models: the most useful first, within a budget of tokens."""

    def write(found: Scene) -> bytes:
        return scene_text(found, budget_tokens).encode()

    return await _written(state, robot, request, f"text/plain; budget={budget_tokens}", write)


@post("/v1/{robot:str}/query", status_code=200, responses=FAULTS)
async def query(state: State, robot: Robot, data: Questions) -> SceneAnswer:
    """Any questions, answered over one revision."""
    return await _system(state).answers(robot, *data.questions)


@get("/v1/{robot:str}/regions", responses=FAULTS)
async def regions(state: State, robot: Robot, label: Label = "", limit: Count = MOST_LISTED) -> Answered:
    """Regions, of a label where one is given, with their places in the world and probabilities."""
    return await _listed(state, robot, "region", label, limit)


@get("/v1/{robot:str}/objects", responses=FAULTS)
async def objects(state: State, robot: Robot, label: Label = "", limit: Count = MOST_LISTED) -> Answered:
    """Objects, of a label where one is given."""
    return await _listed(state, robot, "object", label, limit)


@get("/v1/{robot:str}/regions/{number:int}", responses=FAULTS)
async def region(state: State, robot: Robot, number: int) -> RegionInFull:
    """One region: its outline and ways out, what else it may be, and where one can go from it."""
    questions = (
        _asked(ById, what="region", id=number),
        _asked(BeliefsOf, region=number),
        _asked(NeighboursOf, what="region", id=number),
    )
    found = await _system(state).answers(robot, *questions)
    details, candidates, around = found.answers
    _there(details)
    return RegionInFull(found.robot, found.revision, found.stamp_ns, details, candidates, around)  # type: ignore[arg-type]


@get("/v1/{robot:str}/objects/{number:int}", responses=FAULTS)
async def object_(state: State, robot: Robot, number: int) -> Answered:
    """One object."""
    return _there_in(await _one(state, robot, _asked(ById, what="object", id=number)))


@get("/v1/{robot:str}/places/{number:int}", responses=FAULTS)
async def place(state: State, robot: Robot, number: int) -> Answered:
    """One place: its radius, its beliefs, its opening to unobserved space."""
    return _there_in(await _one(state, robot, _asked(ById, what="place", id=number)))


@get("/v1/{robot:str}/near", responses=FAULTS)
async def near(
    state: State,
    robot: Robot,
    x: Coordinate,
    y: Coordinate,
    z: Coordinate,
    what: What = "object",
    label: Label = "",
    k: Count = 1,
) -> Answered:
    """The nearest `k` of a kind, the nearest first."""
    return await _one(state, robot, _asked(Nearest, point_m=(x, y, z), what=what, label=label, limit=k))


@get("/v1/{robot:str}/within", responses=FAULTS)
async def within(
    state: State,
    robot: Robot,
    x: Coordinate,
    y: Coordinate,
    z: Coordinate,
    radius_m: Distance,
    what: What | None = None,
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
    start: Annotated[str, Parameter(query="from", max_length=120, description=ENDS)],
    goal: Annotated[str, Parameter(query="to", max_length=120, description=ENDS)],
    clearance_m: Distance = 0.0,
) -> Answered:
    """The shortest way over the place graph on which nothing is closer than `clearance_m`."""
    return await _one(
        state, robot, _asked(RouteBetween, start=spot_in(start), goal=spot_in(goal), clearance_m=clearance_m)
    )


@get("/v1/{robot:str}/search", responses=FAULTS)
async def search(
    state: State,
    robot: Robot,
    q: Annotated[str, Parameter(min_length=1, max_length=LONGEST_SEARCH)],
    what: What | None = None,
    k: Count = MOST_RANKED,
) -> Answered:
    """What answers a text such as "somewhere to sit and eat", the best first; at a score of 0.5 it is as likely right as
    not. `note` says so where only words were compared."""
    return _first(await _system(state).find(robot, q, what, k))


@get("/v1/{robot:str}/changes", responses=FAULTS)
async def changes(state: State, robot: Robot, since: Annotated[int, Parameter(ge=-1)]) -> Answered:
    """What is new, gone and renamed since a revision; `reason` where that one is not kept."""
    return await _one(state, robot, _asked(ChangedSince, revision=since))


@get("/v1/{robot:str}/task", responses=FAULTS)
async def task(state: State, robot: Robot) -> Answered:
    """The task and environment that the regions follow, with the labels that regions can have and that are in use."""
    return await _one(state, robot, WordsInUse())


@get("/v1/{robot:str}/events", responses=FAULTS, media_type="text/event-stream")
async def events(
    state: State, robot: Robot, last_event_id: Annotated[str | None, Parameter(header="Last-Event-ID")] = None
) -> ServerSentEvent:
    """Server-sent events: `changes` with what is new, gone and renamed, `id` the revision. A connection that names the
    last one it has goes on from there; where that is not kept, and in the beginning, comes a `snapshot`."""
    if last_event_id is not None and not (last_event_id.isascii() and last_event_id.isdigit() and len(last_event_id) < 19):
        raise FaultyRequestError("Last-Event-ID is not the id of an event: send a revision, or leave it out")
    followed = state["feeds"].follow(robot, None if last_event_id is None else int(last_event_id))
    return ServerSentEvent(_messages(await anext(followed), followed))


READING = [
    health,
    robots,
    scene,
    scene_in_full,
    scene_packed,
    scene_told,
    query,
    regions,
    objects,
    region,
    object_,
    place,
    near,
    within,
    route,
    search,
    changes,
    task,
    events,
]


async def _messages(first: Event | None, followed: AsyncIterator[Event | None]) -> AsyncIterator[ServerSentEventMessage]:
    yield _message(first)
    async for event in followed:
        yield _message(event)


def _message(event: Event | None) -> ServerSentEventMessage:
    if event is None:
        return ServerSentEventMessage(data=None, comment="nothing new")
    return ServerSentEventMessage(json_text(event.data, indent=None), event=event.name, id=event.revision)


def _system(state: State) -> System:
    system: System = state["system"]
    return system


def _asked(kind: Callable[..., Q], **fields: Any) -> Q:
    """A question. Raises FaultyRequestError where it holds what none may hold."""
    try:
        return kind(**fields)
    except ValueError as error:
        raise FaultyRequestError(str(error)) from error


async def _one(state: State, robot: str, question: Question) -> Answered:
    return _first(await _system(state).answers(robot, question))


def _first(found: SceneAnswer) -> Answered:
    return Answered(found.robot, found.revision, found.stamp_ns, found.answers[0])


async def _listed(state: State, robot: str, what: What, label: str, limit: int) -> Answered:
    if label:
        return await _one(state, robot, ByLabel(label=label, what=what, limit=limit))
    return await _one(state, robot, InBox(min_m=LOWEST, max_m=HIGHEST, what=what, limit=limit))


def _there(answer: Answer) -> None:
    """Raise NotInSceneError for what does not exist."""
    if isinstance(answer, Details) and answer.thing is None:
        raise NotInSceneError(answer.reason)


def _there_in(answered: Answered) -> Answered:
    _there(answered.answer)
    return answered


async def _written(
    state: State, robot: str, request: Plain, form: str, write: Callable[[Scene], bytes]
) -> Response[bytes]:
    """A whole scene, unless whoever asks has it."""
    tag = await _system(state).tag(robot)
    if _is_known(request, tag):
        return Response(b"", status_code=304, headers=_tagged(tag))
    body = await _system(state).written(robot, tag, form, write)
    return Response(body, media_type=form.split(";")[0], headers=_tagged(tag))


def _json(found: Scene) -> bytes:
    return json_text(scene_json(found), indent=None).encode()


def _is_known(request: Plain, tag: str) -> bool:
    known = request.headers.get("if-none-match", "")
    return known.strip() == "*" or _weak(tag) in (one.strip() for one in known.split(","))


def _tagged(tag: str) -> dict[str, str]:
    """Weak: a scene may be a revision newer than its tag says, and is then sent once more."""
    return {"etag": _weak(tag), "cache-control": "no-cache"}


def _weak(tag: str) -> str:
    return f'W/"{tag}"'

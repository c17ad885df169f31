"""Whole scenes over HTTP, in several forms, and their changes as they come."""

from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Annotated, Any

import msgspec
from litestar import Request, Response, get
from litestar.datastructures import State
from litestar.params import HeaderParameter
from litestar.response import ServerSentEvent, ServerSentEventMessage

from prior_sg.deploy.json_text import json_text
from prior_sg.deploy.serving.errors import FaultyRequestError
from prior_sg.deploy.serving.events import Event
from prior_sg.deploy.serving.parameters import FAULTS, Robot, Tokens, system_of
from prior_sg.deploy.serving.system import EVERYWHERE, MOST_LIMIT
from prior_sg.deploy.showing.export import scene_json
from prior_sg.deploy.showing.text import USUAL_TOKENS
from prior_sg.schemas.answers import Things, Words
from prior_sg.schemas.codec import encode
from prior_sg.schemas.queries import InBox, WordsInUse
from prior_sg.schemas.scene import Scene

MSGPACK = "application/vnd.msgpack"
LONGEST_ID = 18  # digits
Plain = Request[Any, Any, Any]
EVERY_REGION = InBox(**EVERYWHERE, what="region", limit=MOST_LIMIT)


class Summary(msgspec.Struct, frozen=True):
    """A scene in short."""

    robot: str
    revision: int
    stamp_ns: int
    words: Words
    regions: Things


@get("/v1/{robot:str}/scene", responses=FAULTS)
async def scene(state: State, robot: Robot, request: Plain) -> Response[Summary | None]:
    """The scene in short: task, vocabulary and regions. Its ETag tells of changes (If-None-Match)."""
    tag = await system_of(state).tag(robot)
    if _is_known(request, tag):
        return Response(None, status_code=304, headers=_tagged(tag))
    found = await system_of(state).answers(robot, WordsInUse(), EVERY_REGION)
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
async def scene_told(
    state: State, robot: Robot, request: Plain, budget_tokens: Tokens = USUAL_TOKENS
) -> Response[bytes]:
    """The scene in few words, for language models: the most useful first, within a budget of tokens."""
    system = system_of(state)
    return await _answered(state, robot, request, "text/plain", lambda tag: system.told(robot, tag, budget_tokens))


@get("/v1/{robot:str}/events", responses=FAULTS, media_type="text/event-stream")
async def events(
    state: State, robot: Robot, last_event_id: Annotated[str | None, HeaderParameter(name="Last-Event-ID")] = None
) -> ServerSentEvent:
    """Server-sent events: `changes` with what is new, gone and renamed, `id` the revision. A connection that names the
    last one it has goes on from there; where that is not kept, and in the beginning, comes a `snapshot`."""
    if last_event_id is not None and not (
        last_event_id.isascii() and last_event_id.isdigit() and len(last_event_id) < 19
    ):
        raise FaultyRequestError("Last-Event-ID is not the id of an event: send a revision, or leave it out")
    followed = state["feeds"].follow(robot, None if last_event_id is None else int(last_event_id))
    return ServerSentEvent(_messages(await anext(followed), followed))


WHOLES = [scene, scene_in_full, scene_packed, scene_told, events]


async def _messages(
    first: Event | None, followed: AsyncIterator[Event | None]
) -> AsyncIterator[ServerSentEventMessage]:
    yield _message(first)
    async for event in followed:
        yield _message(event)


def _message(event: Event | None) -> ServerSentEventMessage:
    if event is None:
        return ServerSentEventMessage(data=None, comment="nothing new")
    return ServerSentEventMessage(json_text(event.data, indent=None), event=event.name, id=event.revision)


async def _answered(
    state: State, robot: str, request: Plain, media_type: str, write: Callable[[str], Awaitable[bytes]]
) -> Response[bytes]:
    """A whole scene as written for a tag, unless whoever asks has it."""
    tag = await system_of(state).tag(robot)
    if _is_known(request, tag):
        return Response(b"", status_code=304, headers=_tagged(tag))
    return Response(await write(tag), media_type=media_type, headers=_tagged(tag))


async def _written(
    state: State, robot: str, request: Plain, form: str, write: Callable[[Scene], bytes]
) -> Response[bytes]:
    system = system_of(state)
    return await _answered(state, robot, request, form, lambda tag: system.written(robot, tag, form, write))


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

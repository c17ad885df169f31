"""A running system and a server in front of it."""

import contextlib
from collections.abc import Callable, Iterator

from prior_sg.deploy.serving.gate import Entrance
from prior_sg.deploy.serving.system import System
from prior_sg.services.runtime.hearing import end_deaf
from prior_sg.services.runtime.zenoh_bus import ZenohBus

Say = Callable[[str], None]


@contextlib.contextmanager
def joined(connect: str, robot: str) -> Iterator[System]:
    """The system behind a router. Raises BusError."""
    system = System(lambda: ZenohBus(connect, on_deaf=end_deaf), robot)
    try:
        yield system
    finally:
        system.close()


def serve_api(connect: str, robot: str, entrance: Entrance, port: int, say: Say, *, parent: int = 0) -> None:
    """HTTP until a signal. Raises BusError, UserError, KeyboardInterrupt."""
    from prior_sg.deploy.serving.events import Feeds
    from prior_sg.deploy.serving.http import http_app
    from prior_sg.deploy.serving.server import address_of, listening, serve

    with listening(entrance.host, port) as listener, joined(connect, robot) as system:
        feeds = Feeds(system)
        say(f"HTTP on {address_of(listener)}, described in {address_of(listener)}/openapi/openapi.json")
        serve(http_app(system, feeds, entrance), listener, feeds.close, parent)


def serve_planner(connect: str, robot: str, entrance: Entrance, port: int, say: Say) -> None:
    """MCP over streamable HTTP until a signal. Raises BusError, UserError, KeyboardInterrupt."""
    from prior_sg.deploy.serving.planner import planner_app
    from prior_sg.deploy.serving.server import address_of, listening, serve

    with listening(entrance.host, port) as listener, joined(connect, robot) as system:
        say(f"MCP on {address_of(listener)}/mcp")
        serve(planner_app(system, entrance), listener)


def serve_planner_here(connect: str, robot: str) -> None:
    """MCP over standard input and output until these end. Raises BusError."""
    from prior_sg.deploy.serving.planner import planner

    with joined(connect, robot) as system:
        planner(system).run("stdio")

"""Commands that open a running system to other programs: HTTP, and tools of planners."""

import argparse
from pathlib import Path

from prior_sg.deploy.cli.shared import Commands, add_bus, console, until_interrupted
from prior_sg.deploy.errors import UsageError

API_PORT, MCP_PORT = 8000, 8001
LAST_PORT = 65535


def add_commands(commands: Commands) -> None:
    """`serve-api` and `mcp`."""
    api = commands.add(
        "serve-api",
        cmd_serve_api,
        "serve the scenes of a running system over HTTP, until Ctrl-C",
        "prior-sg serve-api --port 8000",
        needs="api",
    )
    add_entrance(api, API_PORT)
    add_bus(api)
    mcp = commands.add(
        "mcp",
        cmd_mcp,
        "give a language model tools that ask a running system (MCP)",
        "prior-sg mcp --http",
        needs="mcp",
    )
    mcp.add_argument("--http", action="store_true", help="over HTTP; default: over standard input and output")
    add_entrance(mcp, MCP_PORT)
    add_bus(mcp)


def add_entrance(parser: argparse.ArgumentParser, port: int) -> None:
    """Where a server listens and whom it lets in."""
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on (default: %(default)s)")
    parser.add_argument("--port", type=port_in, default=port, help="port, 0 = any free one (default: %(default)s)")
    parser.add_argument(
        "--token-file", type=Path, default=None, help="file with the token that every request must bear"
    )


def port_in(text: str) -> int:
    """A port number as an argument."""
    if not text.isascii() or not text.isdigit() or int(text) > LAST_PORT:
        raise argparse.ArgumentTypeError(f"{text!r} is no port: give a number up to {LAST_PORT}")
    return int(text)


def cmd_serve_api(arguments: argparse.Namespace) -> int:
    """HTTP until Ctrl-C."""
    from prior_sg.deploy.serving.door import serve_api
    from prior_sg.deploy.serving.gate import entrance

    entry = entrance(arguments.host, arguments.token_file)
    with until_interrupted():
        serve_api(arguments.connect, arguments.robot, entry, arguments.port, say_until)
    return 0


def cmd_mcp(arguments: argparse.Namespace) -> int:
    """MCP until Ctrl-C, or until the client ends."""
    from prior_sg.deploy.serving.door import serve_planner, serve_planner_here
    from prior_sg.deploy.serving.gate import entrance

    if not arguments.http:
        if arguments.token_file is not None:
            raise UsageError("a token is asked for over HTTP only: add --http, or leave --token-file")
        serve_planner_here(arguments.connect, arguments.robot)
        return 0
    entry = entrance(arguments.host, arguments.token_file)
    with until_interrupted():
        serve_planner(arguments.connect, arguments.robot, entry, arguments.port, say_until)
    return 0


def say_until(text: str) -> None:
    """Where it listens, and how it ends."""
    console.print(f"{text}; Ctrl-C stops")

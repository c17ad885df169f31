"""The command that serves a map to Foxglove, on this machine."""

import argparse
from pathlib import Path

from prior_sg.deploy.cli.doors import port_in
from prior_sg.deploy.cli.shared import Commands, add_bus, console, until_interrupted, writing
from prior_sg.deploy.cli.view import source_of

FOXGLOVE_PORT = 8765  # that Foxglove proposes
WAIT_S = 0.2


def add_commands(commands: Commands) -> None:
    """`foxglove`."""
    foxglove = commands.add(
        "foxglove",
        cmd_foxglove,
        "look at a map in Foxglove: a running system, or a run that is over",
        "prior-sg foxglove --layout layout.json",
        needs="foxglove",
    )
    foxglove.add_argument(
        "source",
        nargs="?",
        help="a run's folder, its log.mcap, its scene.sqlite or a PostgreSQL address; default: what runs now",
    )
    foxglove.add_argument(
        "--port", type=port_in, default=FOXGLOVE_PORT, help="port, 0 = any free one (default: %(default)s)"
    )
    foxglove.add_argument("--layout", type=Path, default=None, metavar="FILE", help="also write a layout to import")
    add_bus(foxglove)


def cmd_foxglove(arguments: argparse.Namespace) -> int:
    """Serve until Ctrl-C."""
    from prior_sg.deploy.interrupts import insist
    from prior_sg.deploy.viewing.foxglove.layout import save_layout
    from prior_sg.deploy.viewing.foxglove.server import serve

    if arguments.layout is not None:
        with writing(arguments.layout):
            save_layout(arguments.layout)
        console.print(f"layout: {arguments.layout} (in Foxglove: Layouts, Import from file)")

    def say(address: str) -> None:
        console.print(f"in Foxglove, open the connection {address} ({source.title}); Ctrl-C stops")

    source = source_of(arguments)
    try:
        with until_interrupted():
            serve(source, arguments.port, say, WAIT_S, insist)
    finally:
        source.close()
    return 0

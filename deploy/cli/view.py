"""The live page: `prior-sg view`."""

import argparse
from typing import TYPE_CHECKING

from prior_sg.deploy.cli.shared import Commands, add_bus, console, until_interrupted, wait
from prior_sg.deploy.errors import UsageError
from prior_sg.deploy.settings import ROUTER_WAIT_S

if TYPE_CHECKING:
    from prior_sg.deploy.viewing.sources import Source

LOOPBACK = ("127.0.0.1", "localhost", "::1")


def add_commands(commands: Commands) -> None:
    """`view`."""
    view = commands.add(
        "view",
        cmd_view,
        "look at a map in the browser: a running system, or a run that is over",
        "prior-sg view out/demo",
        needs="view",
    )
    view.add_argument(
        "source",
        nargs="?",
        help="a run's folder, its log.mcap, its scene.sqlite or a PostgreSQL address; default: what runs now",
    )
    view.add_argument("--host", default="127.0.0.1", help="address to serve on, of this machine (default: %(default)s)")
    view.add_argument("--port", type=int, default=8080, help="port, or the next free one (default: %(default)s)")
    view.add_argument("--light", action="store_true", help="dark on light")
    view.add_argument("--interval", type=float, default=0.2, help="seconds between updates, at least")
    view.add_argument("--max-mbit", type=float, default=0.0, help="Mbit/s for thin links; 0 = no limit (default)")
    add_bus(view)


def cmd_view(arguments: argparse.Namespace) -> int:
    """Serve the page until Ctrl-C."""
    from prior_sg.deploy.viewing.page import Options, Page

    if arguments.host not in LOOPBACK:
        raise UsageError(
            f"the page has no login, so it is served to this machine alone, not on {arguments.host}; from elsewhere, "
            f"open a tunnel: ssh -L {arguments.port}:127.0.0.1:{arguments.port} USER@THIS-MACHINE"
        )
    source = source_of(arguments)
    options = Options(
        arguments.host, arguments.port, not arguments.light, max(arguments.interval, 0.02), arguments.max_mbit
    )
    page = Page(source, options)
    console.print(f"look at it: {page.address} ({source.title}); Ctrl-C stops")
    try:
        with until_interrupted():
            wait()
        return 0
    finally:
        page.close()
        source.close()


def source_of(arguments: argparse.Namespace) -> "Source":
    """What is looked at: a run that is over, or the robot on the bus."""
    if arguments.source is not None:
        from prior_sg.deploy.viewing.recorded import open_recorded

        return open_recorded(arguments.source, arguments.robot)
    from prior_sg.deploy.viewing.live import Live
    from prior_sg.services.runtime.zenoh_bus import ZenohBus

    return Live(ZenohBus(arguments.connect, ROUTER_WAIT_S), arguments.robot)

"""The command that exchanges a running service."""

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING

from prior_sg.deploy.cli.shared import Commands, add_bus, add_settings, console, open_client
from prior_sg.deploy.errors import UserError
from prior_sg.deploy.running import serve
from prior_sg.services.roles import NAMES

if TYPE_CHECKING:
    from prior_sg.services.runtime.client import BusClient

ROUTER = "router"
TIMEOUT_S = 240.0  # a successor may load a network, catch up and wait for a conversation of its predecessor
ANSWER_S = 10.0  # of who holds the router
BACK_S = 20.0  # in which everybody is back at a router that was started again
POLL_S = 0.05


def add_commands(commands: Commands) -> None:
    """`swap`."""
    swap = commands.add(
        "swap",
        cmd_swap,
        "exchange a service while it runs: a successor catches up, takes over, and the former ends",
        "prior-sg swap segmenter --set segmenter.beta=3",
        needs="map",
    )
    swap.add_argument("service", choices=[*sorted(NAMES), ROUTER], help="what to exchange")
    swap.add_argument("--instance", default="", help="which process of several; default: each in turn")
    swap.add_argument("--encoder", default="", help="the encoder of a new feature worker (docs/encoders.md)")
    swap.add_argument(
        "--here",
        action="store_true",
        help="run the successor in this terminal, where no `prior-sg up` has started the service",
    )
    add_settings(swap)
    add_bus(swap)


def cmd_swap(arguments: argparse.Namespace) -> int:
    """Exchange what was named; returns when the successors are in charge."""
    from prior_sg.services.runtime.config import read_file

    read_file(arguments.config)  # says at once what is wrong with it
    with open_client(arguments.connect) as client:
        if arguments.service == ROUTER:
            return _swap_router(client)
        names = [arguments.instance] if arguments.instance else _running(client, arguments.service, arguments.robot)
        if not names:
            raise UserError(
                f"no {arguments.service} of {arguments.robot} runs; `prior-sg health` says what does, and "
                f"`prior-sg up {arguments.service}` starts one"
            )
        if not arguments.here:
            for name in names:
                _swap(client, arguments, name)
            return 0
    return _stay(arguments, names)


def _running(client: "BusClient", service: str, robot: str) -> list[str]:
    """The processes of a service that serve a robot, sorted; of those with a lease, the one in charge."""
    from prior_sg.services.registry import BY_NAME

    alive = sorted(name for name, kind in client.alive().items() if kind == service)
    if BY_NAME[service].scope != "robot":
        return alive
    in_charge = {one.instance for one in client.standings() if one.holder is not None and one.robot == robot}
    return [name for name in alive if name in in_charge]


def _swap(client: "BusClient", arguments: argparse.Namespace, name: str) -> None:
    from prior_sg.schemas.succession import SwapRequest
    from prior_sg.services.runtime.bus import BusError

    config = Path(arguments.config).read_text() if arguments.config else ""
    request = SwapRequest(settings=_settings(arguments), config=config)
    started_s = time.monotonic()
    with console.status(f"{name}: its successor starts and catches up"):
        try:
            done = client.swap(arguments.service, name, request, TIMEOUT_S)
        except BusError as error:
            raise UserError(
                f"{error}; where no `prior-sg up` of this host has started {name}, --here runs its successor in this "
                "terminal"
            ) from error
    if done.error:
        raise UserError(f"not exchanged: {done.error}")
    console.print(f"{name} → {done.successor} after {time.monotonic() - started_s:.1f} s")


def _settings(arguments: argparse.Namespace) -> list[str]:
    from prior_sg.deploy.cli.jobs import encoder_settings

    return [*encoder_settings(arguments.encoder), *arguments.set]


def _stay(arguments: argparse.Namespace, names: list[str]) -> int:
    """Run the successor here, until it is exchanged itself or stopped."""
    if len(names) > 1:
        raise UserError(f"name one of {', '.join(names)} with --instance")
    parser = argparse.ArgumentParser()
    serve.add_arguments(parser)
    told = [arguments.service, "--robot", arguments.robot, "--connect", arguments.connect, "--succeeds", names[0]]
    told += ["--config", arguments.config] if arguments.config else []
    for setting in _settings(arguments):
        told += ["--set", setting]
    return serve.run(parser.parse_args(told))


def _swap_router(client: "BusClient") -> int:
    """The router is started again in its place, by the `prior-sg up` that holds it."""
    from prior_sg.schemas.succession import SwapRequest

    alive = set(client.alive())
    started_s = time.monotonic()
    client.swap(ROUTER, ROUTER, SwapRequest(), ANSWER_S)
    gone = False
    while time.monotonic() - started_s < BACK_S:
        there = client.bus.connected() and alive <= set(client.alive())
        gone |= not there
        if gone and there:
            console.print(f"the router and {len(alive)} processes are back after {time.monotonic() - started_s:.1f} s")
            return 0
        time.sleep(POLL_S)
    lost = ", ".join(sorted(alive - set(client.alive()))) or "the router"
    raise UserError(f"not back within {BACK_S:.0f} s: {lost}; see `prior-sg health`")

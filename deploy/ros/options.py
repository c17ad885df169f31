"""How the bridge to ROS 2 is told what to do: the same options for the command and for the process of `up --ros`."""

import argparse
import math
import os
import re
from dataclasses import dataclass

from prior_sg.deploy.errors import UserError
from prior_sg.deploy.ros.rules import (
    COARSEST_CELL_M,
    FINEST_CELL_M,
    USUAL_CELL_M,
    USUAL_LOOK,
    Look,
    check_rules,
    rule_of,
)
from prior_sg.services.runtime.ros.session import ENDPOINT
from prior_sg.services.runtime.ros.wire import LARGEST_DOMAIN

SHORTEST_INTERVAL_S, LONGEST_INTERVAL_S = 0.1, 3600.0
FRAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_./-]{0,99}")
DOMAIN_VARIABLE = "ROS_DOMAIN_ID"


@dataclass(frozen=True)
class Options:
    """What is told where, how often, and whether anything is taken from there."""

    look: Look = USUAL_LOOK
    router: str = ENDPOINT  # of ROS
    domain: int = 0
    interval_s: float = 1.0
    takes_tasks: bool = False


def add_options(parser: argparse.ArgumentParser) -> None:
    """All options of the bridge."""
    parser.add_argument(
        "--ros-router", default=ENDPOINT, metavar="tcp/HOST:PORT", help="Zenoh router of ROS (default: %(default)s)"
    )
    parser.add_argument("--domain", default="", help=f"domain of ROS; default: {DOMAIN_VARIABLE}, else 0")
    parser.add_argument("--node", default=Look.node, help="name of the node and of its topics (default: %(default)s)")
    parser.add_argument("--frame", default=Look.frame, help="frame that the scene's world is (default: %(default)s)")
    parser.add_argument(
        "--cell", type=float, default=USUAL_CELL_M, help="size of a grid's cell, m (default: %(default)s)"
    )
    parser.add_argument(
        "--heights",
        nargs=2,
        type=float,
        metavar=("LOW", "HIGH"),
        help="heights of the places on the grids, m: one storey",
    )
    parser.add_argument(
        "--mask", action="append", default=[], metavar="LABEL=WHAT", help="for Nav2: LABEL=keepout, LABEL=slow:PERCENT"
    )
    parser.add_argument(
        "--interval",
        type=float,
        default=Options.interval_s,
        help="least seconds between updates (default: %(default)s)",
    )
    parser.add_argument("--take-tasks", action="store_true", help="let whoever is on ROS's router switch the task")


def options_of(arguments: argparse.Namespace) -> Options:
    """What was told. Raises UserError."""
    check_node(arguments.node)
    check_frame(arguments.frame)
    _check("--cell", arguments.cell, FINEST_CELL_M, COARSEST_CELL_M, "m")
    _check("--interval", arguments.interval, SHORTEST_INTERVAL_S, LONGEST_INTERVAL_S, "s")
    low_m, high_m = arguments.heights or Look.heights_m
    if not low_m < high_m:
        raise UserError(f"--heights {low_m:g} {high_m:g}: the first has to be the lower one")
    try:
        rules = check_rules(map(rule_of, arguments.mask))
    except ValueError as error:
        raise UserError(f"--mask: {error}") from error
    look = Look(arguments.node, arguments.frame, arguments.cell, (low_m, high_m), rules)
    return Options(look, arguments.ros_router, domain_of(arguments.domain), arguments.interval, arguments.take_tasks)


def check_node(name: str) -> None:
    """That a node can have this name. Raises UserError."""
    if not name.isidentifier() or not name.isascii():
        raise UserError(f"{name!r} is no name of a node: give letters, digits and _, no digit first")


def check_frame(name: str) -> None:
    """That a frame can have this name. Raises UserError."""
    if FRAME.fullmatch(name) is None:
        raise UserError(f"{name!r} is no frame: give a name such as map or robot1/odom, without a slash before it")


def _check(option: str, value: float, least: float, most: float, unit: str) -> None:
    if not math.isfinite(value) or not least <= value <= most:
        raise UserError(f"{option} {value:g} is not between {least:g} and {most:g} {unit}")


def domain_of(told: str) -> int:
    """The domain of ROS that was told, else the environment's, else 0. Raises UserError."""
    name, text = ("--domain", told) if told else (DOMAIN_VARIABLE, os.environ.get(DOMAIN_VARIABLE, "") or "0")
    if not (text.isascii() and text.isdigit() and int(text) <= LARGEST_DOMAIN):
        raise UserError(f"{name} {text!r} is no domain of ROS: give a number up to {LARGEST_DOMAIN}")
    return int(text)

"""The command that makes one map of several robots'."""

import argparse
import asyncio
import logging
import math
import time
import uuid
from pathlib import Path

from prior_sg.deploy.cli.shared import Commands, add_bus, console, tell_logs, until_interrupted, wait
from prior_sg.deploy.errors import UsageError

Lying = tuple[float, float, float, float]  # x, y, z in metres, heading in radians
MEMORY = "out/fleet/{}.msgpack"


def add_commands(commands: Commands) -> None:
    """`fleet`."""
    fleet = commands.add(
        "fleet",
        cmd_fleet,
        "merge the maps of several robots into one, under a name of its own, until Ctrl-C",
        "prior-sg fleet robot1 robot2 --as home",
        needs="map",
    )
    fleet.add_argument("robots", nargs="+", metavar="ROBOT", help="whose maps are merged")
    fleet.add_argument("--as", dest="name", required=True, metavar="NAME", help="the merged map's name, as a robot's")
    fleet.add_argument(
        "--transform",
        action="append",
        default=[],
        metavar="ROBOT=X,Y,Z,YAW",
        help="how a robot's frame lies in the merged one: metres, and degrees about the vertical; others are found out",
    )
    fleet.add_argument(
        "--same-frame", action="store_true", help="all robots share one frame; nothing is to be found out"
    )
    fleet.add_argument(
        "--stored",
        action="append",
        default=[],
        metavar="ROBOT=PATH",
        help="the scene that a robot left in an earlier session: a run's folder, scene.sqlite or scene.json",
    )
    fleet.add_argument(
        "--memory",
        default=None,
        metavar="FILE",
        help=f"keeps the merged map's numbers from one start to the next (default: {MEMORY.format('NAME')})",
    )
    fleet.add_argument(
        "--without-markers",
        action="store_true",
        help="printed markers tell nothing of how maps lie (one was moved, or printed twice)",
    )
    add_bus(fleet, robot=False)


def transforms_of(texts: list[str], robots: list[str], same_frame: bool) -> dict[str, Lying]:
    """Transforms as the command gives them, headings in radians. Raises UsageError."""
    found = dict.fromkeys(robots, (0.0, 0.0, 0.0, 0.0)) if same_frame else {}
    for text in texts:
        robot, _, told = text.partition("=")
        try:
            x, y, z, yaw = (float(number) for number in told.split(","))
        except ValueError as error:
            raise UsageError(f"{text!r} is no transform: write ROBOT=X,Y,Z,YAW, in metres and degrees") from error
        if not all(math.isfinite(number) for number in (x, y, z, yaw)):
            raise UsageError(f"{text!r} is no transform: its numbers must be finite")
        found[robot] = (x, y, z, math.radians(yaw))
    return found


def cmd_fleet(arguments: argparse.Namespace) -> int:
    """Run the bridge."""
    from prior_sg.deploy.fleet.bridge import NAME_OF_A_ROBOT, SERVICE
    from prior_sg.deploy.fleet.core.finding.config import MatchConfig
    from prior_sg.deploy.fleet.core.update import Config
    from prior_sg.deploy.running.serve import stay
    from prior_sg.schemas.names import fault_of_robot
    from prior_sg.services.runtime.service import Identity

    if fault := fault_of_robot(arguments.name):
        raise UsageError(fault)
    if arguments.name in arguments.robots:
        raise UsageError(NAME_OF_A_ROBOT.format(arguments.name))
    try:
        cfg = Config(
            robots=tuple(arguments.robots),
            transforms=transforms_of(arguments.transform, arguments.robots, arguments.same_frame),
            stored=tuple(arguments.stored),
            memory=MEMORY.format(arguments.name) if arguments.memory is None else arguments.memory,
            match=MatchConfig(markers=not arguments.without_markers),
        )
    except ValueError as error:
        raise UsageError(str(error)) from error
    tell_logs()
    console.print(f"{', '.join(cfg.robots)} as {arguments.name}; Ctrl-C stops")
    identity = Identity(arguments.name, f"{SERVICE.name}-{uuid.uuid4().hex[:8]}", time.time_ns())
    with until_interrupted():
        asyncio.run(stay(SERVICE, cfg, identity, arguments.connect))
    return 0


def show_fleet(out: Path) -> int:
    """Two robots in a generated house; the page stays until Ctrl-C."""
    from prior_sg.deploy.running.fleet_demo import NAME, FleetDemo, summary
    from prior_sg.deploy.viewing.live import Live
    from prior_sg.deploy.viewing.page import Options, Page

    logging.getLogger().setLevel(logging.ERROR)  # what robots warn of is none of the user's; the demo tells events
    demo = FleetDemo(out, console.print)
    page = Page(Live(demo.bus(), NAME, "two robots, one map"), Options())
    console.print(f"look at it: {page.address}; Ctrl-C stops")
    try:
        with until_interrupted():
            demo.walk()
            scene = demo.scene()
            console.print("the robots have arrived: " + (summary(scene) if scene else "nothing was merged"))
            wait()
        return 0
    finally:
        page.close()
        demo.close()

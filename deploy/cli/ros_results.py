"""`prior-sg ros bridge` and `ros rviz`: a scene where RViz, Nav2 and nodes of ROS 2 see it."""

import argparse
from pathlib import Path

from prior_sg.deploy.cli.shared import Commands, add_bus, console, until_interrupted, writing
from prior_sg.deploy.cli.source_options import source_option
from prior_sg.deploy.errors import UsageError
from prior_sg.deploy.ros.options import add_options, options_of
from prior_sg.deploy.ros.rules import Look
from prior_sg.services.runtime import extras


def add_results(actions: Commands) -> None:
    """`bridge` and `rviz`."""
    bridge = actions.add(
        "bridge",
        cmd_bridge,
        "tell ROS 2 of the scene of a running system, over rmw_zenoh, until Ctrl-C",
        "bridge --mask ward=slow:50 --mask 'operating room=keepout'",
        "ros",
    )
    add_options(bridge)
    add_bus(bridge)
    rviz = actions.add("rviz", cmd_rviz, "write a configuration of RViz that shows what the bridge tells", "rviz")
    rviz.add_argument("--out", type=Path, default=Path("prior_sg.rviz"), help="file (default: %(default)s)")
    rviz.add_argument("--node", default=Look.node, help="the bridge's --node (default: %(default)s)")
    rviz.add_argument("--frame", default=Look.frame, help="the bridge's --frame (default: %(default)s)")


def add_ros(up: argparse.ArgumentParser) -> None:
    """The option of `up` that starts the bridge as well."""
    up.add_argument(
        "--ros",
        nargs="?",
        const="",
        default=None,
        metavar="tcp/HOST:PORT",
        help="also tell ROS 2, on the router of `up` or on another",
    )


def check_ros(arguments: argparse.Namespace) -> None:
    """That the bridge of `up` can be. Raises UsageError, ExtraMissing."""
    extras.require("ros", "prior-sg up --ros")
    if arguments.ros in ("", arguments.connect) and (arguments.listen or arguments.join):
        raise UsageError(
            "a router with --listen or --join passes on nothing of ROS: start another for ROS (`ros2 run rmw_zenoh_cpp "
            "rmw_zenohd`) and name it, as in --ros tcp/127.0.0.1:7448"
        )


def bridge_arguments(arguments: argparse.Namespace) -> list[str]:
    """Of the bridge that `up` starts; its domain is that of a live source where one is told."""
    domain = source_option(arguments, "--domain")
    return ["--ros-router", arguments.ros or arguments.connect, *(["--domain", domain] if domain else [])]


def cmd_bridge(arguments: argparse.Namespace) -> int:
    """Topics until Ctrl-C."""
    from prior_sg.deploy.cli.doors import say_until
    from prior_sg.deploy.ros.bridge import serve_ros

    options = options_of(arguments)
    with until_interrupted():
        serve_ros(arguments.connect, arguments.robot, options, say_until, console.print)
    return 0


def cmd_rviz(arguments: argparse.Namespace) -> int:
    """Write the configuration."""
    from prior_sg.deploy.ros.rviz import configuration

    text = configuration(arguments.node, arguments.frame)
    with writing(arguments.out):
        arguments.out.write_text(text)
    console.print(f"wrote {arguments.out}; open it with `rviz2 -d {arguments.out}`")
    return 0

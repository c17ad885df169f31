"""`prior-sg ros bridge` and `ros rviz`: a scene where RViz, Nav2 and nodes of ROS 2 see it."""

import argparse
import contextlib
from pathlib import Path

from prior_sg.deploy.cli.shared import Commands, add_bus, console
from prior_sg.deploy.ros.options import add_options, options_of


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
    rviz.add_argument("--node", default="prior_sg", help="the bridge's --node (default: %(default)s)")
    rviz.add_argument("--frame", default="map", help="the bridge's --frame (default: %(default)s)")


def cmd_bridge(arguments: argparse.Namespace) -> int:
    """Topics until Ctrl-C."""
    from prior_sg.deploy.cli.doors import say_until
    from prior_sg.deploy.ros.bridge import serve_ros

    options = options_of(arguments)
    with contextlib.suppress(KeyboardInterrupt):
        serve_ros(arguments.connect, arguments.robot, options, say_until)
    console.print("stopping")
    return 0


def cmd_rviz(arguments: argparse.Namespace) -> int:
    """Write the configuration."""
    from prior_sg.deploy.ros.rviz import configuration

    arguments.out.write_text(configuration(arguments.node, arguments.frame))
    console.print(f"wrote {arguments.out}; open it with `rviz2 -d {arguments.out}`")
    return 0

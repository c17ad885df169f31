"""The command that puts Hydra in the place of `place_graph`."""

import argparse
import asyncio
import time
import uuid

from prior_sg.deploy.cli.shared import Commands, add_bus, console, tell_logs, until_interrupted
from prior_sg.deploy.errors import UsageError


def add_commands(commands: Commands) -> None:
    """`hydra`."""
    hydra = commands.add(
        "hydra",
        cmd_hydra,
        "take places and objects from Hydra, and name its rooms by our regions, until Ctrl-C",
        "prior-sg hydra --from tcp://127.0.0.1:8001 --labels-to tcp://127.0.0.1:8002",
        needs="hydra",
    )
    hydra.add_argument(
        "--from",
        dest="graph_from",
        default="tcp://127.0.0.1:8001",
        metavar="URL",
        help="where Hydra's ZmqSink sends its scene graph (default: %(default)s)",
    )
    hydra.add_argument(
        "--labels-to",
        default="tcp://127.0.0.1:8002",
        metavar="URL",
        help="where Hydra's ZmqRoomLabelUpdater listens; '' sends no names (default: %(default)s)",
    )
    hydra.add_argument("--scale", type=float, default=1.0, help="metres per unit of Hydra's world (default: 1)")
    hydra.add_argument("--no-objects", action="store_true", help="leave the scene's objects to the segmenter")
    hydra.add_argument("--keep-poses", action="store_true", help="do not move keyframes with Hydra's loop closures")
    add_bus(hydra)


def cmd_hydra(arguments: argparse.Namespace) -> int:
    """Run the bridge."""
    from prior_sg.deploy.hydra.bridge import SERVICE, Config
    from prior_sg.deploy.running.serve import stay
    from prior_sg.services.runtime.service import Identity

    try:
        cfg = Config(
            graph_from=arguments.graph_from,
            labels_to=arguments.labels_to,
            scale=arguments.scale,
            objects=not arguments.no_objects,
            correct_poses=not arguments.keep_poses,
        )
    except ValueError as error:
        raise UsageError(str(error)) from error
    tell_logs()
    back = f"; names of rooms to {cfg.labels_to}" if cfg.labels_to else ""
    console.print(f"scene graphs of Hydra from {cfg.graph_from}{back}; Ctrl-C stops")
    identity = Identity(arguments.robot, f"{SERVICE.name}-{uuid.uuid4().hex[:8]}", time.time_ns())
    with until_interrupted():
        asyncio.run(stay(SERVICE, cfg, identity, arguments.connect))
    return 0

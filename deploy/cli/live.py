"""Commands for services that stay, and for what is done to them while they run."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from prior_sg.deploy.cli.check import before_start
from prior_sg.deploy.cli.doors import API_PORT, port_in
from prior_sg.deploy.cli.jobs import add_run_options, settings_of
from prior_sg.deploy.cli.ros_results import add_ros, bridge_arguments, check_ros
from prior_sg.deploy.cli.shared import (
    Commands,
    add_bus,
    add_router,
    console,
    open_client,
    reach_of,
    until_interrupted,
    wait,
)
from prior_sg.deploy.cli.source_options import add_source_options, mapping_options, read_options
from prior_sg.deploy.cli.watching import add_metrics, check_metrics, open_metrics
from prior_sg.deploy.edge import names_in
from prior_sg.deploy.errors import UsageError, UserError
from prior_sg.deploy.running import serve
from prior_sg.deploy.running.notify import Watchdog
from prior_sg.services.errors import PriorSgError
from prior_sg.services.runtime import extras

if TYPE_CHECKING:
    from prior_sg.deploy.running.roll import Roll
    from prior_sg.deploy.running.supervisor import Supervisor
    from prior_sg.deploy.running.swaps import Swaps


def add_commands(commands: Commands) -> None:
    """`up`, `serve`, `task` and `pose-update`."""
    up = commands.add(
        "up",
        cmd_up,
        "start services and a router, until Ctrl-C",
        "prior-sg up segmenter scene_store",
        needs="map",
    )
    up.add_argument("services", nargs="*", help="services to start; default: all")
    up.add_argument(
        "--source", default="", help="what ingest reads, ros2:/ for a robot, realsense: or oak:; default: nothing"
    )
    up.add_argument("--out", type=Path, default=Path("out/up"), help="folder for the database and logs")
    up.add_argument("--no-router", action="store_true", help="use the router at --connect instead of starting one")
    add_router(up)
    up.add_argument(
        "--api", nargs="?", type=port_in, const=API_PORT, default=None, metavar="PORT", help="also serve HTTP there"
    )
    up.add_argument(
        "--restart-hung",
        action="store_true",
        help="kill and start again what exists and is not heard; default: say so, for it may be stopped on purpose",
    )
    add_metrics(up)
    add_ros(up)
    add_run_options(up)
    add_source_options(up)

    one = commands.add(
        "serve",
        serve.run,
        "run one service in this process (what containers do)",
        "prior-sg serve segmenter",
        needs="map",
    )
    serve.add_arguments(one)

    task = commands.add("task", cmd_task, "give a robot another task, live", 'prior-sg task "serve drinks to guests"')
    task.add_argument("task", help="the task in plain words")
    task.add_argument("--environment", default="", help="the environment; default: the one in force")
    task.add_argument("--regions", default="", help="fixed region names, separated by commas")
    task.add_argument("--timeout", type=float, default=60.0, help="seconds to wait for the new regions")
    add_bus(task)

    poses = commands.add(
        "pose-update",
        cmd_pose_update,
        "correct the poses of keyframes, as after a loop closure",
        "prior-sg pose-update optimised/trajectory.csv",
        needs="map",
    )
    poses.add_argument(
        "file", type=Path, help="CSV with the columns frame, stamp_ns, x_m y_m z_m qx qy qz qw: world_from_camera"
    )
    poses.add_argument("--timeout", type=float, default=60.0, help="seconds to wait for the corrected map")
    add_bus(poses)


def cmd_up(arguments: argparse.Namespace) -> int:
    """Services and a router until Ctrl-C."""
    from prior_sg.deploy.running.job import claimed_folder
    from prior_sg.services.registry import BY_NAME, SERVICES

    names = arguments.services or [service.name for service in SERVICES]
    for name in names:
        if name not in BY_NAME:
            raise UsageError(f"there is no service {name!r}; known: {', '.join(BY_NAME)}")
    if arguments.api is not None:
        extras.require("api", "prior-sg up --api")
    check_metrics(arguments)
    if arguments.ros is not None:
        check_ros(arguments)
    with claimed_folder(arguments.out):
        return _stay_up(arguments, names)


def _stay_up(arguments: argparse.Namespace, names: list[str]) -> int:
    from prior_sg.deploy.running.job import require_files
    from prior_sg.deploy.running.roll import Roll
    from prior_sg.deploy.running.supervisor import Supervisor
    from prior_sg.deploy.running.swaps import RouterHere, Swaps
    from prior_sg.services.registry import BY_NAME
    from prior_sg.services.runtime.hearing import end_deaf

    require_files()
    _check_place(arguments, names)
    settings = _settings(arguments)
    if arguments.no_router:
        open_client(arguments.connect).bus.close()  # finds out at once whether a router is there
    router = None if arguments.no_router else RouterHere(arguments.connect, lambda: reach_of(arguments))
    supervisor = Supervisor(arguments.connect, arguments.robot, arguments.out / "logs", settings, arguments.config)
    client = open_client(arguments.connect, on_deaf=end_deaf if router is not None else None)
    roll = Roll(client.bus)
    supervisor.hears = roll.hears
    swaps = Swaps(client.bus, supervisor, arguments.out, router)
    try:
        with until_interrupted():
            for name in sorted(names, key=lambda name: name == "ingest"):
                supervisor.start(name, arguments.workers if BY_NAME[name].job is not None else 1)
            if arguments.api is not None:
                _open_api(supervisor, arguments.api)
            if arguments.metrics is not None:
                open_metrics(supervisor, arguments.metrics, arguments.trace)
            if arguments.ros is not None:
                supervisor.start_door("ros", "prior_sg.deploy.ros.process", bridge_arguments(arguments))
            listening = " and ".join((arguments.connect, *arguments.listen))
            console.print(f"router {listening}; logs in {supervisor.log_folder}; Ctrl-C stops")
            watchdog = Watchdog()

            def tell() -> None:
                _tell(supervisor, roll, arguments.restart_hung, swaps)
                watchdog.alive()

            wait(tell)
        return 0
    finally:
        supervisor.stop()
        client.bus.close()
        if router is not None:
            router.stop()


def _check_place(arguments: argparse.Namespace, names: list[str]) -> None:
    """That these services can run here, with these keys and this link. Raises UserError."""
    from prior_sg.schemas.topics import KEYFRAME
    from prior_sg.services.registry import BY_NAME

    beyond = reach_of(arguments)
    if beyond is not None and (own := beyond.bundle.own).role == "robot" and own.name != arguments.robot:
        raise UserError(f"these keys are of {own.name}, which writes nothing of {arguments.robot}; use --robot")
    mappers = [name for name in names if KEYFRAME in BY_NAME[name].reads]
    if arguments.thin_link and mappers and "ingest" not in names:
        raise UsageError(f"{mappers[0]} needs every keyframe, and a thin link carries none: run it where ingest runs")
    if beyond is not None and arguments.no_router:
        raise UsageError("--listen and --join are of the router that `up` starts; leave out --no-router")


def _settings(arguments: argparse.Namespace) -> list[str]:
    """Of the services. Raises UserError, SourceError."""
    from prior_sg.deploy.running.job import KEYFRAMES
    from prior_sg.deploy.settings import check_settings
    from prior_sg.services.ingest.core.options import is_live

    settings = [
        f"scene_store.path={arguments.out / 'scene.sqlite'}",
        f"ingest.archive_path={arguments.out / KEYFRAMES}",
        f"ingest.speed={arguments.speed}",
    ]
    if arguments.source:
        if not is_live(arguments.source):  # a robot may come later, through the router that is started here
            before_start(arguments.source, read_options(arguments), console, mapping_options(arguments))
        settings.append(f"ingest.source={arguments.source}")
    settings += settings_of(arguments)
    check_settings(arguments.config, settings)
    return settings


def _tell(supervisor: "Supervisor", roll: "Roll", restart_hung: bool, swaps: "Swaps | None" = None) -> None:
    """What has happened to the processes; those that hang are ended, to be started again, where that is wished."""
    silence, hung = roll.check(supervisor.children)
    for child in hung if restart_hung else ():
        child.kill()
    for event in (*silence, *(swaps.check() if swaps is not None else ()), *supervisor.check()):
        console.print(event)


def _open_api(supervisor: "Supervisor", port: int) -> None:
    """HTTP on loopback, as one more process; for other hosts there is `prior-sg serve-api`."""
    arguments = ["--host", "127.0.0.1", "--port", str(port)]
    supervisor.start_door("api", "prior_sg.deploy.serving.process", arguments)
    console.print(f"HTTP on http://127.0.0.1:{port}")


def cmd_task(arguments: argparse.Namespace) -> int:
    """Switch the task and wait for the new regions."""
    from prior_sg.deploy.api.client import Client
    from prior_sg.deploy.cli import report

    with Client(arguments.connect, arguments.robot) as client, console.status("asking for the prior") as status:
        try:
            switch = client.switch(
                arguments.task,
                arguments.environment,
                names_in(arguments.regions),
                arguments.timeout,
                waiting=status.update,
                on_prior=lambda prior: console.print(f"prior: {prior.provenance.note}"),
            )
        except PriorSgError as error:
            raise UserError(str(error)) from error
    console.print(report.region_table(switch.scene.message))
    console.print(f"regions for {arguments.task!r} after {switch.seconds:.2f} s")
    return 0


def cmd_pose_update(arguments: argparse.Namespace) -> int:
    """Post corrected poses and wait until the map stands corrected."""
    from prior_sg.deploy.api.client import Client
    from prior_sg.services.ingest.sources.dataset import read_corrections

    try:
        poses = {
            frame_id: pose
            for correction in read_corrections(arguments.file)
            for frame_id, pose in zip(correction.frame_ids.tolist(), correction.world_from_camera, strict=True)
        }
        if not poses:
            raise UserError(f"{arguments.file} holds no poses")
        with Client(arguments.connect, arguments.robot) as client:
            seconds = client.correct_poses(poses, arguments.timeout)
    except PriorSgError as error:
        raise UserError(str(error)) from error
    console.print(f"{len(poses)} poses taken by the map of {arguments.robot} in {seconds:.2f} s")
    return 0

"""Commands for services that stay, and for what is done to them while they run."""

import argparse
import contextlib
import threading
import time
from pathlib import Path
from typing import Any

from prior_sg.deploy.cli.jobs import add_run_options, settings_of
from prior_sg.deploy.cli.shared import Commands, add_bus, console, open_client
from prior_sg.deploy.edge import names_in
from prior_sg.deploy.errors import UserError
from prior_sg.deploy.running import serve


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
    up.add_argument("--source", default="", help="what ingest reads; default: nothing")
    up.add_argument("--out", type=Path, default=Path("out/up"), help="folder for the database and logs")
    up.add_argument("--no-router", action="store_true", help="use the router at --connect instead of starting one")
    add_run_options(up)

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
    from prior_sg.deploy.running.job import make_folder
    from prior_sg.deploy.running.supervisor import Supervisor
    from prior_sg.deploy.settings import check_settings
    from prior_sg.deploy.truth import truth_of
    from prior_sg.services.registry import BY_NAME, SERVICES
    from prior_sg.services.runtime.zenoh_bus import open_router

    names = arguments.services or [service.name for service in SERVICES]
    for name in names:
        if name not in BY_NAME:
            raise UserError(f"there is no service {name!r}; known: {', '.join(BY_NAME)}")
    make_folder(arguments.out)
    settings = [f"scene_store.path={arguments.out / 'scene.sqlite'}", f"ingest.speed={arguments.speed}"]
    if arguments.source:
        truth_of(arguments.source)  # finds out at once whether the source is of a known layout
        settings.append(f"ingest.source={arguments.source}")
    settings += settings_of(arguments)
    check_settings(arguments.config, settings)
    if arguments.no_router:
        open_client(arguments.connect).bus.close()  # finds out at once whether a router is there
    stop_router = (lambda: None) if arguments.no_router else open_router(arguments.connect)
    supervisor = Supervisor(arguments.connect, arguments.robot, arguments.out / "logs", settings, arguments.config)
    try:
        for name in sorted(names, key=lambda name: name == "ingest"):
            supervisor.start(name, arguments.workers if BY_NAME[name].job is not None else 1)
        console.print(f"router {arguments.connect}; logs in {supervisor.log_folder}; Ctrl-C stops")
        while True:
            for event in supervisor.check():
                console.print(event)
            time.sleep(0.2)
    except KeyboardInterrupt:
        console.print("stopping")
        return 0
    finally:
        supervisor.stop()
        stop_router()


def cmd_task(arguments: argparse.Namespace) -> int:
    """Switch the task and wait for the new regions."""
    from prior_sg.deploy.cli import report
    from prior_sg.schemas.codec import DecodeError, decode
    from prior_sg.schemas.priors import Task
    from prior_sg.schemas.regions import RegionDelta
    from prior_sg.schemas.scene import SceneRequest
    from prior_sg.schemas.topics import REGION_DELTA, SCENE
    from prior_sg.services.runtime.client import NoPriorError

    with open_client(arguments.connect) as client:
        environment = arguments.environment or client.ask(SCENE, SceneRequest(robot=arguments.robot)).environment
        if not environment:
            raise UserError(f"{arguments.robot} has no environment yet; name one with --environment")
        task = Task(
            robot=arguments.robot,
            stamp_ns=time.time_ns(),
            environment=environment,
            task=arguments.task,
            regions=names_in(arguments.regions),
        )
        arrivals: dict[str, float] = {}
        changed = threading.Event()
        started_s, given_ns = time.monotonic(), time.time_ns()

        def see(sample: Any) -> None:
            """A delta sent after the task was given; the history may hold older ones of the same task."""
            with contextlib.suppress(DecodeError):
                delta = decode(RegionDelta, sample.payload)
                if sample.sent_ns > given_ns and delta.task == arguments.task:
                    arrivals.setdefault(delta.prior_digest, time.monotonic())
                    changed.set()

        client.listen(REGION_DELTA, arguments.robot, see)
        with console.status("asking for the prior") as status:
            try:
                prior = client.give_task(task, arguments.timeout, status.update)
            except NoPriorError as error:
                raise UserError(str(error)) from error
        console.print(f"prior: {prior.provenance.note}")
        digest, end_s = prior.digest(), time.monotonic() + arguments.timeout
        while digest not in arrivals:
            changed.clear()
            if not changed.wait(max(end_s - time.monotonic(), 0)) and digest not in arrivals:
                raise UserError(f"no regions for the new task within {arguments.timeout:.0f} s; see `prior-sg health`")
        seconds = arrivals[digest] - started_s
        time.sleep(0.5)
        console.print(report.region_table(client.ask(SCENE, SceneRequest(robot=arguments.robot))))
        console.print(f"regions for {arguments.task!r} after {seconds:.2f} s")
    return 0


def cmd_pose_update(arguments: argparse.Namespace) -> int:
    """Post corrected poses and wait until the map stands corrected."""
    import numpy as np

    from prior_sg.schemas.codec import DecodeError, decode
    from prior_sg.schemas.frames import PoseUpdate
    from prior_sg.schemas.status import Consumed
    from prior_sg.schemas.topics import JOURNAL, POSE_UPDATE
    from prior_sg.services.ingest.sources import SourceError
    from prior_sg.services.ingest.sources.dataset import read_corrections

    try:
        corrections = read_corrections(arguments.file)
    except SourceError as error:
        raise UserError(str(error)) from error
    poses = {
        frame_id: pose
        for correction in corrections
        for frame_id, pose in zip(correction.frame_ids.tolist(), correction.world_from_camera, strict=True)
    }
    if not poses:
        raise UserError(f"{arguments.file} holds no poses")
    with open_client(arguments.connect) as client:
        if "place_graph" not in client.alive().values():
            raise UserError("no place_graph is running to take the poses; start it with `prior-sg up`")
        update = PoseUpdate(
            robot=arguments.robot,
            epoch=time.time_ns(),
            revision=0,
            stamp_ns=time.time_ns(),
            frame_ids=np.array(list(poses), np.int64),
            world_from_camera=np.stack(list(poses.values())),
        )
        corrected = threading.Event()

        def see(sample: Any) -> None:
            with contextlib.suppress(DecodeError):
                entry = decode(Consumed, sample.payload)
                if (entry.service, entry.topic, entry.writer) == ("place_graph", POSE_UPDATE.name, client.writer):
                    corrected.set()

        client.listen(JOURNAL, arguments.robot, see)
        started_s = time.monotonic()
        client.publish(POSE_UPDATE, update)
        if not corrected.wait(arguments.timeout):
            raise UserError(f"the map took no poses within {arguments.timeout:.0f} s; see `prior-sg health`")
        console.print(
            f"{len(poses)} poses taken by the map of {arguments.robot} in {time.monotonic() - started_s:.2f} s"
        )
    return 0

"""The command line: `prior-sg`."""

import argparse
import contextlib
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table

from prior_sg.deploy.cli import check, packing, priors
from prior_sg.deploy.cli.source_options import add_source_options, read_options, source_settings
from prior_sg.deploy.evaluation import command as evaluation
from prior_sg.deploy.running import serve
from prior_sg.deploy.sample import SAMPLE

if TYPE_CHECKING:
    from prior_sg.schemas.status import ServiceStatus, TopicCount
    from prior_sg.services.runtime.client import Client

DEFAULT_CONNECT = "tcp/127.0.0.1:7447"
DEMO_ENVIRONMENT = "residential home"
DEMO_TASK = "real-estate listing"

console = Console(highlight=False)


class UserError(Exception):
    """What the user asked cannot be done; the message says what to do instead."""


def _example(text: str) -> dict:
    return {"epilog": f"example: {text}", "formatter_class": argparse.RawDescriptionHelpFormatter}


def _add_bus(parser: argparse.ArgumentParser, robot: bool = True) -> None:
    default = os.environ.get("PSG_CONNECT", DEFAULT_CONNECT)
    parser.add_argument("--connect", default=default, help="Zenoh router (default: %(default)s)")
    if robot:
        parser.add_argument("--robot", default="robot1", help="name of the robot (default: %(default)s)")


def _at_least_one(text: str) -> int:
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError("must be at least 1")
    return number


def _add_run_options(parser: argparse.ArgumentParser) -> None:
    _add_bus(parser)
    parser.add_argument("--workers", type=_at_least_one, default=1, help="feature workers (default: %(default)s)")
    parser.add_argument(
        "--speed", type=float, default=0.0, help="replay speed; 0 = as fast as the pipeline drains (default)"
    )
    parser.add_argument(
        "--places",
        choices=("3d", "2d"),
        help="spheres of free space, or pieces of ground for large and unbounded spaces (default: 3d)",
    )
    parser.add_argument(
        "--encoder", default="", help="conse/…, open_clip/MODEL/PRETRAINED or onnx:FOLDER (docs/encoders.md)"
    )
    parser.add_argument("--config", default="", help="TOML file with a section per service")
    parser.add_argument("--set", action="append", default=[], metavar="SERVICE.FIELD=VALUE", help="one setting")


def _settings(arguments: argparse.Namespace) -> list[str]:
    """Settings that run options stand for, then those given by --set."""
    places = [f"place_graph.places={arguments.places}"] if arguments.places else []
    return [*places, *_encoder_settings(arguments.encoder), *source_settings(arguments), *arguments.set]


Command = Callable[[str, str, str], argparse.ArgumentParser]


def build_parser() -> argparse.ArgumentParser:
    """All commands with their options."""
    parser = argparse.ArgumentParser(
        prog="prior-sg",
        description="Task-driven hierarchical scene graphs from posed RGB-D streams.",
        **_example("prior-sg demo"),
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def command(name: str, summary: str, example: str) -> argparse.ArgumentParser:
        return commands.add_parser(name, help=summary, description=summary, **_example(example))

    _add_jobs(command)
    _add_live(command)
    _add_tools(command)
    return parser


def _add_jobs(command: Command) -> None:
    """The main job, on the sample and on a source of the user's."""
    demo = command("demo", "run everything on the sample home and score the result", "prior-sg demo --workers 2")
    demo.add_argument("--out", type=Path, default=Path("out/demo"), help="folder for the results")
    demo.add_argument("--task", default=DEMO_TASK, help="what the robot is to do (default: %(default)s)")
    demo.add_argument("--regions", default="", help="fixed region names, separated by commas; see --open")
    demo.add_argument(
        "--open",
        action="store_true",
        help="let the prior name the regions; by default the demo fixes the ground truth's names, as the paper's "
        "benchmarks do, so that labels can be scored",
    )
    _add_run_options(demo)

    run = command(
        "run",
        "turn a recording into a scene graph",
        'prior-sg run deploy/sample/home.mcap --environment "residential home" --task "serve drinks to guests"',
    )
    run.add_argument("source", help="a folder in a known layout (docs/sources.md) or an MCAP log")
    run.add_argument("--environment", required=True, help="what kind of place it is, in plain words")
    run.add_argument("--task", required=True, help="what the robot is to do, in plain words")
    run.add_argument("--regions", default="", help="fixed region names, separated by commas; default: the prior's")
    run.add_argument("--out", type=Path, default=Path("out/run"), help="folder for the results")
    run.add_argument("--in-process", action="store_true", help="all services in this process, for debugging")
    _add_run_options(run)
    add_source_options(run)


def _add_live(command: Command) -> None:
    """Services that stay, and what is done to them while they run."""
    up = command("up", "start services and a router, until Ctrl-C", "prior-sg up segmenter scene_store")
    up.add_argument("services", nargs="*", help="services to start; default: all")
    up.add_argument("--source", default="", help="what ingest reads; default: nothing")
    up.add_argument("--out", type=Path, default=Path("out/up"), help="folder for the database and logs")
    up.add_argument("--no-router", action="store_true", help="use the router at --connect instead of starting one")
    _add_run_options(up)
    add_source_options(up)

    one = command("serve", "run one service in this process (what containers do)", "prior-sg serve segmenter")
    serve.add_arguments(one)

    task = command("task", "give a robot another task, live", 'prior-sg task "serve drinks to guests"')
    task.add_argument("task", help="the task in plain words")
    task.add_argument("--environment", default="", help="the environment; default: the one in force")
    task.add_argument("--regions", default="", help="fixed region names, separated by commas")
    task.add_argument("--timeout", type=float, default=60.0, help="seconds to wait for the new regions")
    _add_bus(task)

    poses = command(
        "pose-update",
        "correct the poses of keyframes, as after a loop closure",
        "prior-sg pose-update optimised/trajectory.csv",
    )
    poses.add_argument(
        "file", type=Path, help="CSV with the columns frame, stamp_ns, x_m y_m z_m qx qy qz qw: world_from_camera"
    )
    poses.add_argument("--timeout", type=float, default=60.0, help="seconds to wait for the corrected map")
    _add_bus(poses)


def _add_tools(command: Command) -> None:
    """What is done with results, logs and the system itself."""
    export = command("export", "write the scene graph as a file", "prior-sg export --format spark-dsg --out dsg.json")
    export.add_argument("--format", choices=("json", "spark-dsg", "png"), default="json")
    export.add_argument(
        "--out", type=Path, required=True, help="the file to write; png: the map, and places in 3D in NAME-3d.png"
    )
    export.add_argument("--database", type=Path, help="read this scene.sqlite instead of the running store")
    _add_bus(export)

    explain = command("explain", "say why a place carries its label", "prior-sg explain 49 --log out/demo/log.mcap")
    explain.add_argument("place", type=int, help="id of the place, as in scene.json")
    explain.add_argument("--log", type=Path, help="ask the segmenter at the end of this log, not the running one")
    explain.add_argument("--json", action="store_true", help="print JSON")
    _add_bus(explain)

    packing.add_arguments(
        command(
            "pack", "write a source, read and put right, as one log", "prior-sg pack recordings/home home.mcap --rate 5"
        )
    )

    record = command("record", "record all topics into a log, until Ctrl-C", "prior-sg record out/log.mcap")
    record.add_argument("log", type=Path)
    record.add_argument("--seconds", type=float, default=0.0, help="stop after this long; 0 = at Ctrl-C")
    _add_bus(record, robot=False)

    replay = command(
        "replay", "feed a log to one service again and compare", "prior-sg replay out/demo/log.mcap segmenter --diff"
    )
    replay.add_argument("log", type=Path)
    replay.add_argument("service")
    replay.add_argument("--diff", action="store_true", help="compare with what was recorded; exit 1 on differences")

    topics = command("topics", "show topics and queries, or check that all documents agree", "prior-sg topics --check")
    topics.add_argument("--check", action="store_true", help="exit 1 when anything disagrees")
    topics.add_argument("--write", action="store_true", help="renew README, docs and docker-compose.yml")

    health = command("health", "show every running process and its topics", "prior-sg health --json")
    health.add_argument("--json", action="store_true", help="print JSON")
    _add_bus(health, robot=False)

    inspect = command("check", "say what a source is and what is wrong with it", "prior-sg check recordings/home")
    check.add_arguments(inspect)
    add_source_options(inspect)

    evaluation.add_arguments(
        command(
            "eval",
            "compare methods on datasets with ground truth",
            'prior-sg eval recordings/home --environment "residential home" --methods ours,clio --html',
        )
    )

    bench = command("bench", "measure one part, or all", "prior-sg bench places --json")
    bench.add_argument(
        "name", help="bus, places, features, kernel, swap, segmenter, task, learning, e2e, all of these, or pool"
    )
    bench.add_argument("--seconds", type=float, default=300.0, help="how long pool lasts (default: %(default)s)")
    bench.add_argument("--json", action="store_true", help="print one JSON object per measurement")

    priors.add_arguments(
        command("priors", "make, show, compare and exchange prior graphs", "prior-sg priors list"), _add_bus
    )


def _client(connect: str) -> "Client":
    from prior_sg.services.runtime.client import Client
    from prior_sg.services.runtime.zenoh_bus import ZenohBus

    return Client(ZenohBus(connect, wait_s=2.0))


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",") if name.strip()]


def _encoder_settings(choice: str) -> list[str]:
    """Settings of workers and segmenter for one choice of an encoder. Raises UserError."""
    from prior_sg.services.feature_pyramid.encoders.base import EncoderUnavailable, space_of

    try:
        return [f"feature_pyramid.space={choice}", f"segmenter.space={space_of(choice)}"] if choice else []
    except EncoderUnavailable as error:
        raise UserError(str(error)) from error


def cmd_demo(arguments: argparse.Namespace) -> int:
    """The main job on the embedded sample."""
    from prior_sg.deploy.cli import report

    arguments.source, arguments.environment = str(SAMPLE), DEMO_ENVIRONMENT
    if not (arguments.regions or arguments.open) and arguments.task == DEMO_TASK:
        truth = report.truth_of(arguments.source) or {"regions": []}
        arguments.regions = ",".join(dict.fromkeys(region["label"] for region in truth["regions"]))
        console.print(
            f"region names fixed to the ground truth's: {arguments.regions.replace(',', ', ')} (--open frees them)"
        )
    return cmd_run(arguments)


def cmd_run(arguments: argparse.Namespace) -> int:
    """The main job on a source of the user's."""
    from prior_sg.deploy.cli import report
    from prior_sg.deploy.running.job import Job, run

    if not Path(arguments.source).exists():
        raise UserError(f"{arguments.source} does not exist")
    beside = check.before_start(arguments.source, read_options(arguments), console).beside
    job = Job(
        source=arguments.source,
        out=arguments.out,
        environment=arguments.environment,
        task=arguments.task,
        regions=_names(arguments.regions),
        robot=arguments.robot,
        connect=arguments.connect,
        workers=arguments.workers,
        speed=arguments.speed,
        settings=_settings(arguments),
        config=arguments.config,
        in_process=getattr(arguments, "in_process", False),
        on_started=lambda endpoint, pids: console.print(
            f"{len(pids)} service processes: " + ", ".join(f"{name} {pid}" for name, pid in sorted(pids.items()))
        ),
    )
    result = run(job, console)
    report.write(result, job.out, beside.regions, console, beside.objects)
    return 0


def cmd_up(arguments: argparse.Namespace) -> int:
    """Services and a router until Ctrl-C."""
    from prior_sg.deploy.running.job import check_settings, make_folder
    from prior_sg.deploy.running.supervisor import Supervisor
    from prior_sg.services.registry import BY_NAME, SERVICES
    from prior_sg.services.runtime.zenoh_bus import open_router

    names = arguments.services or [service.name for service in SERVICES]
    for name in names:
        if name not in BY_NAME:
            raise UserError(f"there is no service {name!r}; known: {', '.join(BY_NAME)}")
    make_folder(arguments.out)
    settings = [f"scene_store.path={arguments.out / 'scene.sqlite'}", f"ingest.speed={arguments.speed}"]
    if arguments.source:
        check.before_start(arguments.source, read_options(arguments), console)
        settings.append(f"ingest.source={arguments.source}")
    settings += _settings(arguments)
    check_settings(arguments.config, settings)
    if arguments.no_router:
        _client(arguments.connect).bus.close()  # finds out at once whether a router is there
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


def cmd_check(arguments: argparse.Namespace) -> int:
    """What a source is, and what is wrong with it."""
    return check.run(arguments.source, read_options(arguments), as_json=arguments.json, console=console)


def cmd_task(arguments: argparse.Namespace) -> int:
    """Switch the task and wait for the new regions."""
    from prior_sg.deploy.cli import report
    from prior_sg.schemas.codec import DecodeError, decode
    from prior_sg.schemas.priors import Task
    from prior_sg.schemas.regions import RegionDelta
    from prior_sg.schemas.scene import SceneRequest
    from prior_sg.schemas.topics import REGION_DELTA, SCENE
    from prior_sg.services.runtime.client import NoPriorError

    with _client(arguments.connect) as client:
        environment = arguments.environment or client.ask(SCENE, SceneRequest(robot=arguments.robot)).environment
        if not environment:
            raise UserError(f"{arguments.robot} has no environment yet; name one with --environment")
        task = Task(
            robot=arguments.robot,
            stamp_ns=time.time_ns(),
            environment=environment,
            task=arguments.task,
            regions=_names(arguments.regions),
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
    with _client(arguments.connect) as client:
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


def cmd_export(arguments: argparse.Namespace) -> int:
    """Write the scene graph from the running store or a database file."""
    from prior_sg.deploy.cli import report
    from prior_sg.schemas.places import MapRequest
    from prior_sg.schemas.scene import SceneRequest
    from prior_sg.schemas.topics import SCENE, VOXEL_MAP
    from prior_sg.services.runtime.bus import BusError

    voxels = None
    if arguments.database is not None:
        if not arguments.database.exists():
            raise UserError(f"{arguments.database} does not exist; `run` and `up` write it as scene.sqlite")
        scene = report.scene_in(arguments.database, arguments.robot)
    else:
        with _client(arguments.connect) as client:
            scene = client.ask(SCENE, SceneRequest(robot=arguments.robot))
            if arguments.format == "png":
                try:
                    voxels = client.ask(VOXEL_MAP, MapRequest(robot=arguments.robot))
                except BusError as error:
                    console.print(f"without the map of walls: {error}")
    if not len(scene.place_ids):
        raise UserError(f"the store holds no places of {arguments.robot}; name another with --robot")
    report.export(scene, voxels, arguments.format, arguments.out)
    also = f" and {report.picture_of_places(arguments.out)}" if arguments.format == "png" else ""
    console.print(f"{len(scene.place_ids)} places, {len(scene.regions)} regions: {arguments.out}{also}")
    return 0


def cmd_explain(arguments: argparse.Namespace) -> int:
    """Each expert's vote on a place, its neighbours' pull, and what follows."""
    import msgspec

    from prior_sg.deploy.inspecting import explain
    from prior_sg.schemas.regions import PosteriorRequest
    from prior_sg.schemas.topics import POSTERIOR

    if arguments.log is not None:
        if not arguments.log.exists():
            raise UserError(f"{arguments.log} does not exist; `run`, `demo` and `record` write one")
        reply = explain.from_log(arguments.log, arguments.robot, arguments.place)
    else:
        with _client(arguments.connect) as client:
            reply = client.ask(POSTERIOR, PosteriorRequest(robot=arguments.robot, place_id=arguments.place))
    if not reply.found:
        raise UserError(f"{arguments.robot} has no labelled place {arguments.place}; scene.json lists their ids")
    if arguments.json:
        print(msgspec.json.encode(reply).decode())
    else:
        explain.show(reply, console)
    return 0


def cmd_pack(arguments: argparse.Namespace) -> int:
    """Write a source as one log."""
    return packing.run(arguments, console)


def cmd_record(arguments: argparse.Namespace) -> int:
    """Record until Ctrl-C or the given time."""
    from prior_sg.deploy.running.recorder import Recorder

    with _client(arguments.connect) as client:
        recorder = Recorder(client, arguments.log)
        end_s = time.monotonic() + (arguments.seconds or float("inf"))
        try:
            with console.status("recording; Ctrl-C stops") as status:
                while time.monotonic() < end_s:
                    time.sleep(0.2)
                    recorder.check()
                    total = sum(recorder.counts.values())
                    status.update(f"recording: {total} messages; Ctrl-C stops")
        except KeyboardInterrupt:
            pass
        finally:
            recorder.close()
    console.print(f"{sum(recorder.counts.values())} messages: {arguments.log}")
    return 0


def cmd_replay(arguments: argparse.Namespace) -> int:
    """Replay a service and report differences."""
    from prior_sg.deploy.cli import report
    from prior_sg.deploy.inspecting import replay
    from prior_sg.services.registry import BY_NAME

    if arguments.service not in BY_NAME:
        raise UserError(f"there is no service {arguments.service!r}; known: {', '.join(BY_NAME)}")
    log = replay.open_log(arguments.log, arguments.service)
    differences = 0
    for life in log.lives:
        found = replay.compare(log, life)
        console.print(
            f"{found.instance}: {found.inputs} inputs, {found.recorded} outputs recorded, {found.outputs} made"
        )
        for text in found.differences[:20] if arguments.diff else []:
            console.print(f"  {text}")
        differences += len(found.differences)
    if arguments.service == "scene_store":
        text = report.final_scene_difference(log, arguments.log)
        console.print(f"  {text}" if text else "final scene: equal to that of an undisturbed replay")
        differences += bool(text)
    console.print(f"{differences} differences")
    return 1 if arguments.diff and differences else 0


def cmd_topics(arguments: argparse.Namespace) -> int:
    """Show, check or renew what is generated from the registry."""
    from prior_sg.deploy.inspecting import topics

    if arguments.write:
        console.print("renewed " + ", ".join(topics.write()))
    elif arguments.check:
        found = topics.faults()
        for text in found:
            console.print(text)
        console.print(f"{len(found)} faults")
        return 1 if found else 0
    else:
        print(topics.table())
    return 0


def cmd_health(arguments: argparse.Namespace) -> int:
    """Every process: alive, busy, what it dropped."""
    import msgspec

    from prior_sg.services.runtime.bus import BusError

    with _client(arguments.connect) as client:
        statuses, silent = [], []
        for instance, service in sorted(client.alive().items()):
            try:
                statuses.append(client.status(service, instance))
            except BusError as error:
                silent.append({"service": service, "instance": instance, "error": str(error)})
    if arguments.json:
        print(json.dumps({"processes": msgspec.to_builtins(statuses), "silent": silent}))
    else:
        _print_health(statuses, silent)
    return 1 if silent or not statuses else 0


def _print_health(statuses: list["ServiceStatus"], silent: list[dict]) -> None:
    """Two lines a process: what it is doing, and what went through each topic."""
    for status in statuses:
        waits = f", waits for {', '.join(status.waiting_for)}" if status.waiting_for else ""
        console.print(
            f"[bold]{status.instance}[/]  pid {status.pid}, up {status.uptime_s:.0f} s, busy {status.busy_share:.0%}, "
            f"step {status.step_ms_p50:.1f} ms (p99 {status.step_ms_p99:.1f}), {status.resident_mb:.0f} MB, "
            f"backlog {status.backlog}{waits}"
        )
        console.print("    " + " · ".join(map(_topic_line, status.topics)))
    for entry in silent:
        console.print(f"[red]{entry['error']}[/]")
    if not statuses and not silent:
        console.print("no service is running; start them with `prior-sg up`")


def _topic_line(count: "TopicCount") -> str:
    """One topic's counts; what should not happen stands out."""
    parts = [
        (count.consumed, "in"),
        (count.published, "out"),
        (count.skipped, "skipped"),
        (count.duplicate, "repeated"),
    ]
    texts = [f"{number} {word}" for number, word in parts if number]
    faults = [(count.malformed, "malformed"), (count.missed, "missed")]
    texts += [f"[red]{number} {word}[/]" for number, word in faults if number]
    return f"{count.topic} {', '.join(texts) or '-'}"


def cmd_bench(arguments: argparse.Namespace) -> int:
    """Measure."""
    from prior_sg.deploy.benches import main as bench

    if arguments.name not in (*bench.BENCHES, bench.POOL, "all"):
        raise UserError(
            f"there is no measurement {arguments.name!r}; known: {', '.join((*bench.BENCHES, bench.POOL))}, all"
        )
    for name in bench.BENCHES if arguments.name == "all" else [arguments.name]:
        with console.status(f"measuring {name}"):
            found = bench.run(name, arguments.seconds)
        if arguments.json:
            print(json.dumps(found))
        else:
            table = Table("metric", "value", title=f"{name} ({found['machine']['cores']} cores)")
            for metric, value in found["metrics"].items():
                table.add_row(metric, f"{value:.4g}")
            console.print(table)
    return 0


def cmd_eval(arguments: argparse.Namespace) -> int:
    """Compare methods on datasets with ground truth."""
    from prior_sg.deploy.evaluation.perception import EvaluationError

    try:
        return evaluation.run(arguments, console)
    except EvaluationError as error:
        raise UserError(str(error)) from error


def cmd_priors(arguments: argparse.Namespace) -> int:
    """Everything about priors."""
    from prior_sg.services.runtime.zenoh_bus import ZenohBus

    return priors.run(arguments, console, lambda endpoint: ZenohBus(endpoint, wait_s=2.0))


def main(argv: list[str] | None = None) -> int:
    """Exit status of the command; faults of the user or the system are one sentence on standard error."""
    arguments = build_parser().parse_args(argv)
    if arguments.command == "serve":
        return serve.run(arguments)
    from prior_sg.deploy.cli.report import ExportError
    from prior_sg.deploy.running.job import RunError
    from prior_sg.deploy.running.supervisor import ChildFailed

    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.default_int_handler)  # ended by a supervisor: as tidy as Ctrl-C
    try:
        return globals()[f"cmd_{arguments.command.replace('-', '_')}"](arguments)
    except BrokenPipeError:  # the reader of a pipe has left
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except (
        UserError,
        check.HopelessSource,
        priors.PriorError,
        packing.PackError,
        RunError,
        ExportError,
        ChildFailed,
        *serve.HOPELESS,
    ) as error:
        print(f"prior-sg: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("prior-sg: interrupted", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())

"""Commands for what is done with results, logs and the system itself."""

import argparse
import json
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from prior_sg.deploy.cli.shared import Commands, add_bus, add_log_mb, console, hush_logs, open_client
from prior_sg.deploy.errors import UsageError, UserError
from prior_sg.deploy.evaluation import command as evaluation
from prior_sg.deploy.evaluation import tune_command as tuning
from prior_sg.deploy.terminal import Part, Table, line
from prior_sg.services.errors import PriorSgError

if TYPE_CHECKING:
    from prior_sg.deploy.inspecting.health import Found
    from prior_sg.schemas.status import TopicCount


MOST_DIFFERENCES = 20  # of one life, listed


def add_commands(commands: Commands) -> None:
    """`explain`, `record`, `replay`, `topics`, `health`, `eval`, `tune` and `bench`."""
    _add_results(commands)
    _add_logs(commands)
    _add_system(commands)
    _add_measuring(commands)


def _add_results(commands: Commands) -> None:
    explain = commands.add(
        "explain",
        cmd_explain,
        "say why a place carries its label",
        "prior-sg explain 49 --log out/demo/log.mcap",
        needs="map",
    )
    explain.add_argument("place", type=int, help="id of the place, as in scene.json")
    explain.add_argument("--log", type=Path, help="ask the segmenter at the end of this log, not the running one")
    explain.add_argument("--json", action="store_true", help="print JSON")
    add_bus(explain)


def _add_logs(commands: Commands) -> None:
    record = commands.add(
        "record", cmd_record, "record all topics into a log, until Ctrl-C", "prior-sg record out/log.mcap"
    )
    record.add_argument("log", type=Path)
    record.add_argument("--seconds", type=float, default=0.0, help="stop after this long; 0 = at Ctrl-C")
    add_log_mb(record)
    add_bus(record, robot=False)

    replay = commands.add(
        "replay",
        cmd_replay,
        "feed a log to one service again and compare",
        "prior-sg replay out/demo/log.mcap segmenter --diff",
        needs="map",
    )
    replay.add_argument("log", type=Path)
    replay.add_argument("service")
    replay.add_argument("--diff", action="store_true", help="compare with what was recorded; exit 1 on differences")


def _add_system(commands: Commands) -> None:
    topics = commands.add(
        "topics",
        cmd_topics,
        "show topics and queries, or check that all documents agree",
        "prior-sg topics --check",
        needs="map",
    )
    topics.add_argument("--check", action="store_true", help="exit 1 when anything disagrees")
    topics.add_argument("--write", action="store_true", help="renew README, docs and docker-compose.yml")

    health = commands.add("health", cmd_health, "show every running process and its topics", "prior-sg health --json")
    health.add_argument("--json", action="store_true", help="print JSON")
    health.add_argument(
        "--seconds",
        type=float,
        default=1.0,
        help="look twice, so long apart, to see losses rise (default: %(default)s)",
    )
    health.add_argument(
        "--out", type=Path, default=Path("out/up"), help="folder of `up`, for reports of crashes (default: %(default)s)"
    )
    only = health.add_mutually_exclusive_group()
    only.add_argument(
        "--here", action="store_true", help="only this user's processes on this host or in this container"
    )
    only.add_argument("--router", action="store_true", help="only whether the router answers")
    add_bus(health, robot=False)


def _add_measuring(commands: Commands) -> None:
    evaluation.add_arguments(
        commands.add(
            "eval",
            cmd_eval,
            "compare methods on datasets with ground truth",
            'prior-sg eval recordings/home --environment "residential home" --methods ours,clio --html',
            needs="encode",
        )
    )

    tuning.add_arguments(
        commands.add(
            "tune",
            cmd_tune,
            "choose settings on some datasets and score the choice on those left out",
            "prior-sg tune world:home:0-4 --encoder sim:0.3 --values segmenter.region_cost=0,10,20",
            needs="encode",
        )
    )

    bench = commands.add(
        "bench",
        cmd_bench,
        "measure one part, or all",
        "prior-sg bench places --json",
        needs="encode",
    )
    bench.add_argument(
        "name",
        help="bus, places, features, kernel, swap, segmenter, task, learning, encoder_swap, queries, e2e, store, "
        "memory, start, all of these, or exchange, fleet, foresight, levels, markers, merge, pool, store_crashes, "
        "lidar, view, hydra",
    )
    bench.add_argument("--seconds", type=float, default=300.0, help="how long pool lasts (default: %(default)s)")
    bench.add_argument(
        "--on",
        nargs="+",
        type=Path,
        default=[],
        metavar="PATH",
        help="measure places, levels, merge or markers on these instead, or map these for foresight, such as "
        "world:home:80-91",
    )
    bench.add_argument(
        "--seeds",
        default="",
        help="of each kind of world for foresight, or of --worlds for learning, of which the first ten are explored, "
        "such as 76-79",
    )
    bench.add_argument(
        "--presets", nargs="+", help="of the place graph, for places with --on (default: indoor habitat mixed)"
    )
    bench.add_argument(
        "--worlds", default="", metavar="KIND", help="measure learning in generated worlds, such as home"
    )
    bench.add_argument("--json", action="store_true", help="print one JSON object per measurement")


def cmd_explain(arguments: argparse.Namespace) -> int:
    """Each expert's vote on a place, its neighbours' pull, and what follows."""
    import msgspec

    from prior_sg.deploy.api.client import Client
    from prior_sg.deploy.inspecting import explain

    if arguments.log is not None:
        if not arguments.log.exists():
            raise UserError(f"{arguments.log} does not exist; `run`, `demo` and `record` write one")
        reply = explain.from_log(arguments.log, arguments.robot, arguments.place)
    else:
        with Client(arguments.connect, arguments.robot) as client:
            try:
                reply = client.explain(arguments.place)
            except PriorSgError as error:
                raise UserError(str(error)) from error
    if not reply.found:
        raise UserError(f"{arguments.robot} has no labelled place {arguments.place}; scene.json lists their ids")
    if arguments.json:
        print(msgspec.json.encode(reply).decode())
    else:
        explain.show(reply, console)
    return 0


def cmd_record(arguments: argparse.Namespace) -> int:
    """Record until Ctrl-C or the given time."""
    from prior_sg.deploy.interrupts import insist
    from prior_sg.deploy.running.recorder import Recorder

    with open_client(arguments.connect) as client:
        recorder = Recorder(client, arguments.log, arguments.log_mb)
        end_s = time.monotonic() + (arguments.seconds or float("inf"))
        try:
            with console.status("recording; Ctrl-C stops") as status:
                while time.monotonic() < end_s:
                    time.sleep(0.2)
                    insist()
                    recorder.check()
                    total = sum(recorder.counts.values())
                    status.update(f"recording: {total} messages; Ctrl-C stops")
        except KeyboardInterrupt:
            pass
        finally:
            recorder.close()
    console.print(f"{sum(recorder.counts.values())} messages: {arguments.log}")
    if recorder.lacks:
        console.print(recorder.lacks)
    return 0


def cmd_replay(arguments: argparse.Namespace) -> int:
    """Replay a service and report differences."""
    from prior_sg.deploy.cli import report
    from prior_sg.deploy.inspecting import replay
    from prior_sg.services.registry import BY_NAME

    if arguments.service not in BY_NAME:
        raise UsageError(f"there is no service {arguments.service!r}; known: {', '.join(BY_NAME)}")
    log = replay.open_log(arguments.log, arguments.service)
    differences = 0
    for life in log.lives:
        found = replay.compare(log, life)
        console.print(
            f"{found.instance}: {found.inputs} inputs, {found.recorded} outputs recorded, {found.outputs} made"
        )
        listed = found.differences[:MOST_DIFFERENCES] if arguments.diff else []
        for text in listed:
            console.print(f"  {text}")
        if listed and len(found.differences) > len(listed):
            console.print(f"  and {len(found.differences) - len(listed)} more")
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

    if (arguments.write or arguments.check) and not topics.in_checkout():
        raise UserError("--check and --write are about the documents of a source checkout; run them in one")
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
    from prior_sg.deploy.inspecting.health import look, look_here
    from prior_sg.deploy.running.crashes import crashes, sentence
    from prior_sg.deploy.running.here import processes_here

    with open_client(arguments.connect) as client:
        if arguments.router:
            console.print(f"the router on {arguments.connect} answers")
            return 0
        seconds = max(arguments.seconds, 0.0)
        found = look_here(client, processes_here()) if arguments.here else look(client, seconds)
    now_s = time.time()
    died = [sentence(one, now_s) for one in crashes(arguments.out / "crashes", now_s)]
    if arguments.json:
        print(json.dumps(found.plain() | {"crashes": died}))
    else:
        _print_health(found)
        for text in died:
            console.print(text)
    return 0 if found.well else 1


def _print_health(found: "Found") -> None:
    """A process: what it is doing, what went through each topic, and what it could not use."""
    from prior_sg.services.losses import line as loss_line

    for status in found.processes:
        waits = f", waits for {', '.join(status.waiting_for)}" if status.waiting_for else ""
        figures = (
            f"  pid {status.pid}, up {status.uptime_s:.0f} s, busy {status.busy_share:.0%}, "
            f"step {status.step_ms_p50:.1f} ms (p99 {status.step_ms_p99:.1f}), {status.resident_mb:.0f} MB, "
            f"backlog {status.backlog}{waits}"
        )
        console.print(line((status.instance, "bold"), figures))
        parts = [part for count in status.topics for part in (" · ", *_topic_line(count))]
        console.print(line("    ", *parts[1:]))
        for loss in status.losses:
            console.print(f"    {loss_line(loss)}")
    for name in found.resting:
        console.print(f"{name} waits for the end of the process that is in charge")
    for entry in found.silent:
        console.print(line((entry["error"], "red")))
    for remark in found.remarks:
        console.print(line((remark.text, "red")) if remark.fault else remark.text)
    if not found.processes and not found.silent:
        console.print("no service is running; start them with `prior-sg up`")


def _topic_line(count: "TopicCount") -> list[Part]:
    """One topic's counts; what should not happen stands out."""
    parts = [
        (count.consumed, "in"),
        (count.published, "out"),
        (count.skipped, "skipped"),
        (count.duplicate, "repeated"),
    ]
    texts = [f"{number} {word}" for number, word in parts if number]
    faults = [(count.malformed, "malformed"), (count.limited, "too many"), (count.missed, "missed")]
    styled: list[Part] = [*texts, *((f"{number} {word}", "red") for number, word in faults if number)]
    separated = [part for entry in styled for part in (", ", entry)]
    return [f"{count.topic} ", *(separated[1:] or ["-"])]


def cmd_bench(arguments: argparse.Namespace) -> int:
    """Measure."""
    from prior_sg.deploy.benches import main as bench
    from prior_sg.deploy.evaluation.datasets import seeds_of

    if arguments.name not in (*bench.BENCHES, *bench.LONG, "all"):
        raise UsageError(
            f"there is no measurement {arguments.name!r}; known: {', '.join((*bench.BENCHES, *bench.LONG))}, all"
        )
    for option, takers in bench.TAKERS.items():
        if getattr(arguments, option) and arguments.name not in takers:
            raise UsageError(f"--{option} is of the measurements {', '.join(takers)}, not of {arguments.name}")
    hush_logs()
    seeds = seeds_of(arguments.seeds)
    if arguments.seeds and not seeds:
        raise UsageError(f"--seeds {arguments.seeds} names no seeds: write 3, 0-9 or 1,4,7")
    for name in bench.BENCHES if arguments.name == "all" else [arguments.name]:
        with console.status(f"measuring {name}") as status:
            asked = bench.Asked(
                seconds=arguments.seconds,
                paths=arguments.on,
                presets=arguments.presets or bench.exactness.PRESETS,
                worlds=arguments.worlds,
                seeds=seeds,
                report=partial(_tell, status.update, name),
            )
            found = bench.run(name, asked)
        if arguments.json:
            print(json.dumps(found))
        else:
            _print_figures(*bench.table(found), title=f"{name} ({found['machine']['cores']} cores)")
    return 0


def _print_figures(columns: Sequence[str], rows: list[list[str]], title: str) -> None:
    """As a table; as Markdown where that would be too wide for a terminal."""
    if len(columns) > 2:
        print(title, *(f"| {' | '.join(row)} |" for row in (columns, ["---"] * len(columns), *rows)), sep="\n")
        return
    table = Table(*columns, title=title)
    for row in rows:
        table.add_row(*row)
    console.print(table)


def _tell(update: Callable[[str], None], name: str, text: str) -> None:
    update(f"measuring {name}: {text}")


def cmd_eval(arguments: argparse.Namespace) -> int:
    """Compare methods on datasets with ground truth."""
    hush_logs()
    return evaluation.run(arguments, console)


def cmd_tune(arguments: argparse.Namespace) -> int:
    """Choose settings on some datasets and score the choice on those left out."""
    hush_logs()
    return tuning.run(arguments, console)

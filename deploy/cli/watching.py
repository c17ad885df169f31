"""`prior-sg metrics` and `prior-sg trace`: a running system seen from outside."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from prior_sg.deploy.cli.doors import add_entrance, port_in, say_until
from prior_sg.deploy.cli.shared import Commands, add_bus, console, open_client, until_interrupted
from prior_sg.deploy.errors import UsageError, UserError
from prior_sg.services.runtime import extras

if TYPE_CHECKING:
    from prior_sg.deploy.running.supervisor import Supervisor

METRICS_PORT = 9464


def add_commands(commands: Commands) -> None:
    """`metrics` and `trace`."""
    metrics = commands.add(
        "metrics",
        cmd_metrics,
        "tell Prometheus what every process does, and a collector what became of each keyframe, until Ctrl-C",
        "prior-sg metrics --port 9464 --trace http://localhost:4318",
        needs="ops",
    )
    add_entrance(metrics, METRICS_PORT)
    add_trace(metrics)
    add_bus(metrics, robot=False)
    metrics.add_argument("--robot", default=None, help="only this robot's processes and the fleet's (default: all)")

    trace = commands.add(
        "trace",
        cmd_trace,
        "say what became of one keyframe, where it waited and what is missing",
        "prior-sg trace 12 --log out/demo/log.mcap",
    )
    trace.add_argument("frame", type=int, help="number of the keyframe")
    trace.add_argument("--log", type=Path, help="look into this log, not at the running system")
    trace.add_argument("--json", action="store_true", help="print JSON")
    add_bus(trace)


def add_trace(parser: argparse.ArgumentParser) -> None:
    """Where traces of keyframes go."""
    parser.add_argument(
        "--trace",
        nargs="?",
        const="",
        default=None,
        metavar="URL",
        help="send the trace of each keyframe to an OTLP collector there; without URL to OTEL_EXPORTER_OTLP_ENDPOINT",
    )


def add_metrics(parser: argparse.ArgumentParser) -> None:
    """The same as options of `up`."""
    parser.add_argument(
        "--metrics",
        nargs="?",
        type=port_in,
        const=METRICS_PORT,
        default=None,
        metavar="PORT",
        help="also serve metrics for Prometheus there",
    )
    add_trace(parser)


def check_metrics(arguments: argparse.Namespace) -> None:
    """That what `up` is told about metrics can be done. Raises UserError, ExtraMissing."""
    if arguments.metrics is None:
        if arguments.trace is not None:
            raise UsageError("traces are sent by the process that serves metrics: add --metrics")
        return
    extras.require("ops", "prior-sg up --metrics")
    if arguments.trace is not None:
        from prior_sg.deploy.watching.otlp import endpoint_in_force

        endpoint_in_force(arguments.trace)


def open_metrics(supervisor: "Supervisor", port: int, collector: str | None) -> None:
    """Metrics on loopback, as one more process; for other hosts there is `prior-sg metrics`."""
    traces = [] if collector is None else ["--trace", collector]
    arguments = ["--host", "127.0.0.1", "--port", str(port), *traces]
    supervisor.start_door("metrics", "prior_sg.deploy.watching.process", arguments)
    console.print(f"metrics on http://127.0.0.1:{port}/metrics")


def cmd_metrics(arguments: argparse.Namespace) -> int:
    """HTTP until Ctrl-C."""
    from prior_sg.deploy.serving.gate import entrance
    from prior_sg.deploy.watching.door import serve_metrics

    entry = entrance(arguments.host, arguments.token_file)
    with until_interrupted():
        serve_metrics(arguments.connect, arguments.robot or "", entry, arguments.port, arguments.trace, say_until)
    return 0


def cmd_trace(arguments: argparse.Namespace) -> int:
    """One line for each passage; 1 where something is missing."""
    from prior_sg.deploy.inspecting import trace
    from prior_sg.deploy.json_text import json_text

    if arguments.log is not None:
        if not arguments.log.exists():
            raise UserError(f"{arguments.log} does not exist; `run`, `demo` and `record` write one")
        story = trace.from_log(arguments.log, arguments.robot, arguments.frame)
    else:
        with open_client(arguments.connect) as client:
            story = trace.from_system(client, arguments.robot, arguments.frame)
    if arguments.json:
        print(json_text(story.plain()))
    else:
        trace.show(story, console)
    return 1 if story.missing else 0

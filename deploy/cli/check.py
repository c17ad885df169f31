"""`prior-sg check`: what a source is, and what is wrong with it, before it is mapped."""

import argparse
from typing import TYPE_CHECKING

from rich.progress import BarColumn, MofNCompleteColumn, Progress

from prior_sg.deploy.cli.shared import Commands, add_settings, console
from prior_sg.deploy.cli.source_options import add_source_options, mapping_options, read_options
from prior_sg.deploy.errors import UserError
from prior_sg.deploy.json_text import json_text
from prior_sg.deploy.terminal import Description, Table, Terminal, line

if TYPE_CHECKING:
    from prior_sg.deploy.inspecting.check import Report
    from prior_sg.services.ingest.core.config import Config
    from prior_sg.services.place_graph.core.config import Config as PlaceGraphConfig

SAID_AT_START = ("reading", "ground truth")
STYLE = {"ok": "green", "note": "yellow", "problem": "bold red"}


class HopelessSource(UserError):
    """No map can come of a source; the message says why and what to do."""


def add_commands(commands: Commands) -> None:
    """`check`."""
    parser = commands.add(
        "check",
        cmd_check,
        "say what a source is and what is wrong with it",
        "prior-sg check recordings/home",
        needs="map",
    )
    parser.add_argument(
        "source", help="a folder in a known layout (docs/sources.md), a recording, ros2:/, realsense: or oak:"
    )
    parser.add_argument("--json", action="store_true", help="print JSON")
    add_settings(parser)
    add_source_options(parser)


def cmd_check(arguments: argparse.Namespace) -> int:
    """Check a source and show what was found; 1 when there are problems."""
    report = _checked(arguments.source, read_options(arguments), mapping_options(arguments))
    if arguments.json:
        print(json_text(as_builtins(report), None))
    else:
        show(report, console)
    return 1 if report.verdict == "problem" else 0


def before_start(path: str, cfg: "Config", console: Terminal, mapping: "PlaceGraphConfig | None" = None) -> "Report":
    """A brief check: one line about the source and one for each problem. Raises HopelessSource and SourceError."""
    from prior_sg.deploy.inspecting.check import check, unseen
    from prior_sg.services.ingest.sources import open_source
    from prior_sg.services.ingest.sources.devices.poses import is_fifo

    if is_fifo(cfg):
        console.print(
            f"{path} is not looked at before the start, for {cfg.pose_source} is a FIFO, which one reader empties"
        )
        return unseen(path)
    report = check(open_source(path, options=cfg), cfg, mapping=mapping, brief=True)
    console.print(report.summary)
    for finding in report.findings:
        if finding.verdict == "problem" or (finding.verdict == "note" and finding.topic in SAID_AT_START):
            console.print(line((finding.verdict, STYLE[finding.verdict]), f" {finding.topic}: {finding.line()}"))
    if report.problems and report.problems[0].hopeless:
        raise HopelessSource(f"{report.source}: {report.problems[0].line()}; `prior-sg check` says more")
    return report


def show(report: "Report", console: Terminal) -> None:
    """A table of all findings, and a closing line."""
    rows = Table("", "what", "found", "mend", title=report.source)
    for finding in report.findings:
        verdict = line((finding.verdict, STYLE[finding.verdict]))
        rows.add_row(verdict, finding.topic, finding.text, finding.mend)
    console.print(rows)
    count = len(report.problems)
    console.print(f"{count or 'no'} problem{'s' * (count != 1)}, {report.seconds:.1f} s")


def as_builtins(report: "Report") -> dict:
    """The report for `--json`."""
    import msgspec

    return {
        "source": report.source,
        "layout": report.layout,
        "verdict": report.verdict,
        "seconds": round(report.seconds, 3),
        "findings": msgspec.to_builtins(report.findings),
    }


def _checked(path: str, cfg: "Config", mapping: "PlaceGraphConfig") -> "Report":
    from prior_sg.deploy.inspecting.check import check, unreadable
    from prior_sg.services.ingest.sources import SourceError, open_source

    with _progress() as progress:
        bar = progress.add_task("reading", total=None)

        def show_progress(done: int, total: int) -> None:
            progress.update(bar, completed=done, total=total or None)

        try:
            return check(open_source(path, options=cfg), cfg, mapping=mapping, progress=show_progress)
        except SourceError as error:
            return unreadable(path, str(error))


def _progress() -> Progress:
    """A bar on the terminal's error stream, so that JSON stays clean."""
    columns = Description(), BarColumn(), MofNCompleteColumn()
    return Progress(*columns, console=Terminal(stderr=True), transient=True)

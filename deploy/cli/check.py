"""`prior-sg check`: what a source is, and what is wrong with it, before it is mapped."""

import argparse
import json
import sys

import msgspec
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
from rich.table import Table

from prior_sg.deploy.inspecting import check
from prior_sg.services.ingest.core import selection
from prior_sg.services.ingest.core.inspection import problems
from prior_sg.services.ingest.sources import Source

STYLE = {"ok": "green", "note": "yellow", "problem": "bold red"}


class HopelessSource(Exception):
    """No map can come of a source; the message says why and what to do."""


def run(source: Source, cfg: selection.Config, *, as_json: bool, console: Console) -> int:
    """Check a source and show what was found; 1 when there are problems."""
    with _progress() as progress:
        bar = progress.add_task("reading", total=None)
        report = check.check(
            source, cfg, progress=lambda done, total: progress.update(bar, completed=done, total=total or None)
        )
    if as_json:
        print(json.dumps(as_builtins(report)))
    else:
        show(report, console)
    return 1 if report.verdict == "problem" else 0


def before_start(source: Source, cfg: selection.Config, console: Console) -> check.Report:
    """A brief check: one line about the source and one for each problem. Raises HopelessSource."""
    report = check.check(source, cfg, brief=True)
    console.print(escape(report.summary))
    found = problems(report.findings)
    for finding in [*found, *(f for f in report.findings if f.topic == "ground truth" and f.verdict == "note")]:
        console.print(f"[{STYLE[finding.verdict]}]{finding.verdict}[/] {finding.topic}: {escape(finding.line())}")
    if found and found[0].hopeless:
        raise HopelessSource(f"{report.source}: {found[0].line()}; `prior-sg check` says more")
    return report


def show(report: check.Report, console: Console) -> None:
    """A table of all findings, and a closing line."""
    table = Table("", "what", "found", "mend", title=escape(report.source))
    for finding in report.findings:
        verdict = f"[{STYLE[finding.verdict]}]{finding.verdict}[/]"
        table.add_row(verdict, finding.topic, escape(finding.text), escape(finding.mend))
    console.print(table)
    count = len(problems(report.findings))
    console.print(f"{count or 'no'} problem{'s' * (count != 1)}, {report.seconds:.1f} s")


def as_builtins(report: check.Report) -> dict:
    """The report for `--json`."""
    return {
        "source": report.source,
        "layout": report.layout,
        "verdict": report.verdict,
        "seconds": round(report.seconds, 3),
        "findings": msgspec.to_builtins(report.findings),
    }


def _progress() -> Progress:
    """A bar on the terminal's error stream, so that JSON stays clean."""
    console = Console(file=sys.stderr)
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn()
    return Progress(*columns, console=console, transient=True)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `check`."""
    parser.add_argument("source", help="a folder in a known layout (docs/sources.md) or an MCAP log")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--config", default="", help="TOML file with a section per service")
    parser.add_argument("--set", action="append", default=[], metavar="SERVICE.FIELD=VALUE", help="one setting")

"""`prior-sg pack`: a source, read and put right, as one log."""

import argparse
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from rich.console import Console

from prior_sg.deploy.cli.source_options import add_source_options, read_options
from prior_sg.deploy.evaluation.metrics import GroundTruth
from prior_sg.deploy.sample.packed import PackError, keyframe_of, pose_update_of, write_log
from prior_sg.schemas.codec import Message
from prior_sg.services.ingest.core.selection import BadFrame, RawFrame
from prior_sg.services.ingest.sources import ReadOptions, Source, open_source

__all__ = ["PackError", "add_arguments", "pack", "run"]

SHOWN_REASONS = 5


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What the command can be told."""
    parser.add_argument("source", help="a folder in a known layout (docs/sources.md) or an MCAP log")
    parser.add_argument("log", type=Path, help="the file to write, ending in .mcap")
    parser.add_argument("--robot", default="robot1", help="name of the robot in the log (default: %(default)s)")
    parser.add_argument("--provenance", default="", help="a sentence on where the data comes from, kept in the log")
    parser.add_argument("--config", default="", help="TOML file with a section per service")
    parser.add_argument("--set", action="append", default=[], metavar="SERVICE.FIELD=VALUE", help="one setting")
    add_source_options(parser)


def run(arguments: argparse.Namespace, console: Console) -> int:
    """Pack with progress, and say what was changed and refused. Raises PackError, SourceError, LogError."""
    if arguments.log.suffix != ".mcap":
        raise PackError(f"{arguments.log} must end in .mcap, so that it is read as a log again")
    with console.status("opening the source") as status:
        source, refused = pack(
            arguments.source,
            arguments.log,
            read_options(arguments),
            arguments.robot,
            arguments.provenance,
            lambda done, total: status.update(f"{done} of {total} frames"),
        )
    for note in source.notes:
        console.print(f"{source.layout}: {note}", markup=False, soft_wrap=True)
    packed, lost = source.total - refused.total(), refused.total()
    size_mb = arguments.log.stat().st_size / 1e6
    console.print(f"{packed} frames, {size_mb:.1f} MB: {arguments.log}", markup=False, soft_wrap=True)
    if lost:
        console.print(f"{lost} of {source.total} frames refused:", markup=False, soft_wrap=True)
    for reason, count in refused.most_common(SHOWN_REASONS):
        console.print(f"  {count}: {reason}", markup=False, soft_wrap=True)
    return 0


def pack(  # noqa: PLR0917
    path: str | Path,
    log_path: Path,
    options: ReadOptions | None = None,
    robot: str = "robot1",
    provenance: str = "",
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[Source, Counter[str]]:
    """Write what a source gives to a log; the source, and how many frames were refused for which reason.

    The log is complete or absent. Raises PackError, SourceError or LogError.
    """
    source = open_source(path, options=options)
    refused: Counter[str] = Counter()
    partial = log_path.with_name(f"{log_path.name}.partial")
    try:
        write_log(partial, source, _messages(source, robot, refused, progress), robot, provenance, _truth(source))
        if refused.total() == source.total:
            top = refused.most_common(1)
            raise PackError(f"no frame of {path} can be packed: {top[0][0] if top else 'it holds none'}")
        partial.replace(log_path)
    finally:
        partial.unlink(missing_ok=True)
    return source, refused


def _messages(
    source: Source, robot: str, refused: Counter[str], progress: Callable[[int, int], None]
) -> Iterator[Message]:
    revision = 0
    for event in source.events():
        if isinstance(event, BadFrame):
            refused[event.reason] += 1
        elif isinstance(event, RawFrame):
            progress(event.index + 1, source.total)
            yield keyframe_of(event, robot, event.color, event.depth)
        else:
            yield pose_update_of(event, robot, revision)
            revision += 1


def _truth(source: Source) -> dict[str, Any] | None:
    """The source's regions where they are ours; somebody else's file of that name stays behind."""
    try:
        return source.ground_truth if source.ground_truth and GroundTruth.from_json(source.ground_truth) else None
    except ValueError:
        return None

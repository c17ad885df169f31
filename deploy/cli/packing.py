"""`prior-sg pack`: a source, read and put right, as one log."""

import argparse
from pathlib import Path

from prior_sg.deploy.cli.shared import Commands, add_settings, console
from prior_sg.deploy.cli.source_options import add_source_options, read_options
from prior_sg.deploy.errors import UsageError
from prior_sg.deploy.settings import DEFAULT_ROBOT

SHOWN_REASONS = 5


def add_commands(commands: Commands) -> None:
    """`pack`."""
    parser = commands.add(
        "pack",
        cmd_pack,
        "write a source, read and put right, as one log",
        "prior-sg pack recordings/home home.mcap --rate 5",
        needs="map",
    )
    parser.add_argument("source", help="a folder in a known layout (docs/sources.md) or an MCAP log")
    parser.add_argument("log", type=Path, help="the file to write, ending in .mcap")
    parser.add_argument("--robot", default=DEFAULT_ROBOT, help="name of the robot in the log (default: %(default)s)")
    parser.add_argument("--provenance", default="", help="a sentence on where the data comes from, kept in the log")
    add_settings(parser)
    add_source_options(parser)


def cmd_pack(arguments: argparse.Namespace) -> int:
    """Pack with progress, and say what was changed and refused. Raises UserError, SourceError, LogError."""
    from prior_sg.deploy.sample.packed import pack_source

    if arguments.log.suffix != ".mcap":
        raise UsageError(f"{arguments.log} must end in .mcap, so that it is read as a log again")
    with console.status("opening the source") as status:
        source, refused = pack_source(
            arguments.source,
            arguments.log,
            read_options(arguments),
            arguments.robot,
            arguments.provenance,
            lambda done, total: status.update(f"{done} of {total} frames"),
        )
    lines = [f"{source.layout}: {note}" for note in (*source.why, *source.notes)]
    packed, size_mb = source.total - refused.total(), arguments.log.stat().st_size / 1e6
    lines.append(f"{packed} frames, {size_mb:.1f} MB: {arguments.log}")
    if refused:
        lines.append(f"{refused.total()} of {source.total} frames refused:")
    lines += [f"  {count}: {reason}" for reason, count in refused.most_common(SHOWN_REASONS)]
    for line in lines:
        console.print(line, soft_wrap=True)
    return 0

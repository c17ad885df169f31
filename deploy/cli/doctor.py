"""`prior-sg doctor`: what is wrong here, and what mends it."""

import argparse
from pathlib import Path

from prior_sg.deploy.cli.shared import Commands, add_bus, add_settings, console
from prior_sg.deploy.json_text import json_text
from prior_sg.deploy.terminal import line


def add_commands(commands: Commands) -> None:
    """`doctor`."""
    parser = commands.add(
        "doctor",
        cmd_doctor,
        "say what is wrong here and which command mends it; starts and changes nothing",
        "prior-sg doctor --config robot.toml",
    )
    parser.add_argument("--out", type=Path, default=Path("out/up"), help="folder of results (default: %(default)s)")
    parser.add_argument("--encoder", default="", help="the encoder that is to run here")
    parser.add_argument("--before", action="store_true", help="before anything runs: leave out router and services")
    parser.add_argument("--json", action="store_true", help="print JSON")
    add_settings(parser)
    add_bus(parser, robot=False)


def cmd_doctor(arguments: argparse.Namespace) -> int:
    """One line for each finding; 1 when there are any."""
    from prior_sg.deploy.inspecting.doctor.bus import of_the_bus
    from prior_sg.deploy.inspecting.doctor.findings import OnTheBus, findings
    from prior_sg.deploy.inspecting.doctor.here import Asked, of_this_host

    here = of_this_host(Asked(arguments.out, arguments.config, tuple(arguments.set), arguments.encoder))
    found = findings(here, OnTheBus() if arguments.before else of_the_bus(arguments.connect))
    if arguments.json:
        print(json_text({"well": not found, "findings": [one._asdict() for one in found]}, None))
    else:
        for one in found:
            console.print(line((one.line(), "red")), soft_wrap=True)
        console.print(f"{len(found) or 'no'} finding{'s' * (len(found) != 1)}")
    return 1 if found else 0

"""The command line: `prior-sg`."""

import argparse
import os
import signal
import sys
import threading
from typing import TYPE_CHECKING

from prior_sg.deploy.cli import check, jobs, live, packing, priors, tools
from prior_sg.deploy.cli.shared import Commands, with_example
from prior_sg.deploy.edge import check_arguments, check_encoding
from prior_sg.deploy.errors import UserError
from prior_sg.deploy.running.serve import HOPELESS
from prior_sg.deploy.terminal import complain, forgive
from prior_sg.schemas.names import shown
from prior_sg.services.runtime import extras

if TYPE_CHECKING:
    from _typeshed import SupportsWrite


class Parser(argparse.ArgumentParser):
    """What it says of an argument is fit for a terminal."""

    def _print_message(self, message: str, file: "SupportsWrite[str] | None" = None) -> None:
        super()._print_message(shown(message), file)


def build_parser() -> argparse.ArgumentParser:
    """All commands with their options."""
    parser = Parser(
        prog="prior-sg",
        description="Task-driven hierarchical scene graphs from posed RGB-D streams.",
        **with_example("prior-sg demo"),
    )
    commands = Commands(parser, "command", "COMMAND")
    for module in (jobs, live, check, packing, tools, priors):
        module.add_commands(commands)
    return parser


def main(argv: list[str] | None = None) -> int:
    """Exit status of the command; faults of the user or the system are one sentence on standard error."""
    try:
        forgive()
        check_encoding(sys.argv[1:] if argv is None else argv)
        arguments = build_parser().parse_args(argv)
        check_arguments(arguments)
        extras.require(arguments.needs, f"prior-sg {arguments.command}")
        if threading.current_thread() is threading.main_thread() and arguments.command != "serve":
            signal.signal(signal.SIGTERM, signal.default_int_handler)  # ended by a supervisor: as tidy as Ctrl-C
        return arguments.run(arguments)
    except BrokenPipeError:  # the reader of a pipe has left
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except (UserError, *HOPELESS) as error:
        complain(str(error))
        return 1
    except ModuleNotFoundError as error:
        if (advice := extras.advice(error)) is None:
            raise
        complain(advice)
        return 1
    except KeyboardInterrupt:
        complain("interrupted")
        return 130


if __name__ == "__main__":
    sys.exit(main())

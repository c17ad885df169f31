"""The command line: `prior-sg`. Imports are within `main`, where an interrupt of them is told as one line."""

import argparse
import os
import signal
import sys
import threading


def build_parser() -> argparse.ArgumentParser:
    """All commands with their options."""
    from prior_sg.deploy.cli import (
        check,
        doctor,
        doors,
        encoders,
        export,
        fleet,
        foxglove,
        hydra,
        jobs,
        keys,
        live,
        packing,
        priors,
        query,
        ros,
        swap,
        tools,
        view,
        warm,
        watching,
    )
    from prior_sg.deploy.cli.shared import Commands, Parser, with_example

    parser = Parser(
        prog="prior-sg",
        description="Task-driven hierarchical scene graphs from posed RGB-D streams.",
        **with_example("prior-sg demo"),
    )
    commands = Commands(parser, "command", "COMMAND")
    for module in (
        jobs,
        live,
        swap,
        view,
        foxglove,
        query,
        doors,
        ros,
        hydra,
        fleet,
        check,
        doctor,
        warm,
        packing,
        export,
        tools,
        priors,
        encoders,
        keys,
        watching,
    ):
        module.add_commands(commands)
    return parser


def main(argv: list[str] | None = None) -> int:
    """Exit status of the command; faults of the user or the system are one sentence on standard error."""
    from prior_sg.deploy.interrupts import EXIT_INTERRUPTED, remembered
    from prior_sg.deploy.streams import give_up

    # As services of `up` have it: products are small, and threads spin for each other and change last bits of sums.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        with remembered():
            return _told(argv)
    except BrokenPipeError:  # the reader of a pipe has left
        give_up()
        return 1
    except KeyboardInterrupt:
        print("prior-sg: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED


def _told(argv: list[str] | None) -> int:
    from prior_sg.deploy.cli.faults import sentence_of
    from prior_sg.deploy.interrupts import insist
    from prior_sg.deploy.streams import complain, give_up, settle
    from prior_sg.services.errors import PriorSgError

    try:
        status = _run(argv)
        settle()
        return status
    except (BrokenPipeError, KeyboardInterrupt):
        raise
    except Exception as error:
        insist()  # Python wraps an interrupt that comes while a class is being made
        if (sentence := sentence_of(error)) is None:
            raise
        complain(sentence)
        give_up()
        return error.exit_status if isinstance(error, PriorSgError) else 1


def _run(argv: list[str] | None) -> int:
    from prior_sg.deploy.edge import check_arguments, check_encoding
    from prior_sg.deploy.interrupts import interrupt
    from prior_sg.deploy.limits import check_memory
    from prior_sg.deploy.settings import use_keys
    from prior_sg.deploy.streams import forgive, keep_apart
    from prior_sg.services.runtime import extras

    forgive()
    keep_apart()
    check_encoding(sys.argv[1:] if argv is None else argv)
    arguments = build_parser().parse_args(argv)
    check_arguments(arguments)
    use_keys(getattr(arguments, "keys", ""))
    check_memory(arguments.needs)
    extras.require(arguments.needs, f"prior-sg {arguments.command}")
    if arguments.command != "serve":  # one service may need no images, and loads it with the first
        extras.load(arguments.needs)
    if threading.current_thread() is threading.main_thread() and arguments.command != "serve":
        signal.signal(signal.SIGTERM, interrupt)  # ended by a supervisor: as tidy as Ctrl-C
    return arguments.run(arguments)


if __name__ == "__main__":
    sys.exit(main())

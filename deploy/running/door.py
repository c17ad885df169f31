"""The frame of a process that opens a running system to others: what `Supervisor.start_door` starts."""

import argparse
import contextlib
import logging
import signal
from collections.abc import Callable

from prior_sg.deploy.errors import UserError
from prior_sg.deploy.interrupts import interrupt
from prior_sg.deploy.running.serve import EXIT_HOPELESS, HOPELESS
from prior_sg.services.runtime.logs import start_logging

log = logging.getLogger(__name__)
Say = Callable[[str], None]


def run_door(
    name: str,
    about: str | None,
    add_options: Callable[[argparse.ArgumentParser], None],
    serve: Callable[[argparse.Namespace, Say], None],
) -> int:
    """Serve until a signal, or until the parent is gone. Exit status: the supervisor starts the process again unless
    that would fail again.
    """
    parser = argparse.ArgumentParser(description=about)
    parser.add_argument("name", choices=[name])
    parser.add_argument("--parent", type=int, default=0, help="end when this process is gone")
    parser.add_argument("--instance", default=name, help="name of this process")
    parser.add_argument("--robot", required=True)
    parser.add_argument("--connect", required=True)
    add_options(parser)
    arguments = parser.parse_args()
    start_logging(name, arguments.instance)
    signal.signal(signal.SIGTERM, interrupt)
    try:
        with contextlib.suppress(KeyboardInterrupt):
            serve(arguments, log.info)
    except (UserError, *HOPELESS) as error:
        log.error(str(error))
        return EXIT_HOPELESS
    return 0

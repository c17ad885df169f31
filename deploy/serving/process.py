"""The HTTP interface as a process of `prior-sg up`: `python -m prior_sg.deploy.serving.process api`."""

import argparse
import contextlib
import logging
import signal
import sys
from pathlib import Path

from prior_sg.deploy.errors import UserError
from prior_sg.deploy.interrupts import interrupt
from prior_sg.deploy.running.serve import EXIT_HOPELESS
from prior_sg.deploy.serving import door
from prior_sg.deploy.serving.gate import entrance
from prior_sg.services.runtime.bus import BusError
from prior_sg.services.runtime.logs import start_logging

log = logging.getLogger(__name__)


def main() -> int:
    """Exit status; the supervisor starts it again unless that would fail again."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("name", choices=["api"])
    parser.add_argument("--parent", type=int, default=0, help="end when this process is gone")
    parser.add_argument("--instance", default="api", help="name of this process")
    parser.add_argument("--robot", required=True)
    parser.add_argument("--connect", required=True)
    parser.add_argument("--host", required=True)
    parser.add_argument("--port", type=int, required=True)
    parser.add_argument("--token-file", type=Path, default=None)
    arguments = parser.parse_args()
    start_logging("api", arguments.instance)
    signal.signal(signal.SIGTERM, interrupt)
    try:
        entry = entrance(arguments.host, arguments.token_file)
        with contextlib.suppress(KeyboardInterrupt):
            door.serve_api(arguments.connect, arguments.robot, entry, arguments.port, log.info, parent=arguments.parent)
    except (UserError, BusError) as error:
        log.error(str(error))
        return EXIT_HOPELESS
    return 0


if __name__ == "__main__":
    sys.exit(main())

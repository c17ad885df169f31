"""The bridge to ROS 2 as a process of `prior-sg up`: `python -m prior_sg.deploy.ros.process ros`."""

import argparse
import contextlib
import logging
import signal
import sys

from prior_sg.deploy.errors import UserError
from prior_sg.deploy.interrupts import interrupt
from prior_sg.deploy.ros.bridge import serve_ros
from prior_sg.deploy.ros.options import add_options, options_of
from prior_sg.deploy.running.serve import EXIT_HOPELESS
from prior_sg.services.runtime.bus import BusError
from prior_sg.services.runtime.logs import start_logging
from prior_sg.services.runtime.service import ServiceError

log = logging.getLogger(__name__)


def main() -> int:
    """Exit status; the supervisor starts it again unless that would fail again."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("name", choices=["ros"])
    parser.add_argument("--parent", type=int, default=0, help="end when this process is gone")
    parser.add_argument("--instance", default="ros", help="name of this process")
    parser.add_argument("--robot", required=True)
    parser.add_argument("--connect", required=True)
    add_options(parser)
    arguments = parser.parse_args()
    start_logging("ros", arguments.instance)
    signal.signal(signal.SIGTERM, interrupt)
    try:
        options = options_of(arguments)
        with contextlib.suppress(KeyboardInterrupt):
            serve_ros(arguments.connect, arguments.robot, options, log.info, log.info, parent=arguments.parent)
    except (UserError, BusError, ServiceError) as error:
        log.error(str(error))
        return EXIT_HOPELESS
    return 0


if __name__ == "__main__":
    sys.exit(main())

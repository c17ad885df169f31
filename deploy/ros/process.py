"""The bridge to ROS 2 as a process of `prior-sg up`: `python -m prior_sg.deploy.ros.process ros`."""

import argparse
import sys

from prior_sg.deploy.ros.bridge import serve_ros
from prior_sg.deploy.ros.options import add_options, options_of
from prior_sg.deploy.running.door import Say, run_door


def _serve(arguments: argparse.Namespace, say: Say) -> None:
    options = options_of(arguments)
    serve_ros(arguments.connect, arguments.robot, options, say, say, parent=arguments.parent)


if __name__ == "__main__":
    sys.exit(run_door("ros", __doc__, add_options, _serve))

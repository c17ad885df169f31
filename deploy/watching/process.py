"""The metrics as a process of `prior-sg up`: `python -m prior_sg.deploy.watching.process metrics`."""

import argparse
import sys

from prior_sg.deploy.running.door import Say, run_door
from prior_sg.deploy.serving.gate import entrance
from prior_sg.deploy.watching.door import serve_metrics


def _add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--host", required=True)
    parser.add_argument("--port", type=int, required=True)
    parser.add_argument("--trace", default=None)


def _serve(arguments: argparse.Namespace, say: Say) -> None:
    entry = entrance(arguments.host, None)
    serve_metrics(arguments.connect, "", entry, arguments.port, arguments.trace, say, parent=arguments.parent)


if __name__ == "__main__":
    sys.exit(run_door("metrics", __doc__, _add_options, _serve))

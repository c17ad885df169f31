"""The HTTP interface as a process of `prior-sg up`: `python -m prior_sg.deploy.serving.process api`."""

import argparse
import sys
from pathlib import Path

from prior_sg.deploy.running.door import Say, run_door
from prior_sg.deploy.serving.door import serve_api
from prior_sg.deploy.serving.gate import entrance


def _add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--host", required=True)
    parser.add_argument("--port", type=int, required=True)
    parser.add_argument("--token-file", type=Path, default=None)


def _serve(arguments: argparse.Namespace, say: Say) -> None:
    entry = entrance(arguments.host, arguments.token_file)
    serve_api(arguments.connect, arguments.robot, entry, arguments.port, say, parent=arguments.parent)


if __name__ == "__main__":
    sys.exit(run_door("api", __doc__, _add_options, _serve))

"""What services warn of while a command measures them in its own process."""

import subprocess
import sys

PROGRAM = """
import logging
from prior_sg.deploy.cli.shared import hush_logs
{first}
logging.getLogger("prior_sg.services.feature_pyramid.worker").warning("keyframe without crops")
"""


def told(first: str) -> str:
    """What such a program prints among errors, in a process of its own: pytest has handlers here."""
    program = [sys.executable, "-c", PROGRAM.format(first=first)]
    return subprocess.run(program, capture_output=True, text=True, check=True).stderr


def test_measurements_do_not_repeat_what_services_warn_of():
    assert told("") == "keyframe without crops\n"
    assert told("hush_logs()") == ""

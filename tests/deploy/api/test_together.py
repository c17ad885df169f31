"""A task that is given to every robot of a merged map."""

import subprocess
import sys
import time

import pytest

from prior_sg.deploy.api.errors import TaskError
from prior_sg.deploy.api.together import given_each
from prior_sg.services.errors import PriorSgError

PROGRAM = """
import signal, threading, time
from prior_sg.deploy.api.together import given_each

signal.signal(signal.SIGINT, signal.default_int_handler)  # whoever ran the tests may ignore it
threading.Timer(0.5, signal.raise_signal, (signal.SIGINT,)).start()
try:
    given_each(["slow", "quick"], lambda robot: time.sleep(20 if robot == "slow" else 0))
except KeyboardInterrupt:
    print("interrupted")
"""


def test_an_interrupt_waits_for_no_gateway():
    begun_s = time.monotonic()
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, timeout=30, check=False)
    assert (done.stdout, done.stderr, done.returncode) == ("interrupted\n", "", 0)
    assert time.monotonic() - begun_s < 15


def test_who_refuses_is_named_and_faults_of_the_program_stay_what_they_are():
    def give(robot):
        if robot == "b":
            raise PriorSgError("it is busy")
        if robot == "c":
            raise ZeroDivisionError
        return robot.upper()

    assert given_each(["a", "d"], give) == ["A", "D"]
    with pytest.raises(TaskError, match="b does not follow the task: it is busy; a took it"):
        given_each(["a", "b"], give)
    with pytest.raises(ZeroDivisionError):
        given_each(["a", "c"], give)

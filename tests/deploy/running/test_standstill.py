"""A run is given up when nothing moves any more, and not while loops are being compiled."""

import pytest

from prior_sg.deploy.running import standstill
from prior_sg.deploy.running.standstill import COMPILING, STALL_AFTER_S, Standstill
from tests.help.telling import status


@pytest.fixture
def at(monkeypatch):
    """Sets the clock to so many seconds."""
    now = [0.0]
    monkeypatch.setattr(standstill.time, "monotonic", lambda: now[0])
    return lambda seconds: now.__setitem__(0, seconds)


def test_it_is_reached_when_neither_frames_nor_the_map_move(at):
    still = Standstill(lambda: [status(step_s=200.0)], print)
    at(STALL_AFTER_S)
    assert not still.reached(0.0)
    at(STALL_AFTER_S + 1)
    assert still.reached(0.0) and not still.reached(2.0)
    still.see((1, 0))
    assert not still.reached(0.0)
    at(2 * STALL_AFTER_S + 2)
    still.see((1, 0))
    assert still.reached(0.0), "the same figures are no movement"


def test_it_is_not_reached_while_loops_are_compiled_and_that_is_said_once(at):
    said, processes = [], [status(), status(step_s=125.0, step_compiling_s=120.0)]
    still = Standstill(lambda: processes, said.append)
    for round_ in range(1, 4):
        at(round_ * (STALL_AFTER_S + 1))
        assert not still.reached(0.0)
    assert said == [COMPILING]
    processes[1] = status(step_s=485.0, step_compiling_s=360.0)
    at(4 * (STALL_AFTER_S + 1))
    assert still.reached(0.0), "what held it up since then is something else"

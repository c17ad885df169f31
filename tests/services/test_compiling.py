"""How long a process compiles, and that its steps tell it."""

from prior_sg.services import compiling
from prior_sg.services.compiling import CompilingClock
from prior_sg.services.runtime.host import timing
from prior_sg.services.runtime.host.timing import Timing


class Now:
    """A clock that is set."""

    def __init__(self, monkeypatch):
        self.now_s = 100.0
        for module in (compiling, timing):
            monkeypatch.setattr(module.time, "monotonic", lambda: self.now_s)


def test_threads_that_compile_at_once_count_once(monkeypatch):
    now, clock = Now(monkeypatch), CompilingClock()
    with clock.running():
        now.now_s += 2
        with clock.running():
            now.now_s += 3
            assert clock.seconds() == 5
        now.now_s += 1
    now.now_s += 10
    assert clock.seconds() == 6


def test_a_step_tells_what_of_it_was_compiling(monkeypatch):
    now, clock, steps = Now(monkeypatch), CompilingClock(), Timing()
    monkeypatch.setattr(timing, "CLOCK", clock)

    def told():
        figures = steps.figures()
        return figures.step_s, figures.step_compiling_s

    with clock.running():
        now.now_s += 40
    began_s = steps.begins()
    now.now_s += 1
    assert told() == (1, 0), "what was before it is not of it"
    with clock.running():
        now.now_s += 50
        assert told() == (51, 50)
    now.now_s += 4
    assert told() == (55, 50)
    steps.stepped(began_s)
    assert told() == (0, 0)

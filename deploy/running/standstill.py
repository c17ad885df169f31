"""When a run that does not move is given up."""

import time
from collections.abc import Callable, Iterable

from prior_sg.schemas.status import ServiceStatus

STALL_AFTER_S = 120.0
HELD_UP_S = 60.0  # in a step that has compiled, after which it is held up by something else
COMPILING = "inner loops are compiled, as a first run does; `prior-sg warm` does so ahead of time"


class Standstill:
    """Nothing has moved for long, and no process is compiling its inner loops: on a slow machine that takes minutes."""

    def __init__(self, processes: Callable[[], Iterable[ServiceStatus]], say: Callable[[str], None]) -> None:
        self._processes, self._say = processes, say
        self._moved_s, self._figures, self._said = time.monotonic(), (0, 0), False

    def see(self, figures: tuple[int, int]) -> None:
        """How far it is; other figures than before are a movement."""
        if figures != self._figures:
            self._figures, self._moved_s = figures, time.monotonic()

    def reached(self, changed_s: float) -> bool:
        """Whether it stands still, where something else changed at that time of the monotonic clock."""
        if time.monotonic() - max(self._moved_s, changed_s) <= STALL_AFTER_S:
            return False
        if not any(map(_compiles, self._processes())):
            return True
        if not self._said:
            self._say(COMPILING)
        self._said, self._moved_s = True, time.monotonic()
        return False


def _compiles(one: ServiceStatus) -> bool:
    return one.step_compiling_s > 0 and one.step_s - one.step_compiling_s <= HELD_UP_S

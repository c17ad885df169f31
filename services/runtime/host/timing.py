"""How busy a process is, and how long its steps take."""

import time
from collections import deque
from statistics import quantiles
from typing import NamedTuple

RECENT_STEPS = 512
WINDOW_S = 10.0


class Figures(NamedTuple):
    """What the newest steps say."""

    uptime_s: float
    busy_share: float
    step_ms_p50: float
    step_ms_p99: float
    step_s: float


class Timing:
    """Times of the newest steps; filled by one thread, read by any."""

    def __init__(self) -> None:
        self._started_s = time.monotonic()
        self._began_s: float | None = None
        self._steps: deque[tuple[float, float]] = deque(maxlen=RECENT_STEPS)  # (end, duration), seconds

    def begins(self) -> float:
        """A step begins; its time."""
        self._began_s = time.monotonic()
        return self._began_s

    def stepped(self, started_s: float) -> None:
        """A step that began at this time has ended."""
        ended_s = time.monotonic()
        self._began_s = None
        self._steps.append((ended_s, ended_s - started_s))

    def figures(self) -> Figures:
        """As of now."""
        now_s, steps = time.monotonic(), list(self._steps)
        durations_ms = sorted(1e3 * duration_s for _, duration_s in steps)
        cuts = quantiles(durations_ms, n=100) if len(durations_ms) > 1 else durations_ms * 99 or [0.0] * 99
        uptime_s = now_s - self._started_s
        window_s = min(WINDOW_S, max(uptime_s, 1e-3))
        busy_s = sum(duration_s for end_s, duration_s in steps if end_s > now_s - window_s)
        began_s = self._began_s
        step_s = now_s - began_s if began_s is not None else 0.0
        return Figures(uptime_s, min(1.0, busy_s / window_s), cuts[49], cuts[98], step_s)

"""How busy a process is, and how long its steps take."""

import time
from bisect import bisect_left
from collections import deque
from statistics import quantiles
from typing import NamedTuple

import psutil

from prior_sg.schemas.status import STEP_BOUNDS_S
from prior_sg.services.compiling import CLOCK

RECENT_STEPS = 512
WINDOW_S = 10.0


class Figures(NamedTuple):
    """What the newest steps say, and all of them; named as in ServiceStatus."""

    uptime_s: float
    busy_share: float
    step_ms_p50: float
    step_ms_p99: float
    step_s: float
    step_compiling_s: float
    step_counts: list[int]
    step_sum_s: float
    cpu_s: float
    resident_mb: float


class Timing:
    """Times of the newest steps; filled by one thread, read by any."""

    def __init__(self) -> None:
        self._started_s = time.monotonic()
        self._began_s: float | None = None
        self._compiled_s = 0.0  # before that
        self._steps: deque[tuple[float, float]] = deque(maxlen=RECENT_STEPS)  # (end, duration), seconds
        self._counts = [0] * (len(STEP_BOUNDS_S) + 1)
        self._sum_s = 0.0
        self._process = psutil.Process()

    def begins(self) -> float:
        """A step begins; its time."""
        self._compiled_s = CLOCK.seconds()
        self._began_s = time.monotonic()
        return self._began_s

    def stepped(self, started_s: float) -> None:
        """A step that began at this time has ended."""
        ended_s = time.monotonic()
        self._began_s = None
        self._steps.append((ended_s, ended_s - started_s))
        self._counts[bisect_left(STEP_BOUNDS_S, ended_s - started_s)] += 1
        self._sum_s += ended_s - started_s

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
        compiling_s = min(step_s, CLOCK.seconds() - self._compiled_s)
        counts, sum_s = list(self._counts), self._sum_s
        times, memory = self._process.cpu_times(), self._process.memory_info()
        return Figures(
            uptime_s=uptime_s,
            busy_share=min(1.0, busy_s / window_s),
            step_ms_p50=cuts[49],
            step_ms_p99=cuts[98],
            step_s=step_s,
            step_compiling_s=compiling_s,
            step_counts=counts,
            step_sum_s=sum_s,
            cpu_s=times.user + times.system,
            resident_mb=memory.rss / 1e6,
        )

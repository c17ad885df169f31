"""How long this process has been compiling inner loops; known without numba, which `services/compiled.py` needs."""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager


class CompilingClock:
    """Seconds in which any thread was compiling; filled and read by any."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._threads, self._since_s, self._total_s = 0, 0.0, 0.0

    @contextmanager
    def running(self) -> Iterator[None]:
        """It runs within."""
        with self._lock:
            if not self._threads:
                self._since_s = time.monotonic()
            self._threads += 1
        try:
            yield
        finally:
            with self._lock:
                self._threads -= 1
                if not self._threads:
                    self._total_s += time.monotonic() - self._since_s

    def seconds(self) -> float:
        """Until now."""
        with self._lock:
            return self._total_s + (time.monotonic() - self._since_s if self._threads else 0.0)


CLOCK = CompilingClock()

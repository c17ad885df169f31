"""Structured logs: one JSON object a line, with the same leading fields in every process."""

import json
import logging
import sys
import threading
import time
from typing import Any

BURST, WINDOW_S = 20, 10.0  # warnings of one place in the code
STANDARD = set(vars(logging.makeLogRecord({}))) | {"message", "asctime", "taskName"}


class JsonFormatter(logging.Formatter):
    """Fields given as `extra` become fields of the line."""

    def __init__(self, service: str, instance: str) -> None:
        super().__init__()
        self._service, self._instance = service, instance

    def format(self, record: logging.LogRecord) -> str:
        """One line."""
        stamp = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(record.created))
        line: dict[str, Any] = {
            "time": f"{stamp}.{int(record.msecs):03d}Z",
            "level": record.levelname.lower(),
            "service": self._service,
            "instance": self._instance,
            "event": record.getMessage(),
        }
        line |= {name: value for name, value in vars(record).items() if name not in STANDARD}
        if record.exc_info:
            line["error"] = self.formatException(record.exc_info)
        return json.dumps(line, default=str)


class Limit(logging.Filter):
    """Lets at most `burst` warnings of one place in the code through within `window_s`; the next one after that says in
    `left_out` how many were not written. What floods a service must not fill its disk.
    """

    def __init__(self, burst: int = BURST, window_s: float = WINDOW_S) -> None:
        super().__init__()
        self._burst, self._window_s = burst, window_s
        self._lock = threading.Lock()
        self._windows: dict[tuple[str, int], tuple[float, int]] = {}  # (start, warnings since) by place

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether a record is written."""
        if record.levelno < logging.WARNING:
            return True
        place = (record.pathname, record.lineno)
        with self._lock:
            began_s, number = self._windows.get(place, (record.created, 0))
            if not 0 <= record.created - began_s < self._window_s:
                if number > self._burst:
                    record.left_out = number - self._burst
                began_s, number = record.created, 0
            self._windows[place] = began_s, number + 1
            return number < self._burst


def start_logging(service: str, instance: str, level: str = "info") -> None:
    """Send the logs of this process to standard error."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonFormatter(service, instance))
    handler.addFilter(Limit())
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(level.upper())
    for chatty in ("numba", "httpx", "httpcore", "urllib3", "sentence_transformers", "transformers"):
        logging.getLogger(chatty).setLevel(logging.WARNING)

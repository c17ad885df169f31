"""Ctrl-C is remembered, for what is being imported when it comes may swallow the exception that it raises."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

EXIT_INTERRUPTED = 130  # as shells say of a process that SIGINT has ended
_came = threading.Event()


@contextmanager
def remembered() -> Iterator[None]:
    """Within, Ctrl-C raises KeyboardInterrupt as ever, and `came` tells of it from then on."""
    _came.clear()
    if threading.current_thread() is not threading.main_thread():  # only the main thread may handle signals
        yield
        return
    previous = signal.signal(signal.SIGINT, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous)


def interrupt(number: int, frame: object) -> None:
    """A handler of signals that ask for an end. Raises KeyboardInterrupt."""
    _came.set()
    raise KeyboardInterrupt


def came() -> bool:
    """Whether an end was asked for since `remembered` began."""
    return _came.is_set()


def insist() -> None:
    """Raise KeyboardInterrupt if an end was asked for: what waits for one looks here, too."""
    if _came.is_set():
        raise KeyboardInterrupt

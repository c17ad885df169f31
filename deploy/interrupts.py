"""Ctrl-C is remembered, for what runs when it comes may swallow the exception that it raises: imports, finalizers."""

import _thread
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

EXIT_INTERRUPTED = 130  # as shells say of a process that SIGINT has ended
AGAIN_S = 0.05  # after which a finalizer that swallowed it has ended
_came = threading.Event()


@contextmanager
def remembered() -> Iterator[None]:
    """Within, Ctrl-C raises KeyboardInterrupt as ever, and `came` tells of it from then on. It comes again where Python
    could not raise it: in a finalizer, a callback of a weak reference or of C.
    """
    _came.clear()
    if threading.current_thread() is not threading.main_thread():  # only the main thread may handle signals
        yield
        return
    over = threading.Event()

    def again() -> None:
        # Not at once: it would be raised, and lost, within the very hook.
        if not over.wait(AGAIN_S):
            _thread.interrupt_main()

    def unraisable(args: "sys.UnraisableHookArgs") -> None:
        if not issubclass(args.exc_type, KeyboardInterrupt):
            sys.__unraisablehook__(args)
        else:
            threading.Thread(target=again, daemon=True).start()

    previous = signal.signal(signal.SIGINT, interrupt)
    previous_hook, sys.unraisablehook = sys.unraisablehook, unraisable
    try:
        yield
    finally:
        over.set()
        sys.unraisablehook = previous_hook
        signal.signal(signal.SIGINT, previous)
        _came.clear()  # what this process does next was not asked to end


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

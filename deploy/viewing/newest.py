"""Work of which only the newest wish counts."""

import logging
import threading
from collections.abc import Callable

log = logging.getLogger(__name__)


class Newest:
    """One thread that does what was asked for last: what it has not begun by then is left out, however much comes."""

    def __init__(self, work: Callable[..., None]) -> None:
        self._work = work
        self._changed = threading.Condition()
        self._asked: tuple[object, ...] | None = None
        self._closed = False
        self._thread = threading.Thread(target=self._run, name=work.__name__, daemon=True)
        self._thread.start()

    def ask(self, *arguments: object) -> None:
        """Do this next."""
        with self._changed:
            self._asked = arguments
            self._changed.notify()

    def close(self) -> None:
        """Begin nothing more; what has begun is not waited for."""
        with self._changed:
            self._closed = True
            self._changed.notify()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closed or self._asked is not None)
                if self._closed or self._asked is None:
                    return
                arguments, self._asked = self._asked, None
            try:
                self._work(*arguments)
            except Exception:  # a fault of ours: the next wish is another
                log.exception("%s failed", self._work.__name__)

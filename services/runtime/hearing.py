"""Whether a process still hears anything from the bus; where it does not, it has to end.

Zenoh's threads belong to the process. One that dies for want of memory takes along what it did: the session says that
it is connected and gives its signs of life, and nothing comes in any more, in this session or in a new one.
"""

import logging
import os
import threading
from collections.abc import Callable

from prior_sg.schemas.topics import roll_key
from prior_sg.services.runtime.bus import Bus, BusError

log = logging.getLogger(__name__)
NOBODY_KEY = roll_key("nobody", "nobody", "0")  # everybody may ask for it, nobody watches it: the router has to answer
ASK_EVERY_S = 4.0
ANSWER_S = 10.0  # behind much that travels, an answer takes a while
DEAF_AFTER_S = 40.0
LOOK_EVERY_S = 1.0
EXIT_DEAF = 6  # started again, it hears


def watch_hearing(
    bus: Bus,
    on_deaf: Callable[[], None],
    *,
    ask_every_s: float = ASK_EVERY_S,
    deaf_after_s: float = DEAF_AFTER_S,
    look_every_s: float = LOOK_EVERY_S,
) -> Callable[[], None]:
    """Ask the router again and again who is there, and call back, once, when a bus that says it is connected has had no
    answer for `deaf_after_s` of this process's own time: that in which it was stopped does not count. Returns what ends
    the watch. Asking has a thread of its own, for what dies may be what keeps the time of a question.
    """
    heard, over = threading.Event(), threading.Event()

    def ask() -> None:
        while not over.is_set():
            try:
                bus.announced(NOBODY_KEY, ANSWER_S)
            except BusError as error:
                log.debug("no answer from the router", extra={"why": str(error)})
            except Exception:  # of a session that is being closed
                log.debug("the router cannot be asked", exc_info=True)
            else:
                heard.set()
            over.wait(ask_every_s)

    def look() -> None:
        silent = 0
        while not over.wait(look_every_s):
            silent = 0 if heard.is_set() or not bus.connected() else silent + 1
            heard.clear()
            if silent * look_every_s >= deaf_after_s:
                on_deaf()
                return

    for name, work in (("asks-router", ask), ("hears-router", look)):
        threading.Thread(target=work, name=name, daemon=True).start()
    return over.set


def end_deaf() -> None:
    """End this process at once, as if it were killed: it can tell nobody, and may wait in a put for ever."""
    log.error(
        f"nothing has been heard from the router for {DEAF_AFTER_S:.0f} s, though it is connected: this process lacked "
        "memory or threads at some time, and ends to be started again"
    )
    os._exit(EXIT_DEAF)

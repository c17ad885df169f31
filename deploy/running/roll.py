"""Who ought to be there: whoever starts processes calls their roll on the bus, and sees which of them hang.

A process that exists and is not alive on the bus has been stopped, is thrashing, or has lost the router. Others learn
it from the roll, which `prior-sg health` reads.
"""

import threading
import time
from collections.abc import Callable, Iterable

from prior_sg.deploy.running.supervisor import Child
from prior_sg.schemas.topics import alive_key, roll_key
from prior_sg.services.runtime.bus import Bus

HUNG_AFTER_S = 5.0  # of silence; the bus takes two seconds to notice a process that was stopped


class Roll:
    """Of one supervisor's children."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._lock = threading.Lock()
        self._heard: set[str] = set()  # instances alive
        self._met: set[str] = set()  # that were alive at some time
        self._silent_since_s: dict[str, float] = {}
        self._told: set[str] = set()
        self._called: dict[str, Callable[[], None]] = {}
        bus.watch(alive_key("*", "*"), self._saw)

    def hears(self, unique: str) -> bool:
        """Whether a process is alive on the bus."""
        with self._lock:
            return unique in self._heard

    def check(self, children: Iterable[Child]) -> tuple[list[str], list[Child]]:
        """What happened, for the user, and the children that hang now."""
        running = {
            child.unique: child for child in children if child.process is not None and child.process.poll() is None
        }
        with self._lock:
            heard, met = set(self._heard), set(self._met)
        self._call({name: child for name, child in running.items() if name in met})
        now_s, events, hung = time.monotonic(), [], []
        for name, child in running.items():
            if name in heard or name not in met or not self._bus.connected():
                self._silent_since_s.pop(name, None)
                if name in self._told:
                    self._told.remove(name)
                    events.append(f"{child.instance} is heard again")
                continue
            if now_s - self._silent_since_s.setdefault(name, now_s) < HUNG_AFTER_S:
                continue
            hung.append(child)
            if name not in self._told:
                self._told.add(name)
                events.append(_hangs(child))
        return events, hung

    def _call(self, running: dict[str, Child]) -> None:
        """One token for each process that exists."""
        for name in running.keys() - self._called.keys():
            self._called[name] = self._bus.announce(roll_key(running[name].service, name, str(running[name].pid)))
        for name in self._called.keys() - running.keys():
            self._called.pop(name)()

    def _saw(self, key: str, alive: bool) -> None:
        name = key.rsplit("/", 1)[-1]
        with self._lock:
            if alive:
                self._met.add(name)
                self._heard.add(name)
            else:
                self._heard.discard(name)


def _hangs(child: Child) -> str:
    pid = child.pid
    return (
        f"{child.instance} (pid {pid}) hangs: it exists and has not been heard for {HUNG_AFTER_S:.0f} s; "
        f"`kill -CONT {pid}` if it was stopped, `kill -9 {pid}` to have it started again"
    )

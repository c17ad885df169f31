"""Asks a running system for its state every few seconds, and holds the newest picture of it."""

import logging
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from prior_sg.deploy.inspecting.health import Found, asked
from prior_sg.schemas.status import Passage, ServiceStatus, StatusRequest
from prior_sg.services.runtime.client import BusClient

log = logging.getLogger(__name__)
PERIOD_S = 2.0
LONGEST_GAP_NS = 60_000_000_000  # of a process that was not heard: what it has passed before is not told any more
OnPassages = Callable[[Sequence[tuple[ServiceStatus, Passage]]], None]


@dataclass
class Picture:
    """What was found, and when by the monotonic clock; how many polls went wrong."""

    found: Found = field(default_factory=Found)
    at_s: float | None = None
    failures: int = 0


class Follower:
    """Polls on a thread of its own until `close`. `taps` get each passage once, on that thread."""

    def __init__(self, client: BusClient, robot: str = "", taps: Sequence[OnPassages] = ()) -> None:
        self._client, self._robot, self._taps = client, robot, taps
        self._known_ns: dict[str, int] = {}  # until when passages are known, by instance and its host's clock
        self._since_ns = time.time_ns()
        self._stopping = threading.Event()
        self.picture = Picture()
        self._thread = threading.Thread(target=self._run, name="follower", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Ask nobody any more; waits for the answers that are under way."""
        self._stopping.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stopping.is_set():
            try:
                self._poll()
            except Exception as error:  # whatever somebody on the bus may tell: the next picture is another
                self.picture.failures += 1
                log.warning("the system could not be asked", extra={"why": str(error)})
            self._stopping.wait(PERIOD_S)

    def _poll(self) -> None:
        known_ns = self._known_ns.values() or [self._since_ns]
        since_ns = max(min(known_ns), max(known_ns) - LONGEST_GAP_NS)
        found = asked(self._client, StatusRequest(since_ns=since_ns))
        found.processes = [one for one in found.processes if self._robot in ("", one.robot) or one.robot == "*"]
        fresh = [
            (status, passage)
            for status in found.processes
            for passage in status.passages
            if passage.ended_ns > self._known_ns.get(status.instance, self._since_ns)
        ]
        unheard = [name for one in found.silent if (name := one["instance"]) in self._known_ns]
        self._known_ns = {name: self._known_ns[name] for name in unheard} | {
            # a process tells its clock before it looks for passages
            one.instance: max([one.clock_ns, *(passage.ended_ns for passage in one.passages)])
            for one in found.processes
            if one.clock_ns
        }
        for tap in self._taps:
            tap(fresh)
        self.picture = Picture(found, time.monotonic(), self.picture.failures)

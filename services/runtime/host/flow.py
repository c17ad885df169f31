"""Back-pressure: how far the readers of a process are behind it, told by their journals and liveliness."""

import asyncio
import logging
import math
import time
from collections.abc import Callable

log = logging.getLogger(__name__)
STUCK_S = 60.0
STANDBY_S = 0.5  # between two messages while a successor catches up, which must gain on any stream


class Progress:
    """How far the readers of this process's topics are: what back-pressure is made of."""

    def __init__(self, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._clock_s = clock_s
        self._published: dict[str, int] = {}
        self._reads: dict[str, list[str]] = {}
        self._consumed: dict[tuple[str, str], int] = {}
        self._moved_s: dict[str, float] = {}  # when a reader last finished with something, or had nothing to do
        self._stuck: set[str] = set()
        self._alive: set[str] = set()
        self._standby: set[str] = set()
        self._published_s: dict[str, float] = {}  # when, by topic
        self.event = asyncio.Event()

    def published(self, topic: str, sequence: int) -> None:
        """This process has published."""
        for instance, topics in list(self._reads.items()):
            if topic in topics and self._consumed.get((instance, topic), -1) >= self._published.get(topic, -1):
                self._moved_s[instance] = self._clock_s()
        self._published[topic], self._published_s[topic] = sequence, self._clock_s()

    def reader(self, instance: str, topics: list[str]) -> None:
        """A process says what it reads."""
        self._reads[instance] = list(topics)
        self._moved_s[instance] = self._clock_s()

    def consumed(self, instance: str, topic: str, sequence: int) -> None:
        """A process has finished with a message, which also shows that it reads the topic; -1 = another writer's."""
        if topic not in self._reads.setdefault(instance, []):
            self._reads[instance].append(topic)
        self._moved_s[instance] = self._clock_s()
        self._consumed[instance, topic] = max(sequence, self._consumed.get((instance, topic), -1))

    def stands_by(self, instance: str, so: bool) -> None:
        """A process reads what another that serves still reads, and knows nothing of what went before; or no longer."""
        (self._standby.add if so else self._standby.discard)(instance)

    def alive(self, instance: str, alive: bool) -> None:
        """A process has come or gone."""
        (self._alive.add if alive else self._alive.discard)(instance)
        if not alive:
            self._standby.discard(instance)
        self._moved_s[instance] = self._clock_s()

    def lag(self, topic: str) -> float:
        """By how many messages the slowest live reader is behind; infinitely many when nobody reads. One that has
        finished with nothing for `STUCK_S`, though there is something, is waited for no longer; one that stands by
        slows the stream down and does not stop it, for another serves.
        """
        newest = self._published.get(topic, -1)
        passes = self._clock_s() - self._published_s.get(topic, -math.inf) >= STANDBY_S
        lags = {
            instance: newest - self._consumed.get((instance, topic), -1)
            for instance, topics in list(self._reads.items())
            if topic in topics and instance in self._alive and not (passes and instance in self._standby)
        }
        return max((lag for instance, lag in lags.items() if not self._is_stuck(instance, lag)), default=math.inf)

    def _is_stuck(self, instance: str, lag: float) -> bool:
        stuck = lag > 0 and self._clock_s() - self._moved_s.get(instance, 0.0) > STUCK_S
        if stuck and instance not in self._stuck:
            log.warning("a reader finishes with nothing: it is waited for no longer", extra={"reader": instance})
        (self._stuck.add if stuck else self._stuck.discard)(instance)
        return stuck

    def changed(self, loop: asyncio.AbstractEventLoop) -> None:
        """Let whoever waits look again."""
        loop.call_soon_threadsafe(self.event.set)

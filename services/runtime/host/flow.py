"""Back-pressure: how far the readers of a process are behind it, told by their journals and liveliness."""

import asyncio
import math


class Progress:
    """How far the readers of this process's topics are: what back-pressure is made of."""

    def __init__(self) -> None:
        self._published: dict[str, int] = {}
        self._reads: dict[str, list[str]] = {}
        self._consumed: dict[tuple[str, str], int] = {}
        self._dead: set[str] = set()
        self.event = asyncio.Event()

    def published(self, topic: str, sequence: int) -> None:
        """This process has published."""
        self._published[topic] = sequence

    def reader(self, instance: str, topics: list[str]) -> None:
        """A process says what it reads."""
        self._reads[instance] = list(topics)
        self._dead.discard(instance)

    def consumed(self, instance: str, topic: str, sequence: int) -> None:
        """A process has finished with a message, which also shows that it reads the topic; -1 = another writer's."""
        if topic not in self._reads.setdefault(instance, []):
            self._reads[instance].append(topic)
        self._consumed[instance, topic] = max(sequence, self._consumed.get((instance, topic), -1))

    def alive(self, instance: str, alive: bool) -> None:
        """A process has come or gone."""
        (self._dead.discard if alive else self._dead.add)(instance)

    def lag(self, topic: str) -> float:
        """By how many messages the slowest live reader is behind; infinitely many when nobody reads."""
        newest = self._published.get(topic, -1)
        return max(
            (
                newest - self._consumed.get((instance, topic), -1)
                for instance, topics in list(self._reads.items())
                if topic in topics and instance not in self._dead
            ),
            default=math.inf,
        )

    def changed(self, loop: asyncio.AbstractEventLoop) -> None:
        """Let whoever waits look again."""
        loop.call_soon_threadsafe(self.event.set)

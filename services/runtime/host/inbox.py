"""Where a service's inputs wait: filled from foreign threads, emptied by one.

`latest` samples replace an older one of the same key that nobody has read; `every` samples queue up. Repeats are
dropped and gaps counted by each writer's own sequence numbers. What comes when `MOST_WAITING` wait is lost and counted;
the revisions of deltas make good for it.
"""

import logging
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from itertools import count
from typing import Any, TypeVar

from prior_sg.services.runtime.bus import Sample
from prior_sg.services.runtime.host.limits import Limits

T = TypeVar("T")
log = logging.getLogger(__name__)
MOST_WAITING = 20_000  # inputs: hours of a stream, seconds of a flood
MOST_WRITERS = 4096  # whose newest sequence numbers are known, by key


@dataclass
class Counts:
    """What happened to one topic."""

    received: int = 0
    consumed: int = 0
    published: int = 0
    malformed: int = 0
    limited: int = 0
    skipped: int = 0
    duplicate: int = 0
    missed: int = 0
    last_age_ms: float = -1.0


@dataclass
class Inbox:
    """`wake` is called, from whatever thread, when the inbox turns from empty to not empty."""

    wake: Callable[[], None]
    counts: dict[str, Counts] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)
    waited_s: float = 0.0  # what was taken last
    _waiting: "OrderedDict[Hashable, tuple[float, Any]]" = field(default_factory=OrderedDict)  # since when, what
    _sequences: dict[tuple[str, str], int] = field(default_factory=dict)
    _ids: count = field(default_factory=count)
    _limits: Limits = field(default_factory=Limits)

    def of(self, topic: str) -> Counts:
        """The counts of a topic."""
        return self.counts.setdefault(topic, Counts())

    def offer(self, sample: Sample) -> None:
        """Take in one sample."""
        with self._lock:
            counts = self.of(sample.topic.name)
            counts.received += 1
            if not self._is_new(sample, counts):
                counts.duplicate += 1
                if counts.duplicate.bit_count() == 1:  # the first, second, fourth, …: repeats must fill no log
                    about = {"topic": sample.topic.name, "key": sample.key, "writer": sample.writer}
                    log.info("message seen before dropped", extra=about | {"repeats": counts.duplicate})
                return
            if not self._allows(sample):
                return
            if sample.topic.delivery == "latest":
                place: Hashable = (sample.topic.name, sample.key)
                if self._waiting.pop(place, None) is not None:
                    counts.skipped += 1
            elif len(self._waiting) >= MOST_WAITING:
                counts.missed += 1
                return
            else:
                place = next(self._ids)
            self._put(place, sample)

    def allows(self, sample: Sample) -> bool:
        """Whether a sample is not one of too many on its key; those are counted."""
        with self._lock:
            return self._allows(sample)

    def put(self, item: Any, once: Hashable | None = None, first: bool = False) -> None:
        """Take in anything else; with `once`, only if no item of that name is waiting; with `first`, before all."""
        with self._lock:
            if once is None or once not in self._waiting:
                place = next(self._ids) if once is None else once
                self._put(place, item)
                if first:
                    self._waiting.move_to_end(place, last=False)

    def missed(self, topic: str, number: int) -> None:
        """Count samples known to be lost for good."""
        with self._lock:
            self.of(topic).missed += number

    def take(self) -> Any | None:
        """The oldest item, or None."""
        with self._lock:
            if not self._waiting:
                return None
            since_s, item = self._waiting.popitem(last=False)[1]
        self.waited_s = time.monotonic() - since_s
        return item

    def take_first(self, kind: type[T]) -> T | None:
        """The oldest item, if it is of this kind."""
        with self._lock:
            place = next(iter(self._waiting), None)
            if place is None or not isinstance(item := self._waiting[place][1], kind):
                return None
            del self._waiting[place]
            return item

    def waiting(self) -> list[Any]:
        """What waits, oldest first."""
        with self._lock:
            return [item for _, item in self._waiting.values()]

    @property
    def oldest_wait_s(self) -> float:
        """How long the input that waits longest has been waiting; 0 where none does."""
        now_s = time.monotonic()
        with self._lock:
            return max((now_s - since_s for since_s, _ in self._waiting.values()), default=0.0)

    def __len__(self) -> int:
        return len(self._waiting)

    def _allows(self, sample: Sample) -> bool:
        allowed = self._limits.allow(sample)
        self.of(sample.topic.name).limited += not allowed
        return allowed

    def _put(self, place: Hashable, item: Any) -> None:
        was_empty = not self._waiting
        self._waiting[place] = (time.monotonic(), item)
        if was_empty:
            self.wake()

    def _is_new(self, sample: Sample, counts: Counts) -> bool:
        """Whether this sample continues its writer's sequence; a reader that joins late misses nothing by that."""
        if not sample.writer:
            return True
        known = (sample.writer, sample.key)
        last = self._sequences.pop(known, None)
        if last is not None and sample.sequence <= last:
            self._sequences[known] = last
            return False
        if last is not None and sample.topic.delivery != "latest":
            counts.missed += sample.sequence - last - 1
        self._sequences[known] = sample.sequence
        if len(self._sequences) > MOST_WRITERS:
            del self._sequences[next(iter(self._sequences))]
        return True

"""How many messages one key may carry: no more than its topic allows.

A certificate grants keys, so the key tells whose messages are too many; a writer's name is only what it says of itself.
"""

import logging
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

from prior_sg.schemas.topics import Topic
from prior_sg.services.runtime.bus import Sample

log = logging.getLogger(__name__)
MOST_KEYS = 4096  # whose rates are known
CALM = 0.5  # of what may come at once: the share that must be free again before a flood counts as over


@dataclass
class Bucket:
    """What one key may still carry now, in messages; `dropped` counts what came beyond since a flood began."""

    left: float
    seen_s: float
    dropped: int = 0


class Limits:
    """Of one service; its callers see to it that one thread is in here at a time."""

    def __init__(self, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._clock_s = clock_s
        self._buckets: OrderedDict[str, Bucket] = OrderedDict()  # those that were used longest ago first

    def allow(self, sample: Sample) -> bool:
        """Whether a sample is taken in. The first of those that are too many is logged, and how many there were."""
        topic = sample.topic
        bucket = self._bucket(topic, topic.budget_key(sample.key))
        if bucket.left < 1:
            bucket.dropped += 1
            if bucket.dropped == 1:
                why = f"more than {topic.most_hz:g} a second, and than {topic.most_at_once} at once"
                log.warning("too many messages: dropped until there are fewer", extra=_about(sample) | {"why": why})
            return False
        bucket.left -= 1
        if bucket.dropped and bucket.left > CALM * topic.most_at_once:
            log.warning("messages dropped, there were too many", extra=_about(sample) | {"number": bucket.dropped})
            bucket.dropped = 0
        return True

    def _bucket(self, topic: Topic, key: str) -> Bucket:
        now_s = self._clock_s()
        bucket = self._buckets.pop(key, None) or Bucket(topic.most_at_once, now_s)
        bucket.left = min(bucket.left + (now_s - bucket.seen_s) * topic.most_hz, topic.most_at_once)
        bucket.seen_s = now_s
        self._buckets[key] = bucket
        if len(self._buckets) > MOST_KEYS:
            self._buckets.popitem(last=False)
        return bucket


def _about(sample: Sample) -> dict[str, str]:
    return {"topic": sample.topic.name, "key": sample.key, "writer": sample.writer}

"""The jobs that a service gives to workers, and how it hears that they are over."""

import asyncio
import logging
import time
from collections.abc import Callable
from typing import cast

from prior_sg.schemas.codec import Message, encode
from prior_sg.schemas.status import JobDone, PoolCount
from prior_sg.schemas.topics import Topic
from prior_sg.services.runtime.bus import Bus
from prior_sg.services.runtime.host.flow import Progress
from prior_sg.services.runtime.host.inbox import Inbox
from prior_sg.services.runtime.jobs.board import Ended
from prior_sg.services.runtime.jobs.pool import JobPool

log = logging.getLogger(__name__)


class Giving:
    """Of one service: a pool for each topic of jobs that it writes."""

    def __init__(self, inbox: Inbox, progress: Progress, loop: asyncio.AbstractEventLoop) -> None:
        self._inbox, self._progress, self._loop = inbox, progress, loop
        self.pools: dict[Topic, JobPool] = {}

    def open(self, bus: Bus, topic: Topic, robot: str, limit: int) -> None:
        """From now on jobs of the topic can be given; at most `limit` wait, 0 = any number."""
        self.pools[topic] = JobPool(bus, topic, robot, time.monotonic, self._job_ended(topic), limit=limit)

    def give(self, topic: Topic, message: Message) -> None:
        """Line up one job."""
        job_id = (message.robot, message.frame_id)  # type: ignore[attr-defined]
        group = getattr(message, "space", "")  # of a back-fill, which gives way to the stream
        self.pools[topic].submit(job_id, encode(message), group, later=bool(group))

    @property
    def under_way(self) -> bool:
        """Whether a job is not over."""
        return any(pool.outstanding for pool in self.pools.values())

    def counts(self) -> list[PoolCount]:
        """What waits and runs now, pool by pool."""
        return [pool.count() for pool in self.pools.values()]

    def close(self) -> None:
        """Give nothing more."""
        for pool in self.pools.values():
            pool.close()

    def _job_ended(self, topic: Topic) -> Callable[[Ended], None]:
        def ended(job: Ended) -> None:
            if job.error:
                log.warning("job given up", extra={"topic": topic.name, "job": str(job.id), "why": job.error})
            _, frame_id = cast(tuple[str, int], job.id)
            done = JobDone(
                topic=topic.name, frame_id=frame_id, worker=job.worker, attempts=job.attempts, error=job.error
            )
            self._inbox.put(done)
            self._progress.changed(self._loop)

        return ended

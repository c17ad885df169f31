"""What a source's `drive` may do: feed inputs, and wait until there is room for more."""

import asyncio
import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from prior_sg.schemas.codec import Message
from prior_sg.schemas.topics import Topic
from prior_sg.services.runtime.host.flow import Progress
from prior_sg.services.runtime.host.inbox import Inbox
from prior_sg.services.runtime.jobs.pool import JobPool

log = logging.getLogger(__name__)
LOOK_S = 0.1  # for what only time brings: who is stuck, or stands by, is waited for no longer


@dataclass(frozen=True)
class Fed:
    """An input from the service's own `drive`."""

    message: Message
    done: Callable[[], None]


@dataclass(frozen=True)
class Port:
    """`robot` is whose source it is; `stopping` is set when the host wishes to end."""

    robot: str
    stopping: asyncio.Event
    inbox: Inbox
    progress: Progress
    writes: Sequence[Topic]
    pools: Mapping[Topic, JobPool]

    async def consume(self, message: Message) -> None:
        """Run one step on this message; returns when its outputs are out."""
        done = asyncio.Event()
        self.inbox.put(Fed(message, done.set))
        await done.wait()

    async def room(self, window: int) -> None:
        """Wait until somebody reads, readers are at most `window` messages behind, there are workers, and fewer than
        `window` jobs are outstanding."""
        said = False
        while not self.stopping.is_set():
            self.progress.event.clear()
            lags = [self.progress.lag(topic.name) for topic in self.writes if topic.delivery == "every"]
            jobs = [pool.outstanding if pool.workers else math.inf for pool in self.pools.values()]
            if max(lags, default=0) <= window and max(jobs, default=0) < window:
                return
            if not said and math.inf in (*lags, *jobs):
                said = True
                log.info("waiting for readers and workers", extra={"lags": lags, "jobs": jobs})
            try:
                await asyncio.wait_for(self.progress.event.wait(), timeout=LOOK_S)
            except TimeoutError:
                continue

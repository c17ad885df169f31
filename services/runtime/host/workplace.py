"""Where a worker takes jobs: a few wait, each is done once, and its giver hears of the results."""

import logging
import threading
from collections.abc import Callable
from typing import Any

from prior_sg.schemas.codec import Message
from prior_sg.schemas.topics import Topic, fault_of_job
from prior_sg.services.runtime.bus import Request
from prior_sg.services.runtime.host.door import Door
from prior_sg.services.runtime.host.inbox import Inbox
from prior_sg.services.runtime.host.items import Work
from prior_sg.services.runtime.host.outbox import Outbox
from prior_sg.services.runtime.jobs.dispatcher import CREDITS
from prior_sg.services.runtime.jobs.memory import Done
from prior_sg.services.runtime.jobs.pool import done

log = logging.getLogger(__name__)


class Workplace:
    """Of a process that does jobs of a topic. `step` does one; `closed` says whether no more are taken."""

    def __init__(
        self,
        job: Topic,
        inbox: Inbox,
        door: Door,
        outbox: Outbox,
        *,
        step: Callable[[Message, str], None],
        writes: bool,
    ) -> None:
        self._job, self._inbox, self._door, self._outbox = job, inbox, door, outbox
        self._step, self._writes = step, writes
        self._slots, self._done = threading.Semaphore(CREDITS), Done()
        self.closed = threading.Event()

    def offer(self, request: Request) -> None:
        """Somebody gives a job, on a foreign thread."""
        if self.closed.is_set() or not self._slots.acquire(blocking=False):
            request.refuse("busy")
            return
        job, key = self._job, request.key
        message = self._door.admitted(
            job.type, request.payload, name=job.name, key=key, fault_of=lambda given: fault_of_job(job, key, given)
        )
        self._inbox.put(Work(request, message))

    def waiting(self) -> list[Message]:
        """Jobs taken in and not begun, oldest first."""
        waiting = (item.message for item in self._inbox.waiting() if isinstance(item, Work))
        return [message for message in waiting if message is not None]

    def do(self, work: Work, prepare: Callable[[list[Message]], Any]) -> None:
        """Do one job, unless it was done already; `prepare` is told of it and of those that wait."""
        message, name = work.message, self._job.name
        self._slots.release()
        if message is None:
            work.request.refuse("malformed")
            return
        self._inbox.of(name).consumed += 1
        wished_again = bool(getattr(message, "space", ""))  # of a back-fill: somebody lacks the results
        if not wished_again and (results := self._done.results_of(work.request.payload)):
            work.request.reply(done(results))
            return
        prepare([message, *self.waiting()])
        before, frame_id = self._outbox.written, getattr(message, "frame_id", -1)
        try:
            self._step(message, name)
        except Exception as error:  # jobs are independent of each other: one that cannot be done ends no worker
            log.exception("job failed", extra={"topic": name, "frame_id": frame_id})
            work.request.refuse(f"failed: {error}")
            return
        results = self._outbox.written - before
        self._done.note(work.request.payload, results)
        self._outbox.journal(name, frame_id=frame_id)
        work.request.reply(done(results if self._writes else 1))

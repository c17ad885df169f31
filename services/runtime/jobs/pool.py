"""`job` delivery over a bus: each job to one worker of every group of a pool, at least once.

Workers of one group do the same work (they serve one embedding space); a pool may hold several groups. The board
decides, the pool calls workers, watches them come and go, and looks again when time alone changes something.
"""

import logging
import re
import threading
from collections.abc import Callable, Hashable
from functools import partial

from prior_sg.schemas.codec import DecodeError, decode, encode
from prior_sg.schemas.status import PoolCount, ServiceStatus, StatusRequest
from prior_sg.schemas.topics import Topic, job_key, status_key, worker_keys
from prior_sg.services.runtime.bus import Answer, Bus
from prior_sg.services.runtime.jobs.board import Board, Ended
from prior_sg.services.runtime.jobs.dispatcher import NO_RESULT, Job

log = logging.getLogger(__name__)

DEFAULT_TIMEOUT_S = 60.0
DONE = "done"
DONE_WITH = re.compile(rb"done (\d{1,6})")
DONE_OF_OLD = DONE.encode()  # of a release that counted no results; no longer taken from 0.2 on
STATUS_TIMEOUT_S = 3.0


class JobPool:
    """Dispatches a robot's jobs of one topic over a bus. `on_ended` comes on a foreign thread, once per job.

    With `limit`, at most so many jobs wait and the oldest is skipped for a newer one; 0 = none is skipped.
    """

    def __init__(
        self,
        bus: Bus,
        topic: Topic,
        robot: str,
        clock_s: Callable[[], float],
        on_ended: Callable[[Ended], None],
        *,
        limit: int = 0,
        timeout_s: float = DEFAULT_TIMEOUT_S,
    ) -> None:
        self._bus, self._topic, self._robot, self._clock_s, self._on_ended = bus, topic, robot, clock_s, on_ended
        self._timeout_s = timeout_s
        self._board = Board(limit=limit)
        self._since_s: dict[Hashable, float] = {}  # when jobs that are not over were submitted
        self._lock = threading.RLock()
        self._timer: threading.Timer | None = None
        self._timer_at_s = 0.0
        self._closed = False
        self._live_prefix = worker_keys(topic, "", "")[1]
        bus.watch(worker_keys(topic, "*", "**")[1], self._worker_changed)

    @property
    def outstanding(self) -> int:
        """Jobs submitted and not finished, those for later left out."""
        with self._lock:
            return self._board.outstanding

    @property
    def workers(self) -> int:
        """Workers alive."""
        with self._lock:
            return self._board.workers

    def submit(self, job_id: Hashable, payload: bytes, group: str = "", later: bool = False) -> None:
        """Line up one job, for one group or for all, and send what can be sent."""
        with self._lock:
            self._since_s.setdefault(job_id, self._clock_s())
            ended = self._board.submit(job_id, payload, group, later)
        self._tell(ended)
        self._send()

    def count(self) -> PoolCount:
        """What waits and runs now, those for later left out."""
        with self._lock:
            now_s, waiting = self._clock_s(), self._board.waiting
            return PoolCount(
                topic=self._topic.name,
                waiting=len(waiting),
                running=self._board.running,
                oldest_wait_s=max((now_s - self._since_s.get(job, now_s) for job in waiting), default=0.0),
                workers={name: len(group.workers) for name, group in self._board.groups.items()},
            )

    def close(self) -> None:
        """Send nothing more."""
        with self._lock:
            self._closed = True
            if self._timer is not None:
                self._timer.cancel()

    def _worker_changed(self, key: str, alive: bool) -> None:
        name, _, group = key.removeprefix(self._live_prefix).partition("/")
        ended: list[Ended] = []
        with self._lock:
            if alive:
                self._board.worker_up(name, group)
            else:
                ended = self._board.worker_down(name, self._clock_s())
        log.info(
            "worker joined" if alive else "worker left",
            extra={"worker": name, "group": group, "topic": self._topic.name},
        )
        self._tell(ended)
        self._send()

    def _send(self) -> None:
        with self._lock:
            if self._closed:
                return
            assignments, ended = self._board.assign(self._clock_s())
            self._set_timer()
        self._tell(ended)
        for name, job in assignments:
            key = job_key(self._topic, name, self._robot)
            self._bus.call(key, job.payload, self._timeout_s, partial(self._answered, name, job))

    def _answered(self, name: str, job: Job, answer: Answer) -> None:
        if answer.payload == DONE_OF_OLD:
            self._ask_release(name, job)
        else:
            self._ended(name, job, _fault_of(answer))

    def _ask_release(self, name: str, job: Job) -> None:
        """Who says no more than that it is done is believed when it is of a release that could say no more."""

        def told(answer: Answer) -> None:
            self._ended(name, job, "" if _is_of_old(answer) else NO_RESULT)

        self._bus.call(status_key("*", name), encode(StatusRequest()), STATUS_TIMEOUT_S, told)

    def _ended(self, name: str, job: Job, reason: str) -> None:
        with self._lock:
            if reason:
                ended = self._board.failed(name, job.id, reason, self._clock_s())
            else:
                ended = self._board.finished(name, job.id, self._clock_s())
        if reason not in ("", "busy"):
            log.warning("job not done", extra={"worker": name, "job": str(job.id), "why": reason})
        self._tell(ended)
        self._send()

    def _tell(self, ended: list[Ended]) -> None:
        with self._lock:
            for job in ended:
                self._since_s.pop(job.id, None)
        for job in ended:
            self._on_ended(job)

    def _set_timer(self) -> None:
        """Look again when the board says; an earlier time replaces a later one."""
        now_s = self._clock_s()
        when_s = self._board.next_time_s(now_s)
        if when_s is None or (self._timer is not None and self._timer_at_s <= when_s):
            return
        if self._timer is not None:
            self._timer.cancel()
        self._timer = threading.Timer(max(0.01, when_s - now_s), self._timer_fired)
        self._timer_at_s = when_s
        self._timer.daemon = True
        self._timer.start()

    def _timer_fired(self) -> None:
        with self._lock:
            self._timer = None
        self._send()


def done(results: int) -> bytes:
    """The answer of a worker that has done a job and published so many results of it."""
    return f"{DONE} {results}".encode()


def _is_of_old(answer: Answer) -> bool:
    """Whether a status is of a process that does not know its release, as none did that counted no results."""
    try:
        return answer.payload is not None and not decode(ServiceStatus, answer.payload).release
    except DecodeError:
        return False


def _fault_of(answer: Answer) -> str:
    """Why a job is not done; empty when it is."""
    if answer.payload is None:
        return answer.reason
    told = DONE_WITH.fullmatch(answer.payload)
    return "" if told is not None and int(told[1]) > 0 else NO_RESULT

"""`job` delivery: each job to one worker of a pool, at least once.

`Dispatcher` is the pure part: it decides who gets what. A worker has a few credits; a job goes to the least loaded
worker with a credit left. A worker that disappears, answers nothing or fails loses the job, which goes to the front of
the line; a worker that hangs is kept out for a while. `JobPool` carries the decisions out over a bus.
"""

import logging
import threading
from collections import deque
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from functools import partial

from schemas.topics import Topic, worker_keys
from services.runtime.bus import Answer, Bus

log = logging.getLogger(__name__)

CREDITS = 2
MAX_ATTEMPTS = 4
BUSY_RETRY_S = 0.05
QUARANTINE_S = 1.0
MAX_QUARANTINE_S = 30.0
DEFAULT_TIMEOUT_S = 60.0


@dataclass
class Job:
    """One unit of work; `id` makes its result idempotent."""

    id: Hashable
    payload: bytes
    attempts: int = 0


@dataclass
class Worker:
    """What the dispatcher knows of one worker."""

    running: dict[Hashable, Job] = field(default_factory=dict)
    alive: bool = True
    not_before_s: float = 0.0
    hangs: int = 0


class Dispatcher:
    """Pure: events in (`submit`, `worker_up`, `answered`, …), assignments out (`assign`). Time is an argument."""

    def __init__(self, credits: int = CREDITS) -> None:
        self.credits = credits
        self.line: deque[Job] = deque()
        self.workers: dict[str, Worker] = {}

    @property
    def outstanding(self) -> int:
        """Jobs submitted and not finished."""
        return len(self.line) + sum(len(worker.running) for worker in self.workers.values())

    def submit(self, job_id: Hashable, payload: bytes) -> None:
        """Line up one job."""
        self.line.append(Job(job_id, payload))

    def worker_up(self, name: str) -> None:
        """A worker has joined, or come back."""
        worker = self.workers.setdefault(name, Worker())
        worker.alive, worker.not_before_s, worker.hangs = True, 0.0, 0

    def worker_down(self, name: str) -> list[Job]:
        """A worker is gone: its jobs go to the front of the line, oldest first. Returns those given up."""
        worker = self.workers.pop(name, None)
        held = list(worker.running.values()) if worker is not None else []
        self.line.extendleft(reversed([job for job in held if job.attempts < MAX_ATTEMPTS]))
        return [job for job in held if job.attempts >= MAX_ATTEMPTS]

    def assign(self, now_s: float) -> list[tuple[str, Job]]:
        """Who is to start what now."""
        assignments = []
        while self.line:
            ready = [
                (len(worker.running), name)
                for name, worker in self.workers.items()
                if worker.not_before_s <= now_s and len(worker.running) < self._credits_of(worker)
            ]
            if not ready:
                break
            _, name = min(ready)
            job = self.line.popleft()
            job.attempts += 1
            self.workers[name].running[job.id] = job
            assignments.append((name, job))
        return assignments

    def finished(self, name: str, job_id: Hashable) -> Job | None:
        """A worker has done a job; None when the job was already taken from it."""
        worker = self.workers.get(name)
        if worker is None:
            return None
        worker.hangs = 0
        return worker.running.pop(job_id, None)

    def failed(self, name: str, job_id: Hashable, reason: str, now_s: float) -> Job | None:
        """A worker has not done a job. Returns the job when it is given up."""
        worker = self.workers.get(name)
        job = worker.running.pop(job_id, None) if worker else None
        if worker is None or job is None:
            return None
        if reason == "busy":
            job.attempts -= 1
            worker.not_before_s = now_s + BUSY_RETRY_S
        elif reason == "timeout":
            worker.hangs += 1
            worker.not_before_s = now_s + min(QUARANTINE_S * 2 ** (worker.hangs - 1), MAX_QUARANTINE_S)
        elif reason == "nobody":
            worker.not_before_s = now_s + QUARANTINE_S
        if job.attempts >= MAX_ATTEMPTS:
            return job
        self.line.appendleft(job)
        return None

    def next_time_s(self, now_s: float) -> float | None:
        """When a waiting worker may be tried again."""
        times = [worker.not_before_s for worker in self.workers.values() if worker.not_before_s > now_s]
        return min(times) if times and self.line else None

    def _credits_of(self, worker: Worker) -> int:
        return 1 if worker.hangs else self.credits


class JobPool:
    """Dispatches the jobs of one topic over a bus. `on_done(id, worker, attempts, error)` comes on a foreign thread."""

    def __init__(
        self,
        bus: Bus,
        topic: Topic,
        clock_s: Callable[[], float],
        on_done: Callable[[Hashable, str, int, str], None],
        timeout_s: float = DEFAULT_TIMEOUT_S,
    ) -> None:
        self._bus, self._topic, self._clock_s, self._on_done = bus, topic, clock_s, on_done
        self._timeout_s = timeout_s
        self._dispatcher = Dispatcher()
        self._lock = threading.RLock()
        self._timer: threading.Timer | None = None
        self._closed = False
        bus.watch(worker_keys(topic, "*")[1], self._worker_changed)

    @property
    def outstanding(self) -> int:
        """Jobs submitted and not finished."""
        with self._lock:
            return self._dispatcher.outstanding

    @property
    def workers(self) -> int:
        """Workers alive."""
        with self._lock:
            return len(self._dispatcher.workers)

    def submit(self, job_id: Hashable, payload: bytes) -> None:
        """Line up one job and send what can be sent."""
        with self._lock:
            self._dispatcher.submit(job_id, payload)
        self._send()

    def close(self) -> None:
        """Send nothing more."""
        with self._lock:
            self._closed = True
            if self._timer is not None:
                self._timer.cancel()

    def _worker_changed(self, key: str, alive: bool) -> None:
        name = key.rsplit("/", 1)[-1]
        given_up: list[Job] = []
        with self._lock:
            if alive:
                self._dispatcher.worker_up(name)
            else:
                given_up = self._dispatcher.worker_down(name)
        for job in given_up:
            self._on_done(job.id, name, job.attempts, "its workers died")
        log.info("worker joined" if alive else "worker left", extra={"worker": name, "topic": self._topic.name})
        self._send()

    def _send(self) -> None:
        with self._lock:
            if self._closed:
                return
            assignments = self._dispatcher.assign(self._clock_s())
            self._set_timer()
        for name, job in assignments:
            key = worker_keys(self._topic, name)[0]
            self._bus.call(key, job.payload, self._timeout_s, partial(self._answered, name, job))

    def _answered(self, name: str, job: Job, answer: Answer) -> None:
        attempts = job.attempts
        with self._lock:
            if answer.payload is not None:
                done, error = self._dispatcher.finished(name, job.id), ""
            else:
                done, error = self._dispatcher.failed(name, job.id, answer.reason, self._clock_s()), answer.reason
        if answer.payload is None and answer.reason != "busy":
            log.warning("job not done", extra={"worker": name, "job": str(job.id), "reason": answer.reason})
        if done is not None:
            self._on_done(job.id, name, attempts, error)
        self._send()

    def _set_timer(self) -> None:
        when_s = self._dispatcher.next_time_s(self._clock_s())
        if when_s is None or self._timer is not None:
            return
        self._timer = threading.Timer(max(0.01, when_s - self._clock_s()), self._timer_fired)
        self._timer.daemon = True
        self._timer.start()

    def _timer_fired(self) -> None:
        with self._lock:
            self._timer = None
        self._send()

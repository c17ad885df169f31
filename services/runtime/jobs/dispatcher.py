"""`job` delivery: each job to one worker of every group of a pool, at least once.

Workers of one group do the same work (they serve one embedding space); a pool may hold several groups. Two parts are
pure, with time as an argument: `Dispatcher` decides within one group who gets what, `Board` holds the groups and says
when a job is done for all of them. `JobPool` carries the decisions out over a bus.

A worker has a few credits. A job goes to the worker that should finish it first, by the pace it has shown, so a slow
worker gets less. A worker that disappears, answers nothing or fails loses the job, which goes to the front of the line.
One that takes several times longer than its own pace is suspected to hang: its jobs are given to others as well, once,
and it gets nothing new until it answers. Results are idempotent, so a job done twice costs time and nothing else.
"""

import logging
import statistics
import threading
from collections import deque
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

from prior_sg.schemas.topics import Topic, worker_keys
from prior_sg.services.runtime.bus import Answer, Bus

log = logging.getLogger(__name__)

CREDITS = 3  # the one under way, the next one, which the worker may prepare meanwhile, and one on its way
MAX_ATTEMPTS = 4
BUSY_RETRY_S = 0.05
QUARANTINE_S = 1.0
MAX_QUARANTINE_S = 30.0
DEFAULT_TIMEOUT_S = 60.0
PACE_SHARE = 0.3  # of the newest job in a worker's pace
OVERDUE_FACTOR = 3.0  # times its pace after which a worker is suspected to hang
OVERDUE_LEAST_S = 0.7  # but not before
UNKNOWN_PACE_S = 2.0  # of a worker that has finished nothing, when no other has either
ABANDONED_S = 10.0  # a group without workers for this long leaves its jobs to the other groups
SKIPPED = "skipped for a newer one"
NO_WORKER = "no worker serves it any more"


@dataclass(eq=False)
class Job:
    """One unit of work; `id` makes its result idempotent."""

    id: Hashable
    payload: bytes
    later: bool = False  # gives way to all others
    attempts: int = 0
    holders: int = 0  # workers that have it now
    over: bool = False  # done or given up


class Run(NamedTuple):
    """A job at a worker."""

    job: Job
    since_s: float


@dataclass
class Worker:
    """What the dispatcher knows of one worker."""

    running: dict[Hashable, Run] = field(default_factory=dict)
    not_before_s: float = 0.0
    hangs: int = 0
    pace_s: float | None = None  # seconds per job, smoothed
    last_done_s: float = 0.0
    suspected: bool = False

    def head_since_s(self) -> float:
        """Since when it should be at work on its oldest job."""
        oldest = next(iter(self.running.values())).since_s
        return max(oldest, self.last_done_s)


class Dispatcher:
    """One group of workers. Events in (`submit`, `worker_up`, `finished`, …), assignments out (`assign`)."""

    def __init__(self, credits: int = CREDITS, limit: int = 0) -> None:
        self.credits = credits
        self.limit = limit  # jobs that may wait before the oldest is skipped; 0 = any number
        self.line: deque[Job] = deque()
        self.later: deque[Job] = deque()
        self.workers: dict[str, Worker] = {}

    @property
    def outstanding(self) -> int:
        """Jobs submitted and not finished, those for later left out."""
        return sum(not job.later for job in self.open_jobs())

    def open_jobs(self) -> set[Job]:
        """Jobs that wait or that some worker has, and that are not over."""
        running = {run.job for worker in self.workers.values() for run in worker.running.values() if not run.job.over}
        return running | set(self.line) | set(self.later)

    def submit(self, job_id: Hashable, payload: bytes, later: bool = False) -> list[Job]:
        """Line up one job. Returns those that are skipped for it."""
        (self.later if later else self.line).append(Job(job_id, payload, later))
        skipped = []
        while self.limit and len(self.line) > self.limit:
            skipped.append(self.line.popleft())
            skipped[-1].over = True
        return skipped

    def worker_up(self, name: str) -> None:
        """A worker has joined, or come back."""
        worker = self.workers.setdefault(name, Worker())
        worker.not_before_s, worker.hangs, worker.suspected = 0.0, 0, False

    def worker_down(self, name: str) -> list[Job]:
        """A worker is gone: its jobs go to the front of the line, oldest first. Returns those given up."""
        worker = self.workers.pop(name, None)
        held = [run.job for run in worker.running.values()] if worker is not None else []
        return [job for job in reversed(held) if self._lost(job)]

    def assign(self, now_s: float) -> list[tuple[str, Job]]:
        """Who is to start what now."""
        self._suspect(now_s)
        assignments = []
        while self.line or self.later:
            line = self.line or self.later
            job = line[0]
            usual_s = self._usual_pace_s()
            ready = [
                (self._expected_s(worker, usual_s), name)
                for name, worker in self.workers.items()
                if worker.not_before_s <= now_s
                and not worker.suspected
                and job.id not in worker.running
                and len(worker.running) < self._credits_of(worker)
            ]
            if not ready:
                break
            _, name = min(ready)
            line.popleft()
            job.attempts += 1
            job.holders += 1
            self.workers[name].running[job.id] = Run(job, now_s)
            assignments.append((name, job))
        return assignments

    def finished(self, name: str, job_id: Hashable, now_s: float) -> Job | None:
        """A worker has done a job; None when the job was already taken from it, or done by another."""
        worker = self.workers.get(name)
        if worker is None or job_id not in worker.running:
            return None
        took_s = max(now_s - worker.head_since_s(), 1e-6)
        worker.pace_s = took_s if worker.pace_s is None else worker.pace_s + PACE_SHARE * (took_s - worker.pace_s)
        worker.hangs, worker.last_done_s, worker.suspected = 0, now_s, False
        job = worker.running.pop(job_id).job
        job.holders -= 1
        if job.over:
            return None
        job.over = True
        self._withdraw(job)
        return job

    def failed(self, name: str, job_id: Hashable, reason: str, now_s: float) -> Job | None:
        """A worker has not done a job. Returns the job when it is given up."""
        worker = self.workers.get(name)
        run = worker.running.pop(job_id, None) if worker else None
        if worker is None or run is None:
            return None
        if reason == "busy":
            run.job.attempts -= 1
            worker.not_before_s = now_s + BUSY_RETRY_S
        elif reason == "timeout":
            worker.hangs += 1
            worker.not_before_s = now_s + min(QUARANTINE_S * 2 ** (worker.hangs - 1), MAX_QUARANTINE_S)
        elif reason == "nobody":
            worker.not_before_s = now_s + QUARANTINE_S
        if not worker.running:
            worker.suspected = False
        return run.job if self._lost(run.job) else None

    def next_time_s(self, now_s: float) -> float | None:
        """When to look again although nothing has happened: a worker may be tried again, or one may be overdue."""
        times = [worker.not_before_s for worker in self.workers.values() if worker.not_before_s > now_s]
        times = times if self.line or self.later else []
        usual_s = self._usual_pace_s()
        times += [
            worker.head_since_s() + self._patience_s(worker, usual_s)
            for worker in self.workers.values()
            if worker.running and not worker.suspected
        ]
        return min(times, default=None)

    def _suspect(self, now_s: float) -> None:
        """Workers far behind their own pace: give their jobs to others too, and nothing new to them."""
        usual_s = self._usual_pace_s()
        for worker in self.workers.values():
            if not worker.running or worker.suspected:
                continue
            if now_s - worker.head_since_s() < self._patience_s(worker, usual_s):
                continue
            worker.suspected = True
            for job in reversed([run.job for run in worker.running.values()]):
                alone = job.holders == 1 and job not in self._line_of(job)
                if alone and not job.over and job.attempts < MAX_ATTEMPTS:
                    self._line_of(job).appendleft(job)

    def _lost(self, job: Job) -> bool:
        """One worker less has this job. Whether it is given up."""
        job.holders -= 1
        waiting = self._line_of(job)
        if job.over or job.holders > 0 or job in waiting:
            return False
        if job.attempts >= MAX_ATTEMPTS:
            job.over = True
            return True
        waiting.appendleft(job)
        return False

    def _withdraw(self, job: Job) -> None:
        """Take a finished job out of the line, where a suspicion had put it again."""
        if job in self._line_of(job):
            self._line_of(job).remove(job)

    def _line_of(self, job: Job) -> deque[Job]:
        return self.later if job.later else self.line

    def _usual_pace_s(self) -> float | None:
        paces = [worker.pace_s for worker in self.workers.values() if worker.pace_s is not None]
        return statistics.median(paces) if paces else None

    def _expected_s(self, worker: Worker, usual_s: float | None) -> float:
        """Seconds until one more job would be done; a newcomer is taken for as fast as the others."""
        pace_s = worker.pace_s if worker.pace_s is not None else usual_s if usual_s is not None else UNKNOWN_PACE_S
        return (len(worker.running) + 1) * pace_s

    def _patience_s(self, worker: Worker, usual_s: float | None) -> float:
        pace_s = worker.pace_s
        if pace_s is None:
            pace_s = max(usual_s or 0.0, UNKNOWN_PACE_S)
        return max(OVERDUE_FACTOR * pace_s, OVERDUE_LEAST_S)

    def _credits_of(self, worker: Worker) -> int:
        return 1 if worker.hangs else self.credits


class Ended(NamedTuple):
    """A job that is over in every group. `error` is empty when some group has done it."""

    id: Hashable
    worker: str
    attempts: int
    error: str


@dataclass
class Owed:
    """Which groups have still to do a job, and whether one has."""

    payload: bytes
    groups: set[str]
    only: bool  # meant for this one group
    done: bool = False


class Board:
    """The groups of a pool. A job without a group goes to every group that has workers; the first group that comes
    gets those that found none. A group that comes later gets the newest job, so that readers of the results hear of it
    even when nothing new is submitted.
    """

    def __init__(self, credits: int = CREDITS, limit: int = 0) -> None:
        self._credits, self._limit = credits, limit
        self.groups: dict[str, Dispatcher] = {}
        self._group_of: dict[str, str] = {}  # of a worker
        self._empty_since_s: dict[str, float] = {}
        self._owed: dict[Hashable, Owed] = {}
        self._homeless: deque[tuple[Hashable, bytes, bool]] = deque()
        self._newest: tuple[Hashable, bytes] | None = None

    @property
    def outstanding(self) -> int:
        """Jobs of the group that has most of them, those for later left out."""
        return max((group.outstanding for group in self.groups.values()), default=0) + len(self._homeless)

    @property
    def workers(self) -> int:
        """Workers alive, of all groups."""
        return len(self._group_of)

    def submit(self, job_id: Hashable, payload: bytes, group: str = "", later: bool = False) -> list[Ended]:
        """Line up one job, for one group or for all. Returns what ends by that."""
        if not group:
            self._newest = (job_id, payload)
        names = [group] if group else [name for name, members in self.groups.items() if members.workers]
        if not names:
            self._homeless.append((job_id, payload, later))
            return self._bounded()
        owed = self._owed.setdefault(job_id, Owed(payload, set(), only=bool(group)))
        ended = []
        for name in names:
            if name not in owed.groups:
                owed.groups.add(name)
                for job in self._group(name).submit(job_id, payload, later):
                    ended += self._over(name, job, "", SKIPPED)
        return ended

    def worker_up(self, name: str, group: str) -> None:
        """A worker of a group has joined, or come back."""
        self._group_of[name] = group
        new = group not in self.groups
        self._group(group).worker_up(name)
        self._empty_since_s.pop(group, None)
        while self._homeless:
            job_id, payload, later = self._homeless.popleft()
            self.submit(job_id, payload, later=later)
        if new and self._newest is not None:
            self.submit(*self._newest, group)

    def worker_down(self, name: str, now_s: float) -> list[Ended]:
        """A worker is gone."""
        group = self._group_of.pop(name, None)
        if group is None:
            return []
        ended = [
            e for job in self.groups[group].worker_down(name) for e in self._over(group, job, name, "its workers died")
        ]
        if not self.groups[group].workers:
            self._empty_since_s[group] = now_s
        return ended

    def assign(self, now_s: float) -> tuple[list[tuple[str, Job]], list[Ended]]:
        """Who is to start what now, and what ends because a group has been left by its workers."""
        ended = self._abandon(now_s)
        return [pair for group in self.groups.values() for pair in group.assign(now_s)], ended

    def finished(self, name: str, job_id: Hashable, now_s: float) -> list[Ended]:
        """A worker has done a job."""
        group = self._group_of.get(name)
        job = self.groups[group].finished(name, job_id, now_s) if group is not None else None
        return self._over(group, job, name, "") if group is not None and job is not None else []

    def failed(self, name: str, job_id: Hashable, reason: str, now_s: float) -> list[Ended]:
        """A worker has not done a job."""
        group = self._group_of.get(name)
        job = self.groups[group].failed(name, job_id, reason, now_s) if group is not None else None
        return self._over(group, job, name, reason) if group is not None and job is not None else []

    def next_time_s(self, now_s: float) -> float | None:
        """When to look again although nothing has happened."""
        times = [time_s for group in self.groups.values() if (time_s := group.next_time_s(now_s)) is not None]
        if self.workers:
            times += [since_s + ABANDONED_S for since_s in self._empty_since_s.values()]
        return min(times, default=None)

    def _group(self, name: str) -> Dispatcher:
        return self.groups.setdefault(name, Dispatcher(self._credits, self._limit))

    def _bounded(self) -> list[Ended]:
        ended = []
        while self._limit and len(self._homeless) > self._limit:
            ended.append(Ended(self._homeless.popleft()[0], "", 0, SKIPPED))
        return ended

    def _over(self, group: str, job: Job, worker: str, error: str) -> list[Ended]:
        """One group has ended a job; the job ends with its last group."""
        owed = self._owed.get(job.id)
        if owed is None or group not in owed.groups:
            return []
        owed.groups.remove(group)
        owed.done |= not error
        if owed.groups:
            return []
        del self._owed[job.id]
        return [Ended(job.id, worker, job.attempts, "" if owed.done else error)]

    def _abandon(self, now_s: float) -> list[Ended]:
        """Groups that nobody works for any more: their jobs end, or go to the others when nobody has done them."""
        ended: list[Ended] = []
        left = [name for name, since_s in self._empty_since_s.items() if now_s - since_s >= ABANDONED_S]
        for name in left if self.workers else []:
            del self._empty_since_s[name]
            group = self.groups.pop(name)
            for job in [*group.line, *group.later]:
                owed = self._owed[job.id]
                homeless = not owed.only and not owed.done and owed.groups == {name}
                over = self._over(name, job, "", NO_WORKER)
                ended += self.submit(job.id, job.payload, later=job.later) if homeless else over
        return ended


class JobPool:
    """Dispatches the jobs of one topic over a bus. `on_ended` comes on a foreign thread, once per job.

    With `limit`, at most so many jobs wait and the oldest is skipped for a newer one; 0 = none is skipped.
    """

    def __init__(
        self,
        bus: Bus,
        topic: Topic,
        clock_s: Callable[[], float],
        on_ended: Callable[[Ended], None],
        *,
        limit: int = 0,
        timeout_s: float = DEFAULT_TIMEOUT_S,
    ) -> None:
        self._bus, self._topic, self._clock_s, self._on_ended = bus, topic, clock_s, on_ended
        self._timeout_s = timeout_s
        self._board = Board(limit=limit)
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
            ended = self._board.submit(job_id, payload, group, later)
        self._tell(ended)
        self._send()

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
            key = worker_keys(self._topic, name)[0]
            self._bus.call(key, job.payload, self._timeout_s, partial(self._answered, name, job))

    def _answered(self, name: str, job: Job, answer: Answer) -> None:
        with self._lock:
            if answer.payload is not None:
                ended = self._board.finished(name, job.id, self._clock_s())
            else:
                ended = self._board.failed(name, job.id, answer.reason, self._clock_s())
        if answer.payload is None and answer.reason != "busy":
            log.warning("job not done", extra={"worker": name, "job": str(job.id), "reason": answer.reason})
        self._tell(ended)
        self._send()

    def _tell(self, ended: list[Ended]) -> None:
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

"""Who gets which job: within one group of workers, who do the same work (pure; time is an argument).

A worker has a few credits. A job goes to the worker that should finish it first, by the pace it has shown, so a slow
worker gets less. A worker that disappears, answers nothing or fails loses the job, which goes to the front of the line.
One that takes several times longer than its own pace is suspected to hang: its jobs are given to others as well, once,
and it gets nothing new until it answers. Results are idempotent, so a job done twice costs time and nothing else.
"""

import statistics
from collections import deque
from collections.abc import Hashable
from dataclasses import dataclass, field
from typing import NamedTuple

CREDITS = 3  # the one under way, the next one, which the worker may prepare meanwhile, and one on its way
MAX_ATTEMPTS = 4
BUSY_RETRY_S = 0.05
QUARANTINE_S = 1.0
NO_RESULT = "it gave no result"
MAX_QUARANTINE_S = 30.0
PACE_SHARE = 0.3  # of the newest job in a worker's pace
OVERDUE_FACTOR = 3.0  # times its pace after which a worker is suspected to hang
OVERDUE_LEAST_S = 0.7  # but not before
UNKNOWN_PACE_S = 2.0  # of a worker that has finished nothing, when no other has either


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
        elif reason in ("timeout", NO_RESULT):
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

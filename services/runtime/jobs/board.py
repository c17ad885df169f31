"""What a pool still owes: a job is over when every group of workers is through with it (pure; time is an argument)."""

from collections import deque
from collections.abc import Hashable
from dataclasses import dataclass
from typing import NamedTuple

from prior_sg.services.runtime.jobs.dispatcher import CREDITS, Dispatcher, Job

ABANDONED_S = 10.0  # a group without workers for this long leaves its jobs to the other groups
SKIPPED = "skipped for a newer one"
NO_WORKER = "no worker serves it any more"


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
    def waiting(self) -> set[Hashable]:
        """Jobs that some group has still to begin, those for later left out."""
        lined = {job.id for group in self.groups.values() for job in group.line}
        return lined | {job_id for job_id, _, later in self._homeless if not later}

    @property
    def running(self) -> int:
        """Jobs that workers have now, once for each group."""
        return sum(len(worker.running) for group in self.groups.values() for worker in group.workers.values())

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

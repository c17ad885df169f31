"""What is wrong with a running system and how to mend it, from what its processes say of themselves and each other."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import chain
from typing import Any, NamedTuple

import msgspec

from prior_sg.schemas.status import ServiceStatus, StatusRequest
from prior_sg.services.runtime.bus import BusError
from prior_sg.services.runtime.client import BusClient, OnTheRoll
from prior_sg.services.runtime.host.lease import Standing

LONG_STEP_S = 30.0
LONG_WAIT_S = 10.0  # of an input
LEAST_FREE_B = 200e6  # a database, logs and a recording of some minutes


class Remark(NamedTuple):
    """A sentence; a fault calls for somebody. `alarm` names the alert of deploy/prometheus/alerts.yml about it."""

    text: str
    fault: bool
    alarm: str = ""


@dataclass
class Found:
    """What there is: statuses of those that answered, why others did not, who is in charge, or why that is unknown.

    `before` are statuses of a moment earlier, by instance. Of one host's processes alone, `standings` are left out.
    """

    processes: list[ServiceStatus] = field(default_factory=list)
    silent: list[dict[str, str]] = field(default_factory=list)
    standings: list[Standing] = field(default_factory=list)
    unknown: str = ""
    before: dict[str, ServiceStatus] = field(default_factory=dict)
    resting: list[str] = field(default_factory=list)  # instances here that wait for another's end, as they should

    @property
    def remarks(self) -> list[Remark]:
        """Faults and what else should be known."""
        unknown = [Remark(f"who is in charge and who ought to be there: {self.unknown}", True)] if self.unknown else []
        return [*unknown, *chain.from_iterable(look(self) for look in LOOKS)]

    @property
    def well(self) -> bool:
        """Whether something runs and nothing is wrong."""
        return (
            bool(self.processes or self.resting)
            and not self.silent
            and not any(remark.fault for remark in self.remarks)
        )

    def plain(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "processes": msgspec.to_builtins(self.processes),
            "silent": self.silent,
            "resting": self.resting,
            "in_charge": [
                {"robot": one.robot, "service": one.service, "instance": one.instance, "epoch": one.holder.epoch}
                for one in self.standings
                if one.holder is not None
            ],
            "remarks": [{"text": one.text, "fault": one.fault, "alarm": one.alarm} for one in self.remarks],
        }

    def holders(self) -> dict[tuple[str, str], set[Any]]:
        """Who is in charge, by robot and service."""
        holders: dict[tuple[str, str], set[Any]] = {}
        for one in self.standings:
            if one.holder is not None:
                holders.setdefault((one.robot, one.service), set()).add(one.holder)
        return holders


def look(client: BusClient, again_s: float = 0.0) -> Found:
    """Ask everybody; with `again_s` twice, so long apart, to see what rises."""
    before, _ = client.statuses() if again_s else ([], {})
    time.sleep(again_s)
    return asked(client, StatusRequest(), {one.instance: one for one in before})


def asked(client: BusClient, request: StatusRequest, before: dict[str, ServiceStatus] | None = None) -> Found:
    """Ask everybody once."""
    found, alive = Found(before=before or {}), client.alive()
    _ask_all(client, alive, found, request)
    try:
        found.standings, on_the_roll = client.standings(), client.on_the_roll()
    except BusError as error:
        found.unknown = str(error)
        return found
    waiting = {one.instance for one in found.standings if one.holder is None}
    for one in on_the_roll:
        if one.instance not in alive and one.instance not in waiting:
            found.silent.append({"service": one.service, "instance": one.instance, "error": _unheard(one)})
    return found


def look_here(client: BusClient, pids: dict[str, int]) -> Found:
    """Ask the processes of this host, by instance."""
    alive = client.alive()
    found = Found()
    _ask_all(client, {name: service for name, service in alive.items() if name in pids}, found)
    try:
        waiting = {one.instance for one in client.standings() if one.holder is None}
    except BusError as error:
        found.unknown = str(error)
        return found
    for name, pid in pids.items():
        if name in waiting:
            found.resting.append(name)
        elif name not in alive:
            why = f"{name} (pid {pid}) runs here and is not heard: it is starting, hangs or was stopped"
            found.silent.append({"service": "", "instance": name, "error": why})
    return found


def _ask_all(client: BusClient, alive: dict[str, str], found: Found, request: StatusRequest = StatusRequest()) -> None:
    found.processes, errors = client.statuses(request, among=alive)
    found.silent = [
        {"service": alive[instance], "instance": instance, "error": f"{instance}: {error}"}
        for instance, error in errors.items()
    ]


def _unheard(one: OnTheRoll) -> str:
    return (
        f"{one.instance} (pid {one.pid}) exists on its host and is not heard: `kill -CONT {one.pid}` there if it was "
        f"stopped, or `kill -9 {one.pid}`, and `prior-sg up` starts it again"
    )


def _hanging(found: Found) -> Iterator[Remark]:
    for one in found.processes:
        if one.step_compiling_s > LONG_STEP_S:
            yield Remark(
                f"{one.instance} has compiled inner loops for {one.step_compiling_s:.0f} s, as a first run does, and "
                f"{one.backlog} inputs wait: it goes on by itself; `prior-sg warm` compiles them ahead of time",
                False,
            )
        if (step_s := one.step_s - one.step_compiling_s) > LONG_STEP_S:
            yield Remark(
                f"{one.instance} (pid {one.pid}) has been at one input for {step_s:.0f} s, {one.backlog} wait: if "
                f"that goes on, `kill -9 {one.pid}` there, and `prior-sg up` starts it again",
                True,
                "PriorSgStepHangs",
            )


def _behind(found: Found) -> Iterator[Remark]:
    for one in found.processes:
        if one.oldest_wait_s > LONG_WAIT_S and one.step_s <= LONG_STEP_S:
            yield Remark(
                f"{one.instance} is behind: {one.backlog} inputs wait, the oldest for {one.oldest_wait_s:.0f} s, and "
                f"it is busy {one.busy_share:.0%} of the time: give it a faster core, or a slower stream "
                "(`--speed 0.5`, `--set ingest.min_translation_m=0.4`)",
                True,
                "PriorSgBehind",
            )


def _without_workers(found: Found) -> Iterator[Remark]:
    for one in found.processes:
        for pool in one.pools:
            if pool.waiting and not sum(pool.workers.values()):
                yield Remark(
                    f"{pool.waiting} keyframes of {one.robot} wait for a worker, the oldest for "
                    f"{pool.oldest_wait_s:.0f} s, and none is there: `prior-sg up feature_pyramid --no-router`",
                    True,
                    "PriorSgNoWorkers",
                )
            elif pool.waiting and pool.oldest_wait_s > LONG_WAIT_S:
                yield Remark(
                    f"{pool.waiting} keyframes of {one.robot} wait for {sum(pool.workers.values())} workers, the "
                    f"oldest for {pool.oldest_wait_s:.0f} s: start another, `prior-sg up feature_pyramid --no-router`",
                    True,
                    "PriorSgJobsWait",
                )


def _losing(found: Found) -> Iterator[Remark]:
    """What has been lost since the earlier look."""
    for one in found.processes:
        earlier = found.before.get(one.instance)
        if earlier is None:
            continue
        counts, losses = (
            {count.topic: count for count in earlier.topics},
            {(o.what, o.reason): o for o in earlier.losses},
        )
        for count in one.topics:
            known = counts.get(count.topic)
            for what in ("malformed", "missed"):
                if (rise := getattr(count, what) - (getattr(known, what) if known else 0)) > 0:
                    yield Remark(_loses(one, f"{count.topic} {what}", rise, MEND[what]), True, "PriorSgMessagesLost")
        for loss in one.losses:
            before = losses.get((loss.what, loss.reason))
            if (rise := loss.count - (before.count if before else 0)) > 0:
                text = _loses(one, f"{loss.what} ({loss.reason})", rise, "`prior-sg check SOURCE` says what is wrong")
                yield Remark(text, True, "PriorSgLosses")


MEND = {
    "malformed": "its log names the writer: end it, or give it this release",
    "missed": "the link or this process is too slow; the snapshot that follows makes good for deltas",
}


def _loses(one: ServiceStatus, what: str, rise: int, mend: str) -> str:
    return f"{one.instance} loses what it gets now: {rise} more {what}; {mend}"


def _full(found: Found) -> Iterator[Remark]:
    for one in found.processes:
        free_b = one.figures.get("disk_free_bytes")
        if free_b is not None and free_b < LEAST_FREE_B:
            yield Remark(
                f"{one.instance} (pid {one.pid}) has {free_b / 1e6:.0f} MB left for its database: free some, or "
                "`--set scene_store.history=last`, or another disk, `--set scene_store.path=FILE`",
                True,
                "PriorSgDiskFull",
            )


def _waiting(found: Found) -> Iterator[Remark]:
    holders = found.holders()
    for one in found.standings:
        if one.holder is not None:
            continue
        if (key := (one.robot, one.service)) in holders:
            holder = min(holders[key]).instance
            yield Remark(f"{one.instance} waits: {holder} is in charge of {one.service} of {one.robot}", False)
        else:
            yield Remark(
                f"nobody is in charge of {one.service} of {one.robot}: {one.instance} takes over within seconds",
                True,
                "PriorSgNobodyInCharge",
            )


def _contested(found: Found) -> Iterator[Remark]:
    for (robot, service), several in found.holders().items():
        if len(several) > 1:
            yield Remark(
                f"{' and '.join(holder.instance for holder in sorted(several))} are in charge of {service} of {robot}: "
                "the last has the highest epoch, the others stop themselves within seconds; if they do not, end them",
                True,
                "PriorSgTwoInCharge",
            )


LOOKS: tuple[Callable[[Found], Iterator[Remark]], ...] = (
    _hanging,
    _behind,
    _without_workers,
    _losing,
    _full,
    _waiting,
    _contested,
)

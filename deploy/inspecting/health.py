"""What is wrong with a running system and how to mend it, from what its processes say of themselves and each other."""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import msgspec

from prior_sg.schemas.status import ServiceStatus
from prior_sg.services.runtime.bus import BusError
from prior_sg.services.runtime.client import BusClient, OnTheRoll
from prior_sg.services.runtime.host.lease import Standing

LONG_STEP_S = 30.0


class Remark(NamedTuple):
    """A sentence; a fault calls for somebody."""

    text: str
    fault: bool


@dataclass
class Found:
    """What there is: statuses of those that answered, why others did not, who is in charge, or why that is unknown.

    Of the processes of one host alone, `standings` are left out.
    """

    processes: list[ServiceStatus] = field(default_factory=list)
    silent: list[dict[str, str]] = field(default_factory=list)
    standings: list[Standing] = field(default_factory=list)
    unknown: str = ""
    resting: list[str] = field(default_factory=list)  # instances here that wait for another's end, as they should

    @property
    def remarks(self) -> list[Remark]:
        """Faults and what else should be known."""
        unknown = [Remark(f"who is in charge and who ought to be there: {self.unknown}", True)] if self.unknown else []
        return [*unknown, *self._hanging(), *self._waiting(), *self._contested()]

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
            "remarks": [remark._asdict() for remark in self.remarks],
        }

    def _hanging(self) -> list[Remark]:
        return [
            Remark(
                f"{one.instance} (pid {one.pid}) has been at one input for {one.step_s:.0f} s, {one.backlog} wait: if "
                f"that goes on, `kill -9 {one.pid}` there, and `prior-sg up` starts it again",
                True,
            )
            for one in self.processes
            if one.step_s > LONG_STEP_S
        ]

    def _waiting(self) -> list[Remark]:
        holders = self._holders()
        return [
            Remark(
                f"{one.instance} waits: {min(holders[key]).instance} is in charge of {one.service} of {one.robot}"
                if (key := (one.robot, one.service)) in holders
                else f"nobody is in charge of {one.service} of {one.robot}: {one.instance} takes over within seconds",
                key not in holders,
            )
            for one in self.standings
            if one.holder is None
        ]

    def _contested(self) -> list[Remark]:
        return [
            Remark(
                f"{' and '.join(holder.instance for holder in sorted(several))} are in charge of {service} of {robot}: "
                "the last has the highest epoch, the others stop themselves within seconds; if they do not, end them",
                True,
            )
            for (robot, service), several in self._holders().items()
            if len(several) > 1
        ]

    def _holders(self) -> dict[tuple[str, str], set[Any]]:
        holders: dict[tuple[str, str], set[Any]] = {}
        for one in self.standings:
            if one.holder is not None:
                holders.setdefault((one.robot, one.service), set()).add(one.holder)
        return holders


def look(client: BusClient) -> Found:
    """Ask everybody."""
    found, alive = Found(), client.alive()
    _ask_all(client, alive, found)
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


def _ask_all(client: BusClient, alive: dict[str, str], found: Found) -> None:
    for instance, service in sorted(alive.items()):
        try:
            found.processes.append(client.status(service, instance))
        except BusError as error:
            found.silent.append({"service": service, "instance": instance, "error": f"{instance}: {error}"})


def _unheard(one: OnTheRoll) -> str:
    return (
        f"{one.instance} (pid {one.pid}) exists on its host and is not heard: `kill -CONT {one.pid}` there if it was "
        f"stopped, or `kill -9 {one.pid}`, and `prior-sg up` starts it again"
    )

"""What follows from what was seen of a host and of a bus (pure)."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from prior_sg.deploy.inspecting.health import LEAST_FREE_B, Found
from prior_sg.deploy.limits import FILES_WANTED, fault_of_files
from prior_sg.schemas.migrations import tells_of_versions
from prior_sg.schemas.status import ServiceStatus
from prior_sg.services.refusals import CLOCK_SET_NS

CLOCK_LIMIT_S = 2.0  # by which clocks may differ, beyond what asking takes
UPDATE = "pip install --upgrade prior-sg"
SET_CLOCK = "timedatectl set-ntp true"
START = "prior-sg up"


class Finding(NamedTuple):
    """One thing that is wrong, and the command that mends it."""

    topic: str
    text: str
    mend: str

    def line(self) -> str:
        """All of it, the command once."""
        said = f"{self.topic}: {self.text.rstrip('.')}"
        return said if self.mend in said else f"{said}; `{self.mend}`"


class Keys(NamedTuple):
    """Whose bundle is used, and whether its owner takes part, is revoked or expired."""

    name: str
    role: str
    until: str  # a day of UTC, as 2027-01-31
    state: str


class Folder(NamedTuple):
    """Where something is to be written; `free_b` is of its disk."""

    purpose: str
    path: str
    writable: bool
    free_b: float
    mend: str


class Cache(NamedTuple):
    """What is kept to be made only once, the folders that are tried for it, and what names another."""

    what: str
    folders: tuple[str, ...]
    writable: bool
    variable: str


@dataclass(frozen=True)
class Here:
    """Of this host. `told` is what its own checks said."""

    told: Sequence[Finding] = ()
    clock_ns: int = CLOCK_SET_NS
    keys: Keys | None = None
    folders: Sequence[Folder] = ()
    caches: Sequence[Cache] = ()
    files_allowed: int = FILES_WANTED


@dataclass(frozen=True)
class OnTheBus:
    """Of everybody heard, between two moments of this host's clock. `told` is why nobody is."""

    told: Sequence[Finding] = ()
    found: Found = field(default_factory=Found)
    from_ns: int = 0
    to_ns: int = 0
    release: str = ""  # of this program


def findings(here: Here, bus: OnTheBus) -> list[Finding]:
    """All that is wrong; what keeps others from working first."""
    return [
        *here.told,
        *_of_files(here),
        *_of_keys(here),
        *_of_folders(here),
        *_of_caches(here),
        *_of_own_clock(here),
        *bus.told,
        *_of_silent(bus),
        *(one for status in bus.found.processes for one in _of_process(status, bus)),
        *(Finding("services", remark.text, START) for remark in bus.found.remarks if remark.fault),
    ]


def _of_files(here: Here) -> Iterator[Finding]:
    if fault := fault_of_files(here.files_allowed):
        yield Finding("open files", fault, f"sudo prlimit --pid $$ --nofile={FILES_WANTED}")


def _of_keys(here: Here) -> Iterator[Finding]:
    if here.keys is None or here.keys.state == "takes part":
        return
    name, role, until, state = here.keys
    text = f"the keys of {name} are {state}" + (f" since {until}" if state == "expired" else "")
    command = f"prior-sg keys add {role} {name}" if state == "revoked" else f"prior-sg keys rotate {name}"
    yield Finding("keys", f"{text}; run `{command}` where the authority is, and copy the bundle here", command)


def _of_folders(here: Here) -> Iterator[Finding]:
    for folder in here.folders:
        if not folder.writable:
            yield Finding("disk", f"{folder.path}, where {folder.purpose} go, cannot be written", folder.mend)
        elif folder.free_b < LEAST_FREE_B:
            text = f"only {folder.free_b / 1e6:.0f} MB are free in {folder.path}, where {folder.purpose} go"
            yield Finding("disk", f"{text}; free some, or take another folder", folder.mend)


def _of_caches(here: Here) -> Iterator[Finding]:
    for cache in here.caches:
        if not cache.writable:
            text = f"{cache.what} cannot be kept in {' or '.join(cache.folders)}, so that every start takes longer"
            yield Finding("cache", f"{text}; name a folder that can be written", f"export {cache.variable}=FOLDER")


def _of_own_clock(here: Here) -> Iterator[Finding]:
    if here.clock_ns < CLOCK_SET_NS:
        yield Finding("clock", "the clock of this host was never set, so that certificates and tasks fail", SET_CLOCK)


def _of_silent(bus: OnTheBus) -> Iterator[Finding]:
    for entry in bus.found.silent:
        if tells_of_versions(entry["error"]):
            yield Finding("versions", entry["error"], UPDATE)
        else:
            yield Finding("services", entry["error"], START)


def _of_process(status: ServiceStatus, bus: OnTheBus) -> Iterator[Finding]:
    who = f"{status.instance} (pid {status.pid})"
    off_s = clock_off_s(status.clock_ns, bus.from_ns, bus.to_ns)
    if abs(off_s) > CLOCK_LIMIT_S:
        ahead = f"{abs(off_s):.0f} s {'ahead of' if off_s > 0 else 'behind'}"
        yield Finding("clock", f"the clock where {who} runs is {ahead} this host's; set the wrong one", SET_CLOCK)
    if bus.release and status.release != bus.release:
        theirs = f"prior-sg {status.release}" if status.release else "an older prior-sg, before releases were told"
        yield Finding("versions", f"{who} runs {theirs}, this is {bus.release}; update one and start it again", UPDATE)
    for topic in status.topics:
        if topic.malformed:
            text = f"{who} could not read {topic.malformed} of {topic.topic}: of another version, or damaged; its log"
            yield Finding("messages", f"{text} says why", f"grep malformed LOGS/{status.service}*.log")


def clock_off_s(told_ns: int, from_ns: int, to_ns: int) -> float:
    """How far a clock that told its time between two moments of ours is ahead at least; 0 where it told none."""
    if not told_ns or from_ns <= told_ns <= to_ns:
        return 0.0
    return (told_ns - (to_ns if told_ns > to_ns else from_ns)) / 1e9

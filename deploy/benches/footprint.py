"""What `prior-sg run` needs: memory of each of its processes, and how soon its first region is there.

The command itself runs as a user starts it, in a process of its own, and is watched from outside: processes by what the
kernel says of them, messages by a client of its router. Resident memory counts the pages of a library in each process
that maps them; the proportional share divides them among those, so that its sum is what the machine gives. How many
pages of a file one use of it maps depends on how the file came into the machine's memory: a kernel that keeps it in
pieces of 1 MB, as pip wrote it, maps whole pieces. A process's own memory, which no file holds, does not depend on it.
"""

import contextlib
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import psutil

from prior_sg.deploy.running.supervisor import Supervisor
from prior_sg.deploy.settings import DEFAULT_ROBOT, DEMO_ENVIRONMENT, DEMO_TASK
from prior_sg.schemas.topics import (
    INGEST_STATE,
    KEYFRAME,
    PLACE_DELTA,
    PRIOR,
    PYRAMID,
    REGION_DELTA,
    SCENE_REVISION,
    Topic,
)
from prior_sg.services.roles import NAMES
from prior_sg.services.runtime.bus import BusError, Sample, message_in
from prior_sg.services.runtime.client import BusClient
from prior_sg.services.runtime.endpoints import free_endpoint
from prior_sg.services.runtime.zenoh_bus import ZenohBus
from prior_sg.services.runtime.zenoh_router import open_free_router

COMMAND = "command"  # the process of the command, with the router and the recorder
TOTAL = "total"
SERVE = "prior_sg.deploy.running.serve"
LOOK_S = 0.2
IDLE_S = 2.0
TIMEOUT_S = 600.0
MILESTONES: dict[str, Topic] = {
    "prior": PRIOR,
    "keyframe": KEYFRAME,
    "places": PLACE_DELTA,
    "pyramid": PYRAMID,
    "region": REGION_DELTA,
    "stored": SCENE_REVISION,
}


class Memory(NamedTuple):
    """Of one process: resident, with pages of several processes divided among them, and what no file holds."""

    mb: float
    share_mb: float
    own_mb: float


Look = dict[str, Memory]  # by service, and `command`


class Seen:
    """When each milestone was first sent, in seconds of the wall clock, and whether the source has ended."""

    def __init__(self) -> None:
        self.first_s: dict[str, float] = {}
        self.finished = threading.Event()
        self._names = {topic.name: name for name, topic in MILESTONES.items()}

    def __call__(self, sample: Sample) -> None:
        """See one message."""
        if sample.topic == INGEST_STATE:
            if message_in(sample).finished:
                self.finished.set()
            return
        name = self._names[sample.topic.name]
        if sample.topic == REGION_DELTA and not message_in(sample).regions:
            return
        self.first_s[name] = min(sample.sent_ns / 1e9, self.first_s.get(name, float("inf")))


def memory_bench(source: Path) -> tuple[dict, dict]:
    """Megabytes of each process and of all: at start, when the source has ended, and at most.

    At start = when all services stand and have been given nothing. Of ingest also once it has opened its source: as it
    was last before its first keyframe.
    """
    start = standing()
    looks: list[tuple[float, Look]] = []
    with _running(source) as (process, seen, began_s):
        while process.poll() is None:
            looks.append((time.time(), look(psutil.Process(process.pid))))
            if time.time() - began_s > TIMEOUT_S:
                raise RuntimeError(f"the run did not end within {TIMEOUT_S:.0f} s")
            time.sleep(LOOK_S)
        opened = [found["ingest"] for at_s, found in looks if "ingest" in found and at_s < seen.first_s["keyframe"]]
        figures = summed(start, [found for _, found in looks]) | _figures("ingest", "opened", opened[-1:])
        return figures | _times(seen, began_s), {"source": source.name}


def summed(start: Look, looks: list[Look]) -> dict[str, float]:
    """Figures of a run: `{service}_{start|end|most}_mb`, with shared pages divided `…_share_mb`, and `…_own_mb` without
    those of files; the same of all together. The end is the last look at which all were there; each kind of memory is
    at most what it was at any.
    """
    whole = [found for found in looks if set(found) >= {*NAMES, COMMAND}]
    if not whole:
        raise RuntimeError("the services never stood together")
    figures: dict[str, float] = {}
    for name in (*NAMES, COMMAND):
        if name in start:
            figures |= _figures(name, "start", [start[name]])
        figures |= _figures(name, "end", [whole[-1][name]]) | _figures(name, "most", [found[name] for found in whole])
    sums = [Memory(*map(sum, zip(*found.values(), strict=True))) for found in whole]
    return figures | _figures(TOTAL, "end", sums[-1:]) | _figures(TOTAL, "most", sums)


def _figures(name: str, when: str, looks: list[Memory]) -> dict[str, float]:
    """Each kind of memory at most; none without a look."""
    found = zip(*looks, strict=True)
    return {f"{name}_{when}_{kind}": max(of) for kind, of in zip(Memory._fields, found, strict=False)}


def standing() -> Look:
    """Every service under a supervisor, after some idle time; ingest without a source."""
    with contextlib.ExitStack() as ending:
        folder = Path(ending.enter_context(tempfile.TemporaryDirectory()))
        endpoint, stop_router = open_free_router("tcp/127.0.0.1:0")
        ending.callback(stop_router)
        supervisor = Supervisor(
            endpoint, DEFAULT_ROBOT, folder / "logs", [f"scene_store.path={folder / 'scene.sqlite'}"]
        )
        ending.callback(supervisor.stop)
        client = ending.enter_context(BusClient(ZenohBus(endpoint)))
        for name in NAMES:
            supervisor.start(name)
        end_s = time.monotonic() + TIMEOUT_S
        while set(client.alive().values()) < set(NAMES):
            supervisor.check()
            if time.monotonic() > end_s:
                raise RuntimeError(f"not all services stood within {TIMEOUT_S:.0f} s")
            time.sleep(LOOK_S)
        time.sleep(IDLE_S)
        found = look(psutil.Process())
        del found[COMMAND]  # this process, which measures
        return found


def start_bench(source: Path) -> tuple[dict, dict]:
    """Seconds from the command until the first of each kind of message, and of processors until the region, which other
    work on the machine changes less; then the run is interrupted.
    """
    with _running(source) as (process, seen, began_s):
        while "region" not in seen.first_s:
            if process.poll() is not None or time.time() - began_s > TIMEOUT_S:
                raise RuntimeError(f"no region came within {time.time() - began_s:.0f} s")
            time.sleep(LOOK_S)
        worked_s = _worked_s(psutil.Process(process.pid))
        return _times(seen, began_s) | {"processor_s": worked_s}, {"source": source.name}


def _worked_s(command: psutil.Process) -> float:
    """Processor time so far of the command and all below it."""
    worked_s = 0.0
    for process in (command, *command.children(recursive=True)):
        with contextlib.suppress(psutil.Error):
            times = process.cpu_times()
            worked_s += times.user + times.system
    return worked_s


def _times(seen: Seen, began_s: float) -> dict[str, float]:
    return {f"{name}_s": seen.first_s[name] - began_s for name in MILESTONES if name in seen.first_s}


@contextlib.contextmanager
def _running(source: Path) -> Iterator[tuple[subprocess.Popen, Seen, float]]:
    """The command, what is seen of its messages, and when it was started."""
    folder = Path(tempfile.mkdtemp(prefix="prior-sg-bench-"))
    endpoint, seen, began_s = free_endpoint("tcp/127.0.0.1:0"), Seen(), time.time()
    command = [sys.executable, "-P", "-m", "prior_sg.deploy.cli.main", "run", str(source), "--connect", endpoint]
    command += ["--environment", DEMO_ENVIRONMENT, "--task", DEMO_TASK, "--out", str(folder)]
    with contextlib.ExitStack() as ending:
        ending.callback(shutil.rmtree, folder, ignore_errors=True)
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        ending.callback(_end, process)
        client = ending.enter_context(BusClient(_bus(endpoint, process)))
        for topic in (*MILESTONES.values(), INGEST_STATE):
            client.listen(topic, "*" if topic == PRIOR else DEFAULT_ROBOT, seen)
        yield process, seen, began_s


def _bus(endpoint: str, process: subprocess.Popen) -> ZenohBus:
    """Of the command's router, as soon as that listens."""
    while True:
        try:
            return ZenohBus(endpoint)
        except BusError:
            if process.poll() is not None:
                raise
            time.sleep(LOOK_S / 4)


def _end(process: subprocess.Popen) -> None:
    for _ in range(2):  # the second time without writing what there is
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
            time.sleep(LOOK_S)
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(20.0)
    if process.poll() is None:
        process.kill()


def look(command: psutil.Process) -> Look:
    """The command and the services below it, as they are now; workers together."""
    found: Look = {}
    for process in (command, *command.children(recursive=True)):
        with contextlib.suppress(psutil.Error, OSError):
            name = COMMAND if process == command else _service(process.cmdline())
            if name:
                before = found.get(name, Memory(0.0, 0.0, 0.0))
                found[name] = Memory(*map(sum, zip(before, memory_of(process.pid), strict=True)))
    return found


def memory_of(pid: int) -> Memory:
    """Memory of a process as Linux tells it. Raises OSError where the process is gone."""
    lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()[1:]
    kilobytes = {name: int(amount.split()[0]) for name, _, amount in (line.partition(":") for line in lines)}
    return Memory(*(kilobytes[name] * 1024 / 1e6 for name in ("Rss", "Pss", "Anonymous")))


def _service(arguments: list[str]) -> str:
    """The service that a process runs; empty where it is none."""
    return arguments[arguments.index(SERVE) + 1] if SERVE in arguments[:-1] else ""

"""`prior-sg bench fleet`: 2 to 20 light robots on the real bus, one store and one bridge, until something is full.

The robots are writers of deltas: two walks through one generated home, each in a frame of its own, are made once and
told by every second robot under a name of its own. What a robot's own services would take is not in the figures, nor
pyramids and keyframes. Router, store and bridge (`prior-sg fleet`) are processes of their own.
"""

import contextlib
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import psutil

from prior_sg.deploy.evaluation.partial_walks import Part, Walks
from prior_sg.schemas.codec import Message
from prior_sg.schemas.scene import SceneRevision
from prior_sg.schemas.topics import OBJECT_DELTA, PLACE_DELTA, REGION_DELTA, SCENE_REVISION, Topic
from prior_sg.services.runtime.bus import BusError, Sample, message_in
from prior_sg.services.runtime.client import BusClient
from prior_sg.services.runtime.endpoints import free_endpoint
from prior_sg.services.runtime.zenoh_bus import ZenohBus

SIZES = (2, 5, 10, 20)
SEED = 60  # of the home
PARTS = (Part(0.0, 0.6, 1), Part(0.4, 1.0, 2))
RATE_HZ = 1.0  # keyframes of each robot
SECONDS = 25.0
START_S = 120.0
SETTLE_S = 5.0  # for what still comes after the last keyframe
NAME = "merged"
DELTAS = (PLACE_DELTA, REGION_DELTA, OBJECT_DELTA)
Step = list[tuple[Topic, Message]]


@dataclass
class Ledger:
    """What was sent and what came of it; filled by threads of the bus."""

    sent_s: dict[str, list[float]] = field(default_factory=dict)  # by robot, of each delta in order
    stored: dict[str, int] = field(default_factory=dict)  # deltas of each robot that are durable
    stored_ms: list[float] = field(default_factory=list)
    bus_ms: list[float] = field(default_factory=list)
    robots_bytes: int = 0
    merged_bytes: int = 0
    merged: int = 0  # deltas of the merged map
    lock: threading.Lock = field(default_factory=threading.Lock)

    def saw(self, sample: Sample) -> None:
        """A delta came to a reader such as a page."""
        delta: Any = message_in(sample)
        with self.lock:
            if delta.robot == NAME:
                self.merged += 1
                self.merged_bytes += len(sample.payload)
            else:
                self.robots_bytes += len(sample.payload)
                self.bus_ms.append((time.time_ns() - sample.sent_ns) / 1e6)

    def durable(self, sample: Sample) -> None:
        """The store has made deltas durable: one for each revision."""
        told: SceneRevision = message_in(sample)
        now_s = time.monotonic()
        with self.lock:
            sent_s = self.sent_s.get(told.robot, [])
            before = self.stored.get(told.robot, 0)
            self.stored[told.robot] = max(before, min(told.revision + 1, len(sent_s)))
            self.stored_ms += [1e3 * (now_s - one) for one in sent_s[before : self.stored[told.robot]]]


def fleet_bench(sizes: Sequence[int] = SIZES, seconds: float = SECONDS) -> tuple[dict[str, Any], dict[str, Any]]:
    """Figures by number of robots."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        walks = recorded(folder)
        metrics = {str(robots): fleet_of(robots, walks, seconds, folder / str(robots)) for robots in sizes}
    settings = {"home": SEED, "rate_hz": RATE_HZ, "seconds": seconds, "steps": [len(walk) for walk in walks]}
    return metrics, settings


def recorded(folder: Path) -> list[list[Step]]:
    """What two robots tell, keyframe by keyframe."""
    walks = Walks(folder)
    found = []
    for part in PARTS:
        robot = walks.robot(SEED, part, "recorded")
        with contextlib.closing(robot):
            found.append(list(robot.steps()))
    return found


def fleet_of(robots: int, walks: Sequence[Sequence[Step]], seconds: float, folder: Path) -> dict[str, float]:
    """One number of robots for so long, or until their walks end."""
    folder.mkdir()
    names = [f"robot{number + 1}" for number in range(robots)]
    endpoint = free_endpoint("tcp/127.0.0.1:0")
    with _processes(endpoint, names, folder) as processes, contextlib.ExitStack() as ending:
        clients = [ending.enter_context(BusClient(ZenohBus(endpoint))) for _ in range(robots + 1)]
        *writers, page = clients
        ledger = Ledger({name: [] for name in names})
        for topic in DELTAS:
            page.listen(topic, "*", ledger.saw)
        page.listen(SCENE_REVISION, "*", ledger.durable)
        before = {name: _worked_s(process) for name, process in processes.items()}
        started_s = time.monotonic()
        pages = [
            threading.Thread(target=_tell, args=(ledger, *robot)) for robot in _robots(writers, names, walks, seconds)
        ]
        for thread in pages:
            thread.start()
        waits = _waits(page, pages)
        spent_s = time.monotonic() - started_s
        cores = {f"cores_{name}": (_worked_s(one) - before[name]) / spent_s for name, one in processes.items()}
        memory = {f"mb_{name}": one.memory_info().rss / 1e6 for name, one in processes.items()}
        time.sleep(SETTLE_S)
        return _figures(ledger, spent_s) | cores | memory | waits


def _robots(
    writers: Sequence[BusClient], names: Sequence[str], walks: Sequence[Sequence[Step]], seconds: float
) -> Iterator[tuple[BusClient, str, Sequence[Step], float]]:
    """Who tells what from when on: robots begin evenly spread over the time of one keyframe."""
    for number, (writer, name) in enumerate(zip(writers, names, strict=True)):
        steps = walks[number % len(walks)][: int(seconds * RATE_HZ)]
        yield writer, name, steps, time.monotonic() + number / (len(names) * RATE_HZ)


def _tell(ledger: Ledger, client: BusClient, name: str, steps: Sequence[Step], begins_s: float) -> None:
    for number, step in enumerate(steps):
        time.sleep(max(0.0, begins_s + number / RATE_HZ - time.monotonic()))
        for topic, message in step:
            with ledger.lock:
                ledger.sent_s[name].append(time.monotonic())
            client.publish(topic, msgspec.structs.replace(message, robot=name))


def _waits(page: BusClient, writers: Sequence[threading.Thread]) -> dict[str, float]:
    """Most inputs that waited, and for how long at most, in store and bridge, while the writers write."""
    most: dict[str, float] = {}
    while any(writer.is_alive() for writer in writers):
        time.sleep(0.5)
        with contextlib.suppress(BusError):
            for one in page.statuses()[0]:
                for name, value in (("backlog", one.backlog), ("wait_s", one.oldest_wait_s)):
                    key = f"{name}_{one.service}"
                    most[key] = max(most.get(key, 0.0), float(value))
    return most


def _figures(ledger: Ledger, spent_s: float) -> dict[str, float]:
    with ledger.lock:
        sent = sum(map(len, ledger.sent_s.values()))
        return {
            "deltas_per_s": sent / spent_s,
            "bytes_per_s": ledger.robots_bytes / spent_s,
            "merged_bytes_per_s": ledger.merged_bytes / spent_s,
            "merged_deltas": float(ledger.merged),
            "came": len(ledger.bus_ms) / max(sent, 1),
            "stored": sum(ledger.stored.values()) / max(sent, 1),
            **_percentiles("bus", ledger.bus_ms),
            **_percentiles("stored", ledger.stored_ms),
        }


def _percentiles(name: str, found_ms: Sequence[float]) -> dict[str, float]:
    if not found_ms:
        return {}
    ordered = sorted(found_ms)
    return {
        f"{name}_ms_p50": statistics.median(ordered),
        f"{name}_ms_p99": ordered[min(len(ordered) - 1, int(0.99 * len(ordered)))],
    }


def _worked_s(process: psutil.Process) -> float:
    times = process.cpu_times()
    return float(times.user + times.system)


@contextlib.contextmanager
def _processes(endpoint: str, names: Sequence[str], folder: Path) -> Iterator[dict[str, psutil.Process]]:
    """Router, store and bridge, until the end of the body. Raises BusError where one does not come up."""
    serve = [sys.executable, "-m", "prior_sg.deploy.running.serve", "scene_store", "--connect", endpoint]
    cli = [sys.executable, "-m", "prior_sg.deploy.cli.main"]
    commands = {
        "router": [*cli, "router", "--connect", endpoint],
        "scene_store": [*serve, "--set", f"scene_store.path={folder / 'scene.sqlite'}"],
        "fleet": [*cli, "fleet", *names, "--as", NAME, "--memory", "", "--connect", endpoint],
    }
    with contextlib.ExitStack() as ending:
        started = {}
        for name, command in commands.items():
            log = ending.enter_context((folder / f"{name}.log").open("wb"))
            started[name] = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log)
            ending.callback(_end, started[name])
            if name == "router":
                _until_open(endpoint)
        _until_alive(endpoint, started, folder)
        yield {name: psutil.Process(one.pid) for name, one in started.items()}


def _end(process: subprocess.Popen) -> None:
    process.terminate()
    try:
        process.wait(10)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _until_open(endpoint: str) -> None:
    """Wait until the router takes clients."""
    end_s = time.monotonic() + START_S
    while True:
        try:
            ZenohBus(endpoint).close()
            return
        except BusError:
            if time.monotonic() > end_s:
                raise
            time.sleep(0.2)


def _until_alive(endpoint: str, started: Mapping[str, subprocess.Popen], folder: Path) -> None:
    """Wait until store and bridge are on the bus. Raises BusError where a process ends, or is too slow."""
    end_s = time.monotonic() + START_S
    with BusClient(ZenohBus(endpoint)) as client:
        while {"scene_store", "fleet"} - set(client.alive().values()):
            ended = [name for name, process in started.items() if process.poll() is not None]
            if ended or time.monotonic() > end_s:
                said = "".join((folder / f"{name}.log").read_text()[-500:] for name in ended)
                raise BusError(f"store and bridge did not come up within {START_S:.0f} s {said}")
            time.sleep(0.2)

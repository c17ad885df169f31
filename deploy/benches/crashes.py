"""Crashes of the scene store: files as a crash in the midst of a write leaves them, and killed processes.

A crash leaves the new bytes up to some point and behind it the old ones, nothing, or rubbish: first in the write-ahead
log; when that is folded into the file, in pages of the file. Whatever was acknowledged must be there again.
"""

import contextlib
import os
import signal
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from prior_sg.deploy.benches.segmenter import ROOM_STEPS, Hall
from prior_sg.schemas.codec import Message, encode
from prior_sg.schemas.status import Tick
from prior_sg.services.registry import BY_NAME
from prior_sg.services.runtime.runner import Runner
from prior_sg.services.runtime.service import Identity
from prior_sg.services.scene_store.core import graph as core
from prior_sg.services.scene_store.core import telling
from prior_sg.services.scene_store.core.config import Config
from prior_sg.services.scene_store.database import Database
from prior_sg.services.scene_store.storage.tables import StoreError

ROBOT, PAGE_BYTES = "bench", 4096
POINTS, KILLS = 10_000, 50
PER_WRITE = 20  # crash points in one write
IDENTITY = Identity("*", "bench", 1)


@dataclass
class Found:
    """What became of the crash points."""

    points: int = 0
    lost: int = 0  # acknowledged revisions that were not there
    refused: int = 0  # files that could not be opened
    wrong: int = 0  # scenes other than they were announced
    kinds: Counter[str] = field(default_factory=Counter)

    def note(self, path: Path, acknowledged: int, told: dict[int, bytes], kind: str) -> None:
        """Open what a crash left and look whether all is there."""
        self.points += 1
        self.kinds[kind] += 1
        try:
            database = Database(Config(path=str(path), synchronous="normal"))
        except StoreError:
            self.refused += 1
            return
        with contextlib.closing(database):
            graph = database.graphs().get(ROBOT, core.Graph(ROBOT))
            self.lost += max(acknowledged - graph.revision, 0)
            self.wrong += encode(telling.scene(graph)) != told.get(graph.revision)


def crashes(points: int = POINTS, kills: int = KILLS, seed: int = 0) -> tuple[dict, dict]:
    """Torn files and killed processes; the figures that must be 0 and 1."""
    with tempfile.TemporaryDirectory() as folder:
        torn = torn_files(Path(folder), points, np.random.default_rng(seed))
        killed = killed_writers(Path(folder), kills, np.random.default_rng(seed + 1))
    metrics = {
        "acknowledged_lost": torn.lost + killed.lost,
        "opened": 1 - (torn.refused + killed.refused) / (torn.points + killed.points),
        "wrong_scenes": torn.wrong + killed.wrong,
    }
    return metrics, {"points": torn.points, "kills": killed.points, "kinds": dict(torn.kinds), "seed": seed}


def writes(rng: np.random.Generator) -> Iterator[Message]:
    """Place deltas of a small hall without end, and the ticks between that fold the log into the file."""
    hall = Hall(2 * ROOM_STEPS**2, seed=int(rng.integers(1 << 30)))
    count = len(hall.positions_m)
    for revision in range(1 << 30):
        yield hall.delta(revision, np.sort(rng.choice(count, 12, replace=False)))
        if rng.random() < 0.1:
            yield Tick(stamp_ns=revision)


def torn_files(folder: Path, points: int, rng: np.random.Generator) -> Found:
    """Crash points of a store in this process, `PER_WRITE` in each of its writes."""
    path, found = folder / "scene.sqlite", Found()
    cfg = Config(path=str(path), checkpoint_pages=100, history="last", history_last=200)
    told = {-1: encode(telling.scene(core.Graph(ROBOT)))}
    with Runner(BY_NAME["scene_store"], cfg, IDENTITY) as runner:
        before, acknowledged = _files(path), -1
        for message in writes(rng):
            runner.feed(message)
            scene = telling.scene(runner.state.robots[ROBOT].graph)
            told[scene.revision] = encode(scene)
            after = _files(path)
            for _ in range(min(PER_WRITE, points - found.points)):
                kind = _crash(folder / "torn.sqlite", before, after, rng)
                found.note(folder / "torn.sqlite", acknowledged, told, kind)
            before, acknowledged = after, scene.revision
            if found.points >= points:
                return found
    return found


def _files(path: Path) -> tuple[bytes, bytes]:
    """The file and its write-ahead log."""
    log = path.with_name(f"{path.name}-wal")
    return path.read_bytes(), log.read_bytes() if log.exists() else b""


def _crash(path: Path, before: tuple[bytes, bytes], after: tuple[bytes, bytes], rng: np.random.Generator) -> str:
    """Write what a crash between two states leaves; its kind."""
    for leftover in path.parent.glob(f"{path.name}-*"):
        leftover.unlink()
    if before[0] != after[0] and (before[1] == after[1] or rng.random() < 0.5):
        data, log, kind = _torn_pages(before[0], after[0], rng), after[1], "page"
    else:
        data = before[0]
        log, kind = _torn_tail(before[1], after[1], rng)
    path.write_bytes(data)
    path.with_name(f"{path.name}-wal").write_bytes(log)
    return kind


def _torn_tail(old: bytes, new: bytes, rng: np.random.Generator) -> tuple[bytes, str]:
    """New bytes up to a point of what was written."""
    padded = old.ljust(len(new), b"\0")
    different = np.flatnonzero(np.frombuffer(padded[: len(new)], np.uint8) != np.frombuffer(new, np.uint8))
    if not len(different):
        return new, "none"
    first, last = int(different[0]), int(different[-1]) + 1
    cut = int(rng.integers(first, last + 1))
    kind = ("old", "short", "rubbish")[int(rng.integers(3))]
    tail = {"old": old[cut:], "short": b"", "rubbish": rng.bytes(last - cut) + old[last:]}[kind]
    return new[:cut] + tail, kind


def _torn_pages(old: bytes, new: bytes, rng: np.random.Generator) -> bytes:
    """Some of the changed pages written, one of them in part, the others as they were."""
    padded = old.ljust(len(new), b"\0")
    starts = range(0, len(new), PAGE_BYTES)
    changed = [at for at in starts if padded[at : at + PAGE_BYTES] != new[at : at + PAGE_BYTES]]
    order = rng.permutation(changed)[: int(rng.integers(len(changed) + 1))].tolist()
    torn = bytearray(padded)
    for at in order:
        torn[at : at + PAGE_BYTES] = new[at : at + PAGE_BYTES]
    if order:
        half = int(rng.integers(PAGE_BYTES))
        torn[order[-1] + half : order[-1] + PAGE_BYTES] = rng.bytes(PAGE_BYTES - half)
    return bytes(torn)


def killed_writers(folder: Path, kills: int, rng: np.random.Generator) -> Found:
    """Processes that write and are killed with SIGKILL at a random moment, on one file after the other."""
    found = Found()
    for number in range(kills):
        path, seed = folder / f"killed-{number}.sqlite", int(rng.integers(1 << 30))
        acknowledged = _killed(path, seed, after_s=float(rng.uniform(0.0, 0.25)))
        found.note(path, acknowledged, _told(seed, acknowledged + 2), "kill")
    return found


def _killed(path: Path, seed: int, after_s: float) -> int:
    """Let a child write, and kill it; the last revision that it acknowledged."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        _write_until_killed(path, seed, writing)
    os.close(writing)
    with os.fdopen(reading, "rb") as acknowledgements:
        acknowledgements.read(8)  # it has begun
        time.sleep(after_s)
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        told = acknowledgements.read()
    return len(told) // 8


def _write_until_killed(path: Path, seed: int, writing: int) -> None:
    """One revision after the other, each acknowledged with eight bytes; never returns."""
    try:
        cfg = Config(path=str(path), synchronous="normal", checkpoint_pages=100)
        runner = Runner(BY_NAME["scene_store"], cfg, IDENTITY)
        for message in writes(np.random.default_rng(seed)):
            for _ in runner.feed(message):
                os.write(writing, b"revision")
    finally:
        os._exit(1)


def _told(seed: int, limit: int) -> dict[int, bytes]:
    """What the scene is at the last revisions of such a writer."""
    told = {}
    with Runner(BY_NAME["scene_store"], Config(path=":memory:"), IDENTITY) as runner:
        for message in writes(np.random.default_rng(seed)):
            if runner.feed(message):
                scene = telling.scene(runner.state.robots[ROBOT].graph)
                told[scene.revision] = encode(scene)
                if scene.revision >= limit:
                    return told
    return told

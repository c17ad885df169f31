"""Measurements of feature workers: the bare model, the pool around it, and the pool under attack."""

import itertools
import logging
import os
import random
import signal
import statistics
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import msgspec
import numpy as np

from prior_sg.deploy.benches.graphics import on_card
from prior_sg.deploy.running.supervisor import Supervisor
from prior_sg.schemas.codec import decode, encode
from prior_sg.schemas.features import Pyramid
from prior_sg.schemas.frames import Keyframe
from prior_sg.schemas.topics import ENCODE, PYRAMID
from prior_sg.services.feature_pyramid.core import crops as core
from prior_sg.services.feature_pyramid.core.config import Config
from prior_sg.services.feature_pyramid.encoders.base import Options, load_encoder
from prior_sg.services.feature_pyramid.encoders.conse import (
    classifier_file,
    resized,
    rounded_classifier_file,
    runtime_of,
)
from prior_sg.services.feature_pyramid.encoders.onnx_session import Session
from prior_sg.services.images import color_of, depth_of
from prior_sg.services.runtime.bus import Sample
from prior_sg.services.runtime.endpoints import free_endpoint
from prior_sg.services.runtime.jobs.board import Ended
from prior_sg.services.runtime.jobs.pool import JobPool
from prior_sg.services.runtime.zenoh_bus import ZenohBus
from prior_sg.services.runtime.zenoh_router import open_router

BATCHES = (1, 4, 16)
ROUNDS = 3
POOL_FRAMES = 30
ROBOT = "bench"
SMALL = "conse/efficientnet-lite0/minilm-l6-v2"  # of the attacked pool: more jobs, so more can go wrong
PERIOD_S = 1.0  # between attacks
WINDOW = 8  # jobs outstanding, as ingest has them


@dataclass
class Pool:
    """A dispatcher with workers of its own behind a router on loopback; counts what comes out of it."""

    supervisor: Supervisor
    bus: ZenohBus
    submitted_s: dict[int, float] = field(default_factory=dict)
    pyramids: dict[int, list[tuple[float, int]]] = field(default_factory=dict)  # arrival and crops, by frame
    ended: dict[int, Ended] = field(default_factory=dict)
    jobs: JobPool = field(init=False)

    def __post_init__(self) -> None:
        self.bus.subscribe(PYRAMID, PYRAMID.pattern(ROBOT), self._saw, lambda topic, number: None)
        self.jobs = JobPool(self.bus, ENCODE, ROBOT, time.monotonic, self._ended)

    def _saw(self, sample: Sample) -> None:
        pyramid = decode(Pyramid, sample.payload)
        self.pyramids.setdefault(pyramid.frame_id, []).append((time.monotonic(), len(pyramid.embeddings)))

    def _ended(self, job: Ended) -> None:
        _, frame_id = cast(tuple[str, int], job.id)
        self.ended[frame_id] = job

    def submit(self, keyframe: Keyframe) -> None:
        """Line up one keyframe."""
        self.submitted_s[keyframe.frame_id] = time.monotonic()
        self.jobs.submit((keyframe.robot, keyframe.frame_id), encode(keyframe))

    def revive(self) -> None:
        """Start again what has died, however often."""
        for child in self.supervisor.children:
            child.deaths = 0
        self.supervisor.check()

    def wait(self, condition: Callable[[], bool], timeout_s: float) -> None:
        """Until something holds. Raises TimeoutError."""
        end_s = time.monotonic() + timeout_s
        while not condition():
            self.revive()
            if time.monotonic() > end_s:
                raise TimeoutError(f"the pool did not get there within {timeout_s:.0f} s")
            time.sleep(0.005)


@contextmanager
def pool(workers: int, settings: list[str]) -> Iterator[Pool]:
    """A pool with its workers up."""
    endpoint = free_endpoint("tcp/127.0.0.1:0")
    stop_router = open_router(endpoint)
    with tempfile.TemporaryDirectory() as folder:
        published = f"feature_pyramid.smallest_crop_px={core.PUBLISHED_CROP_PX}"
        settings = ["feature_pyramid.detector=none", published, *settings]  # crops of pyramids are what is counted
        supervisor = Supervisor(endpoint, "bench", Path(folder), settings)
        running = Pool(supervisor, ZenohBus(endpoint))
        try:
            supervisor.start("feature_pyramid", workers)
            running.wait(lambda: running.jobs.workers == workers, 180.0)
            yield running
        finally:
            running.jobs.close()
            supervisor.stop()
            running.bus.close()
            stop_router()


def numbered(keyframes: list[Keyframe]) -> Iterator[Keyframe]:
    """The keyframes over and over, with numbers that rise."""
    for number, keyframe in enumerate(itertools.cycle(keyframes)):
        yield msgspec.structs.replace(keyframe, robot=ROBOT, frame_id=number)


def sample_crops(keyframes: list[Keyframe], count: int, side_px: int) -> np.ndarray:
    """Crops as the network sees them: uint8 (count, side, side, 3)."""
    crops: list[np.ndarray] = []
    cfg = Config(smallest_crop_px=core.PUBLISHED_CROP_PX)
    for frame in keyframes:
        selection = core.select_crops(depth_of(frame, cfg.max_principal_offset), frame.intrinsics, cfg)
        crops += [resized(crop, side_px) for crop in selection.crops.cut(color_of(frame))]
        if len(crops) >= count:
            break
    return np.stack(crops[:count])


def bare_rate(run: Callable[[np.ndarray], Any], crops: np.ndarray, batches: tuple[int, ...]) -> dict[int, float]:
    """Crops per second of a network alone, by batch size: the median of several rounds, turn by turn."""
    rates: dict[int, list[float]] = {size: [] for size in batches}
    for size in batches:
        run(crops[:size])
    for _, size in itertools.product(range(ROUNDS), batches):
        started_s = time.perf_counter()
        for first in range(0, len(crops) - size + 1, size):
            run(crops[first : first + size])
        done = len(crops) // size * size
        rates[size].append(done / (time.perf_counter() - started_s))
    return {size: statistics.median(found) for size, found in rates.items()}


def pool_rate(running: Pool, frames: Iterator[Keyframe], count: int) -> float:
    """Crops per second that a full pool delivers, from its first pyramid to its last."""
    numbers = []
    for _, frame in zip(range(count), frames, strict=False):
        numbers.append(frame.frame_id)
        running.submit(frame)
    running.wait(lambda: all(number in running.pyramids for number in numbers), 600.0)
    arrivals = sorted(running.pyramids[number][0] for number in numbers)
    return sum(crops for _, crops in arrivals[1:]) / (arrivals[-1][0] - arrivals[0][0])


def features(keyframes: list[Keyframe]) -> tuple[dict, dict]:
    """The pool against the bare model, and ONNX Runtime against PyTorch, all on every core of this machine."""
    cfg, cores = Config(), os.cpu_count() or 1
    name, in_use = cfg.space.split("/")[1], runtime_of(cfg.runtime)
    original = load_encoder(cfg.space, Options(threads=cores, runtime="torch"))
    networks: dict[str, Callable[[np.ndarray], Any]] = {
        "onnx": Session(classifier_file(name, cores), cores),
        "onnx-int8": Session(rounded_classifier_file(name, cores), cores),
        "torch": original._classifier._classify,  # type: ignore[attr-defined]
    }
    crops = sample_crops(keyframes, 16, original.side_px)
    rates = {runtime: bare_rate(run, crops, BATCHES) for runtime, run in networks.items()}
    best = {runtime: max(found.values()) for runtime, found in rates.items()}
    metrics: dict[str, float] = {
        "onnx_speedup": best[in_use] / best["torch"],
        "full_precision_speedup": best["onnx"] / best["torch"],
        "bare_crops_per_s": best[in_use],
        "full_precision_crops_per_s": best["onnx"],
        "torch_crops_per_s": best["torch"],
        "bare_best_batch": max(rates[in_use], key=lambda size: rates[in_use][size]),
    }
    for workers in (1, 2):
        ratios, delivered = [], []
        with pool(workers, []) as running:
            frames = numbered(keyframes)
            pool_rate(running, frames, 2 * workers)
            for _ in range(ROUNDS):  # turn by turn, for other work on the machine comes and goes
                before = max(bare_rate(networks[in_use], crops, (1, 16)).values())
                delivered.append(pool_rate(running, frames, POOL_FRAMES // ROUNDS))
                after = max(bare_rate(networks[in_use], crops, (1, 16)).values())
                ratios.append(delivered[-1] / ((before + after) / 2))
        metrics[f"pool_ratio_{workers}"] = statistics.median(ratios)
        metrics[f"crops_per_s_{workers}"] = statistics.median(delivered)
    metrics["pool_ratio"] = min(metrics["pool_ratio_1"], metrics["pool_ratio_2"])
    metrics["crops_per_s"] = metrics["crops_per_s_1"]
    metrics |= on_card()
    return metrics, {
        "space": cfg.space,
        "runtime": in_use,
        "crops": len(crops),
        "frames": POOL_FRAMES,
        "rounds": ROUNDS,
    }


class Attacks:
    """Kills, freezes, slows and adds workers at random, one at a time."""

    def __init__(self, running: Pool, rng: random.Random) -> None:
        self.pool, self.rng = running, rng
        self.counts = {"killed": 0, "frozen": 0, "slowed": 0, "added": 0}
        self.stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> "Attacks":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop.set()
        self._thread.join()

    def _run(self) -> None:
        supervisor, most = self.pool.supervisor, 5
        while not self.stop.wait(self.rng.uniform(0.5, 1.5) * PERIOD_S):
            pids = list(supervisor.pids().values())
            kind = self.rng.choice(["killed", "frozen", "slowed", "added"])
            if kind == "added" and len(supervisor.children) < most:
                supervisor.start("feature_pyramid", 1)
            elif kind != "added" and len(pids) > 1:
                self._hurt(kind, self.rng.choice(pids))
            else:
                continue
            self.counts[kind] += 1

    def _hurt(self, kind: str, pid: int) -> None:
        if kind == "killed":
            _send(pid, signal.SIGKILL)
        elif kind == "frozen":
            self._frozen(pid, self.rng.uniform(0.5, 6.0))
        else:  # half of the time it does not run
            for _ in range(20):
                self._frozen(pid, 0.1)
                if self.stop.wait(0.1):
                    return

    def _frozen(self, pid: int, seconds: float) -> None:
        _send(pid, signal.SIGSTOP)
        self.stop.wait(seconds)
        _send(pid, signal.SIGCONT)


def _send(pid: int, number: signal.Signals) -> None:
    try:
        os.kill(pid, number)
    except ProcessLookupError:
        return


def attacked(keyframes: list[Keyframe], seconds: float, rate_hz: float) -> tuple[dict, dict]:
    """A stream as fast as the pool takes it, while workers are killed, frozen, slowed and added at random."""
    seed = 5
    logging.getLogger("prior_sg.services.runtime.jobs.dispatcher").setLevel(
        logging.ERROR
    )  # what it reports is what is counted here
    settings = [f"feature_pyramid.space={SMALL}", "feature_pyramid.layers=1", "feature_pyramid.smallest_crop_px=480"]
    with pool(3, settings) as running:
        frames, started_s = numbered(keyframes), time.monotonic()
        with Attacks(running, random.Random(seed)) as attacks:
            while (now_s := time.monotonic()) < started_s + seconds:
                running.submit(next(frames))
                running.revive()
                due_s = started_s + len(running.submitted_s) / rate_hz
                time.sleep(max(0.0, due_s - now_s))
                running.wait(lambda: running.jobs.outstanding < WINDOW, 120.0)  # as ingest does when it waits
        running.wait(lambda: len(running.ended) == len(running.submitted_s), 120.0)
        time.sleep(2.0)  # late answers of those that were thought dead
        return attack_metrics(running, attacks, time.monotonic() - started_s), {
            "seconds": seconds, "rate_hz": rate_hz, "workers_at_start": 3, "seed": seed, "space": SMALL,
        }  # fmt: skip


def attack_metrics(running: Pool, attacks: Attacks, seconds: float) -> dict:
    """What was lost, what was done twice, and how long anything took."""
    waits_s = [running.pyramids[n][0][0] - at_s for n, at_s in running.submitted_s.items() if n in running.pyramids]
    arrivals = sorted(times[0][0] for times in running.pyramids.values())
    encoded = sum(len(times) for times in running.pyramids.values())
    return {
        "frames": len(running.submitted_s),
        "lost": len(set(running.submitted_s) - set(running.pyramids))
        + sum(1 for e in running.ended.values() if e.error),
        "twice": encoded - len(running.pyramids),
        "twice_share": (encoded - len(running.pyramids)) / max(encoded, 1),
        "attempts_max": max(e.attempts for e in running.ended.values()),
        "stall_s": max(np.diff(arrivals)) if len(arrivals) > 1 else 0.0,
        "wait_s_p50": statistics.median(waits_s),
        "wait_s_max": max(waits_s),
        "frames_per_s": len(running.pyramids) / seconds,
        **attacks.counts,
    }

"""Measurement of the integration kernel: one keyframe into all places that it sees."""

import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from prior_sg.deploy.running.supervisor import THREAD_VARIABLES
from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.segmenter.core.evidence.kernel import Evidence, Frame, KernelConfig, Targets, integrate

PLACES, CROPS, DIM = 2_000, 60, 1024
QUERY_RADIUS_M = 0.75
ROUNDS = 25


def observation(rng: np.random.Generator) -> tuple[Frame, np.ndarray]:
    """A keyframe with 60 crops in three layers, and places that all lie in its view."""
    camera = Intrinsics(640, 480, 500.0, 500.0, 319.5, 239.5)
    sides_px = np.repeat([224, 352, 480], [40, 15, 5])
    frame = Frame(
        camera_from_world=np.eye(4),
        intrinsics=camera,
        centers_px=rng.uniform(110, 370, (CROPS, 2)).astype(np.float32),
        sigmas_px=(sides_px / 2).astype(np.float32),
        layer_starts=np.array([0, 40, 55]),
        embeddings=rng.standard_normal((CROPS, DIM)).astype(np.float16),
        surface_m=np.full((60, 80), 9.0, np.float16),
    )
    depths_m = rng.uniform(2, 8, PLACES)
    rays = np.column_stack((rng.uniform(-0.6, 0.6, PLACES), rng.uniform(-0.45, 0.45, PLACES), np.ones(PLACES)))
    return frame, rays * depths_m[:, None]


def kernel() -> tuple[dict, dict]:
    """The measurement in a process of its own, with one numeric thread as the segmenter has it."""
    threads = dict.fromkeys(THREAD_VARIABLES, "1")
    command = [sys.executable, "-m", "prior_sg.deploy.benches.kernel"]
    done = subprocess.run(command, env=os.environ | threads, capture_output=True, text=True, check=True)
    metrics, settings = json.loads(done.stdout)
    return metrics, settings


def measured() -> tuple[dict, dict]:
    """Visibility, weights, trust and fusion of one keyframe, as multiples of one matrix product of that shape.

    Turn by turn, so that other work on the machine hits both alike; slots of the places in random order.
    """
    rng = np.random.default_rng(0)
    frame, positions_m = observation(rng)
    evidence = Evidence()
    evidence.add(rng.permutation(PLACES).tolist())
    targets = Targets(evidence.of(list(range(PLACES))), positions_m)
    weights = rng.random((PLACES, CROPS)).astype(np.float32)
    embeddings = frame.embeddings.astype(np.float32)
    cfg = KernelConfig()

    def whole() -> np.ndarray:
        return integrate(evidence, frame, targets, QUERY_RADIUS_M, cfg)

    def product() -> np.ndarray:
        return weights @ embeddings

    seen = len(whole())
    product()
    spent_ms = [(_milliseconds(product), _milliseconds(whole)) for _ in range(ROUNDS)]
    metrics = {
        "gemm_ratio": statistics.median(all_ms / gemm_ms for gemm_ms, all_ms in spent_ms),
        "ms": statistics.median(all_ms for _, all_ms in spent_ms),
        "gemm_ms": statistics.median(gemm_ms for gemm_ms, _ in spent_ms),
    }
    return metrics, {"places": PLACES, "places_seen": seen, "crops": CROPS, "dim": DIM, "rounds": ROUNDS, "threads": 1}


def _milliseconds(run: Callable[[], Any]) -> float:
    started_s = time.perf_counter()
    run()
    return 1e3 * (time.perf_counter() - started_s)


if __name__ == "__main__":
    print(json.dumps(measured()))

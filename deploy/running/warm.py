"""Compiles the inner loops ahead of time: the whole method once over the packaged sample, in this process.

What numba keeps is for argument types as they come. So nothing is listed here that could be forgotten: messages go
through bytes as on a bus, and all services work on them as they do for a user. Only the network is left out.
"""

import sys
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import cv2
import numpy as np

from prior_sg.deploy.sample import COARSE
from prior_sg.deploy.settings import DEFAULT_ROBOT, DEMO_ENVIRONMENT, DEMO_TASK
from prior_sg.schemas.features import DEFAULT_SPACE, TextEmbeddings
from prior_sg.schemas.priors import PriorRequest, Task
from prior_sg.schemas.status import Tick
from prior_sg.schemas.topics import PRIOR, PRIORS, TASK
from prior_sg.services.compiled import Loop
from prior_sg.services.feature_pyramid.detectors.load import load_detector
from prior_sg.services.feature_pyramid.worker import Worker
from prior_sg.services.ingest.sources import open_source
from prior_sg.services.registry import SERVICES
from prior_sg.services.runtime.runner import Pipeline, Runner
from prior_sg.services.runtime.service import Identity

DIM = 32
GLANCE_PX = 4  # to which crops are shrunk for their stand-in of an embedding
TICK_EVERY = 4  # frames
LAST_TICKS = 12
OTHER_TASK = "serve drinks to guests"
SETTINGS: dict[str, dict[str, Any]] = {
    "scene_store": {"path": ":memory:", "history": "last", "history_last": 0},
    "prior_gateway": {"archive": ""},
}
# Frames of the sample, and with which settings; all of them bring nothing that so many do not.
PASSES: tuple[tuple[int, dict[str, dict[str, Any]]], ...] = ((48, {}), (8, {"place_graph": {"places": "2d"}}))

Progress = Callable[[int, int], None]  # frames done, frames in all


class Warmed(NamedTuple):
    """What was done."""

    made: int  # compiled now, with as many argument types as were met
    read: int  # read from the disk
    seconds: float


class Glance:
    """A stand-in for the encoder that services expect: a crop's embedding is the crop itself, much shrunk."""

    space, dim, side_px, batch_size = DEFAULT_SPACE, DIM, 32, 8

    def encode_images(self, crops: list[np.ndarray]) -> np.ndarray:
        """Unit vectors (crop, DIM)."""
        looks = np.ones((len(crops), DIM), np.float32)
        for row, crop in enumerate(crops):
            shrunk = cv2.resize(crop, (GLANCE_PX, GLANCE_PX), interpolation=cv2.INTER_AREA)[..., :2]
            looks[row] = shrunk.reshape(-1) / 255 + 1e-3
        return looks / np.linalg.norm(looks, axis=1, keepdims=True)

    def encode_text(self, concepts: list[list[str]]) -> TextEmbeddings:
        """Any: the same for the same number of concepts."""
        embeddings = np.random.default_rng(0).random((len(concepts), DIM), np.float32)
        return TextEmbeddings(
            space=DEFAULT_SPACE,
            embeddings=embeddings / np.linalg.norm(embeddings, axis=1, keepdims=True),
            background_mean=np.full(len(concepts), 0.5, np.float32),
            background_std=np.full(len(concepts), 0.1, np.float32),
            temperature=1.0,
            null_score=1.0,
        )


def warm(progress: Progress = lambda done, whole: None) -> Warmed:
    """Compile what is not compiled yet, and keep it as `services/compiled.py` does."""
    began_s = time.monotonic()
    frames = list(open_source(COARSE))
    whole, before = sum(count for count, _ in PASSES), 0
    for count, settings in PASSES:
        for done in _walk(frames[:count], settings):
            progress(before + done, whole)
        before += count
    made, read = (sum(found) for found in zip(*(loop.met() for loop in loops().values()), strict=True))
    return Warmed(made, read, time.monotonic() - began_s)


def _walk(frames: list, settings: dict[str, dict[str, Any]]) -> Iterator[int]:
    """All services over the frames, with another task in the middle; the number of frames so far, after each."""
    with Pipeline([_runner(service, settings) for service in SERVICES]) as pipeline:
        ingest, stamp_ns = pipeline.of("ingest"), 0
        _give(pipeline, 1, DEMO_TASK)
        for number, frame in enumerate(frames, 1):
            pipeline.feed(ingest, frame)
            stamp_ns = frame.stamp_ns
            if number == len(frames) // 2:
                _give(pipeline, 2, OTHER_TASK)
            if number % TICK_EVERY == 0:
                _tick(pipeline, stamp_ns)
            yield number
        for tick in range(LAST_TICKS):
            _tick(pipeline, stamp_ns + (tick + 1) * 10**9)


def _runner(service: Any, settings: dict[str, dict[str, Any]]) -> Runner:
    identity = Identity(DEFAULT_ROBOT if service.scope == "robot" else "*", service.name, 1)
    given = SETTINGS.get(service.name, {}) | settings.get(service.name, {})
    cfg = service.config(**given)
    worker = Worker(service.name, Glance(), load_detector(cfg)) if service.name == "feature_pyramid" else None
    return Runner(service, cfg, identity, state=worker, wire=True)


def _give(pipeline: Pipeline, number: int, text: str) -> None:
    request = PriorRequest(environment=DEMO_ENVIRONMENT, task=text)
    prior = pipeline.of("prior_gateway").answer(PRIORS, request).priors[0]
    pipeline.publish(TASK, Task(robot=DEFAULT_ROBOT, stamp_ns=number, environment=DEMO_ENVIRONMENT, task=text))
    pipeline.publish(PRIOR, prior)


def _tick(pipeline: Pipeline, stamp_ns: int) -> None:
    for runner in pipeline.runners:
        if runner.service.tick_s is not None:
            pipeline.feed(runner, Tick(stamp_ns=stamp_ns))


def loops() -> dict[str, Loop]:
    """Those of all services that are loaded, by module and name."""
    return {
        f"{value.__module__}.{value.__name__}": value
        for name, module in list(sys.modules.items())
        if name.startswith("prior_sg.services.")
        for value in vars(module).values()
        if isinstance(value, Loop)
    }

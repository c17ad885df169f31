"""Measurements: `prior-sg bench NAME --json`. Keys are fixed; docs/performance.md keeps figures with their commands."""

import os
import platform
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from prior_sg.deploy.benches import exactness, segmenter
from prior_sg.deploy.benches import features as bench_features
from prior_sg.deploy.benches.bus import bus_bench
from prior_sg.deploy.benches.crashes import crashes
from prior_sg.deploy.benches.encoder_swap import encoder_swap
from prior_sg.deploy.benches.footprint import memory_bench, start_bench
from prior_sg.deploy.benches.kernel import kernel
from prior_sg.deploy.benches.learning import learning_bench
from prior_sg.deploy.benches.places import keyframes_of, place_bench
from prior_sg.deploy.benches.queries import query_bench
from prior_sg.deploy.benches.store import store_bench
from prior_sg.deploy.benches.swap import swap_bench
from prior_sg.deploy.evaluation.errors import EvaluationError
from prior_sg.deploy.sample import SAMPLE
from prior_sg.deploy.settings import DEMO_ENVIRONMENT, DEMO_TASK
from prior_sg.schemas.frames import Keyframe
from prior_sg.schemas.priors import PriorRequest, Task
from prior_sg.schemas.topics import KEYFRAME, PRIOR, PRIORS, TASK, TEXT
from prior_sg.services.ingest.sources import open_source
from prior_sg.services.registry import BY_NAME
from prior_sg.services.runtime.runner import Pipeline, Runner
from prior_sg.services.runtime.service import Identity

if TYPE_CHECKING:
    from prior_sg.deploy.evaluation.datasets import WorldName


def _silent(text: str) -> None:
    """Nobody hears how far a measurement is."""


class Asked(NamedTuple):
    """What may be asked of measurements."""

    seconds: float = 300.0  # how long the pool is attacked
    paths: Sequence[Path] = ()  # recordings and worlds to measure on
    presets: Sequence[str] = exactness.PRESETS  # of the place graph, with `paths`
    worlds: str = ""  # the kind of generated worlds in which learning takes place
    seeds: Sequence[int] = ()  # of the worlds that an explorer foresees, or that robots learn from and are tested in
    report: Callable[[str], None] = _silent  # hears how far it is


def machine() -> dict[str, Any]:
    """Where a figure was measured."""
    return {"cores": os.cpu_count(), "processor": platform.machine(), "system": platform.system()}


def _sample_keyframes() -> list[Keyframe]:
    """Every frame of the sample as a keyframe."""
    return list(keyframes_of(open_source(SAMPLE)))


def _percentiles(milliseconds: list[float]) -> dict[str, float]:
    ordered = sorted(milliseconds)
    return {"ms_p50": statistics.median(ordered), "ms_p99": ordered[min(len(ordered) - 1, int(0.99 * len(ordered)))]}


def places() -> tuple[dict, dict]:
    """The place graph per keyframe of the sample; see `prior_sg.deploy.benches.places`."""
    return place_bench(_sample_keyframes())


def features() -> tuple[dict, dict]:
    """The pool of feature workers against the bare model."""
    return bench_features.features(_sample_keyframes())


def attacked_pool(asked: Asked) -> tuple[dict, dict]:
    """A pool whose workers are killed, frozen, slowed and added at random."""
    return bench_features.attacked(_sample_keyframes(), asked.seconds, rate_hz=40.0)


def exchanged_encoder() -> tuple[dict, dict]:
    """A worker of another embedding space joins in mid-run; see `prior_sg.deploy.benches.encoder_swap`."""
    return encoder_swap(SAMPLE)


def bus() -> tuple[dict, dict]:
    """The typed bus against bare Zenoh."""
    return bus_bench(_sample_keyframes()[0])


def view() -> tuple[dict, dict]:
    """The live page; see `prior_sg.deploy.benches.view`."""
    from prior_sg.deploy.benches.view import view_bench  # needs the extra `view`

    return view_bench()


def lidar() -> tuple[dict, dict]:
    """The sample as lidars of few rings see it; see `prior_sg.deploy.benches.lidar`."""
    from prior_sg.deploy.benches.lidar import lidar_bench  # needs an encoder

    return lidar_bench(SAMPLE)


def levels(asked: Asked) -> tuple[dict, dict]:
    """Levels above regions, in the worlds that are named; see `prior_sg.deploy.benches.levels`. Raises
    EvaluationError."""
    from prior_sg.deploy.benches.levels import WORLDS, levels_bench  # needs what evaluation needs

    return levels_bench(_named(asked) or WORLDS, report=asked.report)


def exchanged() -> tuple[dict, dict]:
    """Every service and the router exchanged in mid-run; see `prior_sg.deploy.benches.exchange`."""
    from prior_sg.deploy.benches.exchange import ROWS, exchange_bench  # needs the encoder

    return exchange_bench(ROWS, SAMPLE)


def foresight(asked: Asked) -> tuple[dict, dict]:
    """Regions foreseen and searched for in generated worlds, and on maps of those named; see
    `prior_sg.deploy.benches.foresight`. Raises EvaluationError."""
    from prior_sg.deploy.benches.foresight import MAPPED, SEEDS, foresight_bench  # compiles the worlds' loops

    return foresight_bench(asked.seeds or SEEDS, _named(asked) or MAPPED, report=asked.report)


def memory() -> tuple[dict, dict]:
    """Megabytes of each process of a run of the sample; see `prior_sg.deploy.benches.footprint`."""
    return memory_bench(SAMPLE)


def start() -> tuple[dict, dict]:
    """Seconds until a run of the sample has its first region; see `prior_sg.deploy.benches.footprint`."""
    return start_bench(SAMPLE)


def fleet() -> tuple[dict, dict]:
    """Many light robots on one bus; see `prior_sg.deploy.benches.fleet`."""
    from prior_sg.deploy.benches.fleet import fleet_bench  # needs what evaluation needs

    return fleet_bench()


def hydra() -> tuple[dict, dict]:
    """The bridge to Hydra; see `prior_sg.deploy.benches.hydra`."""
    from prior_sg.deploy.benches.hydra import hydra_bench  # needs the extra `hydra`

    return hydra_bench()


def merge(asked: Asked) -> tuple[dict, dict]:
    """Maps of two robots that find together, of worlds of one kind; see `prior_sg.deploy.benches.merge`. Raises
    EvaluationError."""
    from prior_sg.deploy.benches.merge import merge_bench

    return merge_bench(report=asked.report, **_worlds_of(asked, "merge"))


def markers(asked: Asked) -> tuple[dict, dict]:
    """The same by printed markers; see `prior_sg.deploy.benches.markers`. Raises EvaluationError."""
    from prior_sg.deploy.benches.markers import markers_bench

    return markers_bench(report=asked.report, **_worlds_of(asked, "markers"))


def _worlds_of(asked: Asked, bench: str) -> dict[str, Any]:
    """Seeds and kind of the worlds that were named, as keywords; none where none were. Raises EvaluationError."""
    worlds = _named(asked)
    if len({world.kind for world in worlds}) > 1:
        raise EvaluationError(f"{bench} walks worlds of one kind: name one, such as world:home:80-91")
    return {"seeds": [world.seed for world in worlds], "kind": worlds[0].kind} if worlds else {}


def _named(asked: Asked) -> "list[WorldName]":
    """The worlds that were named. Raises EvaluationError."""
    from prior_sg.deploy.evaluation.datasets import named_worlds

    return [world for path in asked.paths for world in named_worlds(str(path))]


def e2e() -> tuple[dict, dict]:
    """Keyframe in hand → region delta that follows from it, encoder time excluded, without transport."""
    keyframes = _sample_keyframes()
    request = PriorRequest(environment=DEMO_ENVIRONMENT, task=DEMO_TASK)
    prior = Runner(BY_NAME["prior_gateway"]).answer(PRIORS, request).priors[0]
    encoder, place_graph, segmenter = (
        Runner(BY_NAME[name], identity=Identity("bench", name, 1))
        for name in ("feature_pyramid", "place_graph", "segmenter")
    )
    segmenter.answers[TEXT] = encoder
    pipeline = Pipeline((place_graph, segmenter))
    pipeline.publish(TASK, Task(robot="bench", stamp_ns=0, environment=request.environment, task=request.task))
    pipeline.publish(PRIOR, prior)
    spent = []
    for keyframe in keyframes:
        encoded = encoder.feed(keyframe)
        started_s = time.perf_counter()
        pipeline.publish(KEYFRAME, keyframe)
        for topic, message in encoded:
            pipeline.publish(topic, message)
        spent.append(1e3 * (time.perf_counter() - started_s))
    return _percentiles(spent[3:]), {"keyframes": len(keyframes), "transport": "none (see bench bus)"}


BENCHES: dict[str, Callable[[], tuple[dict, dict]]] = {
    "bus": bus,
    "places": places,
    "features": features,
    "kernel": kernel,
    "swap": swap_bench,
    "segmenter": segmenter.updates,
    "task": segmenter.switch,
    "learning": learning_bench,
    "encoder_swap": exchanged_encoder,
    "queries": query_bench,
    "e2e": e2e,
    "store": store_bench,
    "memory": memory,
    "start": start,
}
LONG: dict[str, Callable[[Asked], tuple[dict, dict]]] = {  # no part of `all`; the pool lasts as long as it is told to
    "pool": attacked_pool,
    "store_crashes": lambda asked: crashes(),
    "lidar": lambda asked: lidar(),  # seven minutes and more
    "levels": levels,  # many minutes
    "exchange": lambda asked: exchanged(),  # nine runs of the sample at half its pace
    "foresight": foresight,  # worlds of every kind: long
    "fleet": lambda asked: fleet(),  # processes of its own, for minutes
    "view": lambda asked: view(),  # needs an extra and a browser
    "hydra": lambda asked: hydra(),  # needs an extra
    "merge": merge,  # maps dozens of homes, which it keeps
    "markers": markers,  # the same homes
}


TAKERS = {
    "on": ("places", "foresight", "levels", "merge", "markers"),
    "worlds": ("learning",),
    "seeds": ("foresight", "learning"),
}  # by option


def learning_in_worlds(asked: Asked) -> tuple[dict, dict]:
    """Learning in generated worlds; see `prior_sg.deploy.benches.learning_worlds`. Raises EvaluationError."""
    from prior_sg.deploy.benches.learning_worlds import SEEDS, learning_worlds_bench, parted  # compiles loops

    return learning_worlds_bench(asked.worlds, asked.report, parted(asked.seeds) if asked.seeds else SEEDS)


def table(found: dict[str, Any]) -> tuple[Sequence[str], list[list[str]]]:
    """One measurement as the columns and rows that are printed."""
    if "offsets_m" in found["settings"]:
        return exactness.COLUMNS, exactness.table(found["metrics"])
    return ("metric", "value"), [[metric, f"{value:.4g}"] for metric, value in _flat(found["metrics"])]


def _flat(metrics: dict, before: str = "") -> Iterator[tuple[str, float]]:
    """Every figure with the names it stands under."""
    for name, value in metrics.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{before}{name}.")
        else:
            yield before + name, value


def run(name: str, asked: Asked) -> dict[str, Any]:
    """One measurement as the object that `--json` prints."""
    if name == "places" and asked.paths:
        metrics, settings = exactness.exactness_bench(asked.paths, asked.presets, asked.report)
    elif name == "learning" and asked.seeds and not asked.worlds:
        raise EvaluationError("--seeds are of generated worlds: say of which kind, such as --worlds home")
    elif name == "learning" and asked.worlds:
        metrics, settings = learning_in_worlds(asked)
    else:
        metrics, settings = LONG[name](asked) if name in LONG else BENCHES[name]()
    return {"bench": name, "metrics": metrics, "machine": machine(), "settings": settings}

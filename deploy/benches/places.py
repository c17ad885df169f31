"""The place graph: time per keyframe, split by stage, against the size of the map, and memory."""

import cProfile
import resource
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import msgspec
import numpy as np

from prior_sg.schemas.frames import Keyframe
from prior_sg.services import images
from prior_sg.services.ingest.sources import Source
from prior_sg.services.place_graph.core.ledger import PlaceLedger
from prior_sg.services.place_graph.core.openings import Openings
from prior_sg.services.place_graph.core.skeleton import distance, places
from prior_sg.services.place_graph.core.skeleton.graph import PlaceGraph
from prior_sg.services.place_graph.core.volume import tsdf
from prior_sg.services.registry import BY_NAME
from prior_sg.services.runtime.runner import Runner
from prior_sg.services.runtime.service import Identity

PLACE_STAGES: dict[str, Callable[..., Any]] = {  # the function of the place graph whose time makes a stage
    "decode": images.depth_of,
    "blocks": tsdf.blocks_of,
    "fuse": tsdf.integrate,
    "distances": distance.refresh,
    "places": places.extract,
    "edges": PlaceGraph.update,
    "frontiers": Openings.renew,
    "publish": PlaceLedger.update,
}
LAP_M, MANY_PLACES = 25.6, 10_000  # a lap of the sample lies so far beside the one before, in whole blocks of voxels


def keyframes_of(source: Source) -> Iterator[Keyframe]:
    """Every frame of a source as a keyframe."""
    for frame in source:
        fields = {name: getattr(frame, name) for name in Keyframe.__struct_fields__ if hasattr(frame, name)}
        yield Keyframe(robot="bench", **fields)


def place_bench(keyframes: list[Keyframe]) -> tuple[dict, dict]:
    """Place graph per keyframe of the sample, image decoding included, in processor time of one thread.

    `growth` compares the same keyframes on a map of 100 places and on one of 10 000, made of laps side by side.
    """
    metrics: dict[str, float] = {}
    for voxel_m in (0.2, 0.1):
        suffix = "" if voxel_m == 0.2 else f"_{voxel_m}m"
        _lap_ms(keyframes, voxel_m)  # loads the compiled kernels
        milliseconds, stages = _lap_ms(keyframes, voxel_m)
        p50, p99 = np.percentile(milliseconds, (50, 99))
        found = {"ms_p50": float(p50), "ms_p99": float(p99)} | stages
        metrics |= {f"{name}{suffix}": value for name, value in found.items()}
    metrics |= _growth(keyframes)
    metrics["peak_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    return metrics, {"keyframes": len(keyframes), "image": "640x480", "voxel_m": 0.2, "clock": "processor time"}


def _place_graph(**settings: Any) -> Runner:
    service = BY_NAME["place_graph"]
    return Runner(service, service.config(**settings), Identity("bench", "b", 1))


def _lap_ms(keyframes: list[Keyframe], voxel_m: float) -> tuple[list[float], dict[str, float]]:
    """Milliseconds of each keyframe, and of each stage on average."""
    runner = _place_graph(voxel_m=voxel_m)
    spent: list[float] = []
    profile = cProfile.Profile(time.process_time)
    for keyframe in keyframes:
        started_s = time.process_time()
        runner.feed(keyframe)
        spent.append(1e3 * (time.process_time() - started_s))
    runner = _place_graph(voxel_m=voxel_m)
    profile.enable()
    for keyframe in keyframes:
        runner.feed(keyframe)
    profile.disable()
    spent_s = stages_s(profile, PLACE_STAGES)
    return spent, {f"stage_ms_{stage}": 1e3 * seconds / len(keyframes) for stage, seconds in spent_s.items()}


def stages_s(profile: cProfile.Profile, stages: Mapping[str, Callable[..., Any]]) -> dict[str, float]:
    """Seconds that each stage's function took, what it calls included. Raises RuntimeError if one was never called."""
    called = {entry.code: entry.totaltime for entry in profile.getstats()}
    missing = [stage for stage, function in stages.items() if function.__code__ not in called]
    if missing:
        raise RuntimeError(f"the place graph never calls the functions of these stages: {', '.join(missing)}")
    return {stage: called[function.__code__] for stage, function in stages.items()}


def _growth(keyframes: list[Keyframe]) -> dict[str, float]:
    """Time of a lap on a large map over that of the same lap on a small one, keyframe by keyframe."""
    runner = _place_graph(voxel_m=0.2, min_component_size=1)
    laps: list[list[float]] = []
    sizes: list[int] = []
    while not sizes or sizes[-1] < MANY_PLACES:
        spent: list[float] = []
        for keyframe in keyframes:
            number = len(laps) * len(keyframes) + len(spent)
            pose = np.array(keyframe.world_from_camera)
            pose[:2, 3] += LAP_M * np.array(divmod(len(laps), 8))
            moved = msgspec.structs.replace(keyframe, frame_id=number, stamp_ns=number * 10**11, world_from_camera=pose)
            started_s = time.process_time()
            runner.feed(moved)
            spent.append(time.process_time() - started_s)
        laps.append(spent)
        sizes.append(len(runner.state.graph.places))
    few, many = (np.median(laps[part], axis=0) for part in (slice(0, 5), slice(-5, None)))
    return {
        "growth": float(np.median(many / few)),
        "growth_total": float(many.sum() / few.sum()),
        "growth_places_small": float(sizes[0]),
        "growth_places_large": float(sizes[-1]),
        "map_mb_at_10000": runner.state.map_bytes / 1e6,
    }

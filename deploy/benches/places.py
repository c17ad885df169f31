"""The place graph: time per keyframe, split by stage, against the size of the map, and memory."""

import cProfile
import pstats
import resource
import time
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from prior_sg.schemas.frames import Keyframe
from prior_sg.services.registry import BY_NAME
from prior_sg.services.runtime.runner import Runner
from prior_sg.services.runtime.service import Identity

PLACE_STAGES = {  # functions of the place graph whose time makes a stage
    "decode": ("images.depth_of",),
    "fuse": ("tsdf.integrate",),
    "distances": ("distance.refresh",),
    "places": ("places.extract",),
    "edges": ("graph.PlaceGraph.update",),
    "frontiers": ("frontiers.Openings.renew",),
    "publish": ("published.Published.update",),
}
LAP_M, MANY_PLACES = 25.6, 10_000  # a lap of the sample lies so far beside the one before, in whole blocks of voxels


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
    seconds: dict[str, float] = {}
    for (file, _, function), (*_, cumulative, _) in pstats.Stats(profile).stats.items():  # type: ignore[attr-defined]
        seconds[f"{Path(file).stem}.{function}"] = cumulative
    stages = {
        f"stage_ms_{stage}": 1e3 * sum(seconds.get(_bare(name), 0.0) for name in names) / len(keyframes)
        for stage, names in PLACE_STAGES.items()
    }
    return spent, stages


def _bare(name: str) -> str:
    """Module and function, without the class: what the profiler knows."""
    module, *_, function = name.split(".")
    return f"{module}.{function}"


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
        "map_mb_at_10000": runner.state.grid.size_bytes / 1e6,
    }

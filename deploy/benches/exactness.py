"""How exact and how steady places are, against the raw depth they were made from: `prior-sg bench places --on PATH…`
prints a table, a row for each recording or world and each preset.

**Too wide** is a place whose sphere holds a measured surface more than WRONG_M inside; surfaces are all points of the
depth images within the map's range (`too_wide`), or those that other keyframes agree with (`too_wide_agreed`): noise
and flying pixels of one image are seen through by others. **Too narrow** is one whose sphere ends more than WRONG_M
before the nearest point that keyframes agree with. Both are means over offsets of the grid, with the worst.

**Found again** is a place that has another within FOUND_M in a second map of the same scene: on a shifted grid, from
keyframes in another order, from another walk (of a recording the keyframes between; of a world the passer-by's).
"""

import itertools
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
from scipy.spatial import cKDTree

from prior_sg.schemas.frames import Keyframe
from prior_sg.schemas.places import SnapshotRequest
from prior_sg.schemas.topics import KEYFRAME, PLACE_SNAPSHOT
from prior_sg.services import images
from prior_sg.services.geometry import back_project, inverse, transform
from prior_sg.services.ingest.sources import open_source
from prior_sg.services.place_graph.core.config import Config
from prior_sg.services.registry import BY_NAME
from prior_sg.services.runtime.config import resolve
from prior_sg.services.runtime.runner import Runner
from prior_sg.services.runtime.service import Identity

OFFSETS_M = (0.0, 0.025, 0.05, 0.075)  # of the grid, along all three axes
WRONG_M = 0.5  # a radius farther off is wrong
FOUND_M = 0.2  # a place at most so far away is the same one
EVERY_PX = 6  # of the depth images in each direction
POINT_M = 0.05  # of the points in a cube of this side one is asked whether keyframes agree with it
HIT_M, THROUGH_M, NOISE_PER_M = 0.05, 0.15, 0.01  # depth z agrees to HIT_M + NOISE_PER_M z^2, and sees through beyond
WORLD = "world:"
PRESETS = ("indoor", "habitat", "mixed")  # voxels of 0.1 m, of 0.2 m, and a map of 0.1 m with a field of 0.2 m
COLUMNS = (
    "scene, preset",
    "keyframes",
    "places",
    "ms p50/p99",
    "map MB",
    "too wide %",
    "of agreed %",
    "too narrow %",
    "found: grid, order, walk %",
)


class Places(NamedTuple):
    """A finished map, with its grid moved back, and what each keyframe took."""

    positions_m: np.ndarray  # (place, 3)
    radii_m: np.ndarray  # (place,)
    spent_ms: list[float]  # of processor time
    map_mb: float


class Walk(NamedTuple):
    """Keyframes of one scene, and those of another walk through it."""

    keyframes: list[Keyframe]
    other: list[Keyframe]


def exactness_bench(
    paths: Sequence[Path], presets: Sequence[str], report: Callable[[str], None]
) -> tuple[dict[str, float], dict[str, Any]]:
    """Figures of the given recordings and worlds, each with each preset of the place graph; `report` hears which.

    Raises SourceError or EvaluationError.
    """
    metrics: dict[str, float] = {}
    for path in paths:
        walk, name = walk_of(path), str(path) if str(path).startswith(WORLD) else path.name
        for preset in presets:
            report(f"{name}, {preset}")
            cfg = resolve(BY_NAME["place_graph"].config, "place_graph", {"place_graph": {"preset": preset}})
            metrics |= {f"{name} {preset} {key}": value for key, value in measured(walk, cfg).items()}
    return metrics, {"offsets_m": OFFSETS_M, "wrong_m": WRONG_M, "found_m": FOUND_M, "clock": "processor time"}


def table(metrics: Mapping[str, float]) -> list[list[str]]:
    """What `exactness_bench` found, as rows of COLUMNS; shares that depend on the grid as mean (least to greatest)."""
    scenes: dict[str, dict[str, float]] = {}
    for name, value in metrics.items():
        scene, key = name.rsplit(" ", 1)
        scenes.setdefault(scene, {})[key] = value
    return [[scene, *_cells(found)] for scene, found in scenes.items()]


def _cells(of: Mapping[str, float]) -> list[str]:
    def ranged(key: str) -> str:
        return f"{100 * of[key]:.1f} ({100 * of[f'{key}_least']:.1f}-{100 * of[f'{key}_worst']:.1f})"

    return [
        f"{of['keyframes']:.0f}",
        f"{of['places']:.0f}",
        f"{of['ms_p50']:.1f}/{of['ms_p99']:.1f}",
        f"{of['map_mb']:.1f}",
        *(ranged(key) for key in ("too_wide", "too_wide_agreed", "too_narrow")),
        ", ".join(f"{100 * of[f'found_{how}']:.0f}" for how in ("grid", "order", "walk")),
    ]


def measured(walk: Walk, cfg: Config) -> dict[str, float]:
    """One row of the table."""
    points_m = measured_points(walk.keyframes, cfg.max_range_m)
    raw, agreed = cKDTree(points_m), cKDTree(agreed_points(points_m, walk.keyframes))
    places_of(walk.keyframes[:3], cfg)  # loads the compiled kernels
    maps = [places_of(walk.keyframes, cfg, offset_m) for offset_m in OFFSETS_M]
    spent_ms = np.concatenate([each.spent_ms for each in maps])
    shares = {
        key: [np.mean(side * (each.radii_m - tree.query(each.positions_m)[0]) > WRONG_M) for each in maps]
        for key, side, tree in (("too_wide", 1, raw), ("too_wide_agreed", 1, agreed), ("too_narrow", -1, agreed))
    }
    order = np.random.default_rng(7).permutation(len(walk.keyframes))
    fearless = msgspec.structs.replace(cfg, max_speed_m_s=0.0)  # in another order, or with some left out, poses jump
    reordered = places_of([walk.keyframes[row] for row in order], fearless)
    one = maps[0] if walk.other else places_of(walk.keyframes[::2], fearless)
    other = places_of(walk.other or walk.keyframes[1::2], fearless)
    return {
        "keyframes": float(len(walk.keyframes)),
        "places": float(np.mean([len(each.radii_m) for each in maps])),
        "ms_p50": float(np.percentile(spent_ms, 50)),
        "ms_p99": float(np.percentile(spent_ms, 99)),
        "map_mb": maps[0].map_mb,
        "radius_m": float(np.mean(np.concatenate([each.radii_m for each in maps]))),
        **{key: float(np.mean(each)) for key, each in shares.items()},
        **{f"{key}_least": float(min(each)) for key, each in shares.items()},
        **{f"{key}_worst": float(max(each)) for key, each in shares.items()},
        "found_grid": float(np.mean([found(*pair) for pair in itertools.permutations(maps, 2)])),
        "found_order": found(reordered, maps[0]),
        "found_walk": found(other, one),
    }


def places_of(keyframes: Sequence[Keyframe], cfg: Config, offset_m: float = 0.0) -> Places:
    """The places of a map whose grid is moved by `offset_m` against the scene along all axes.

    Keyframes are counted from 0 on: a map that begins with another one waits for the archive.
    """
    runner = Runner(BY_NAME["place_graph"], cfg, Identity("bench", "b", 1))
    spent_ms = []
    for number, keyframe in enumerate(keyframes):
        pose = np.array(keyframe.world_from_camera)
        pose[:3, 3] += offset_m
        shifted = msgspec.structs.replace(keyframe, robot="bench", frame_id=number, world_from_camera=pose)
        started_s = time.process_time()
        runner.feed(shifted)
        spent_ms.append(1e3 * (time.process_time() - started_s))
    told = runner.answer(PLACE_SNAPSHOT, SnapshotRequest(robot="bench"))
    positions_m = np.asarray(told.positions_m, np.float64) - offset_m
    return Places(positions_m, np.asarray(told.radii_m, np.float64), spent_ms, runner.state.map_bytes / 1e6)


def found(places: Places, others: Places) -> float:
    """Share of places that have one of the others at their position."""
    if not (len(places.positions_m) and len(others.positions_m)):
        return 0.0
    return float(np.mean(cKDTree(others.positions_m).query(places.positions_m)[0] <= FOUND_M))


def measured_points(keyframes: Sequence[Keyframe], max_range_m: float) -> np.ndarray:
    """Points (n, 3) of the world at which depth images end, within range."""
    clouds = []
    for keyframe in keyframes:
        points = back_project(images.depth_of(keyframe, 1.0), keyframe.intrinsics)[::EVERY_PX, ::EVERY_PX]
        points = points.reshape(-1, 3)
        within = (points[:, 2] > 0) & (np.linalg.norm(points, axis=1) < max_range_m)
        clouds.append(transform(keyframe.world_from_camera, points[within]))
    return np.concatenate(clouds)


def agreed_points(points_m: np.ndarray, keyframes: Sequence[Keyframe]) -> np.ndarray:
    """Those of the points (n, 3), one in each cube of POINT_M, that more keyframes measure than see through."""
    cubes = np.floor(points_m / POINT_M).astype(np.int64)
    points_m = points_m[np.unique(cubes, axis=0, return_index=True)[1]]
    balance = np.zeros(len(points_m), np.int64)
    for keyframe in keyframes:
        rows, around_m, depth_m = _projected(points_m, keyframe)
        slack_m = NOISE_PER_M * depth_m**2
        measured = (around_m > 0) & (np.abs(around_m - depth_m) < HIT_M + slack_m)
        through = (around_m > 0) & (around_m > depth_m + THROUGH_M + slack_m)
        balance[rows] += measured.any(axis=0).astype(np.int64) - through.all(axis=0)
    return points_m[balance > 0]


def _projected(points_m: np.ndarray, keyframe: Keyframe) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows of the points in the image, the depths (9, n) of the pixels around each, and its own depth (n,)."""
    camera, depth_m = keyframe.intrinsics, images.depth_of(keyframe, 1.0)
    points = transform(inverse(keyframe.world_from_camera), points_m)
    rows = np.flatnonzero(points[:, 2] > 0.1)
    x, y, z = points[rows].T
    u = np.rint(camera.fx_px * x / z + camera.cx_px).astype(np.int64)
    v = np.rint(camera.fy_px * y / z + camera.cy_px).astype(np.int64)
    inside = (u >= 1) & (v >= 1) & (u < camera.width_px - 1) & (v < camera.height_px - 1)
    u, v = u[inside], v[inside]
    around_m = np.stack([depth_m[v + dv, u + du] for dv in (-1, 0, 1) for du in (-1, 0, 1)])
    return rows[inside], around_m, z[inside]


def walk_of(path: Path) -> Walk:
    """The keyframes of a recording or a world. Raises SourceError or EvaluationError."""
    if not str(path).startswith(WORLD):
        return Walk(_keyframes(open_source(path)), [])
    from prior_sg.deploy.evaluation.datasets import named_worlds, world_source  # compiles the worlds' loops

    name = named_worlds(str(path))[0]
    return Walk(_keyframes(world_source(name)), _keyframes(world_source(name, "passer-by")))


def _keyframes(source: Any) -> list[Keyframe]:
    ingest = BY_NAME["ingest"]
    runner = Runner(ingest, ingest.config(), Identity("bench", "ingest", 1))
    written = itertools.chain.from_iterable(runner.feed(frame) for frame in source)
    return [message for topic, message in written if topic is KEYFRAME and isinstance(message, Keyframe)]

"""How true 2D places are: `python -m prior_sg.deploy.benches.ground SOURCE…`, a world such as `world:house:60` or a
sequence with the boxes of its objects.

`--out FOLDER` also draws each. `--range 100` gives a world's camera that range, with exact depth as of a lidar, for
mapping as far (`--set max_range_m=100`) and measuring what it costs.

In a world the ground is what a person reaches on foot. In a sequence it is the floor at height zero outside all boxes
of objects: of as much of it as the depth images show.
"""

import argparse
import dataclasses
import json
import resource
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from scipy.spatial import cKDTree

from prior_sg.deploy.benches.ground_pictures import Seen, drawn
from prior_sg.deploy.benches.places import keyframes_of
from prior_sg.deploy.evaluation.datasets import WORLD, WorldName, named_worlds, world_source
from prior_sg.deploy.evaluation.worlds import World, world_of
from prior_sg.deploy.evaluation.worlds.ways import ways_of
from prior_sg.deploy.evaluation.worlds.world import depths
from prior_sg.deploy.truth import TrueObject, read_objects
from prior_sg.schemas.frames import Keyframe
from prior_sg.services import images
from prior_sg.services.geometry import back_project, transform
from prior_sg.services.ingest.sources import open_source
from prior_sg.services.place_graph.core.config import preset
from prior_sg.services.registry import BY_NAME
from prior_sg.services.runtime.runner import Runner
from prior_sg.services.runtime.service import Identity

NEAR_M = 0.15  # of the ground, along each axis
CELL_M = 0.1
EVERY_PX = 2  # of the depth images in each direction
POINT_M = 0.05  # of the points in a cube of this side one is kept
FLAT_M = 0.06  # of the floor: what a depth image shows within is of it
LOW_M = 0.25  # lower objects are driven over: rugs
STAIR_M = 0.3  # above and below all floors
TOP = np.array((0.5, 0.5, 1.0))  # of a voxel
RANGE_M = 5.0  # farther measurements are not mapped either


class TrueGround(NamedTuple):
    """Points (n, 3) in metres: the ground there is, and what was seen of it."""

    every_m: np.ndarray
    seen_m: np.ndarray


class Mapped(NamedTuple):
    """A place graph that has seen all frames, points (n, 3) that these show, and what each took."""

    runner: Runner
    points_m: np.ndarray
    spent_ms: list[float]  # of processor time
    largest_mb: float  # the map was at any time


def main() -> None:
    """Print one line of JSON for each source, and draw it if a folder is given."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sources", nargs="+")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="of the place graph")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="write a picture of each source here")
    parser.add_argument("--range", type=float, default=0.0, metavar="METRES", help="of the camera in a world")
    args = parser.parse_args()
    settings = {name: json.loads(value) for name, value in (text.split("=", 1) for text in args.set)}
    for text in args.sources:
        for name in named_worlds(text) if text.startswith(WORLD) else [None]:
            named = f"{WORLD}{name.kind}:{name.seed}" if name else Path(text).name
            picture = args.out / f"{named.replace(':', '-')}.png" if args.out else None
            print(json.dumps({"source": named} | measured(text, name, settings, picture, args.range)), flush=True)


def measured(
    path: str,
    name: WorldName | None,
    settings: dict[str, Any],
    picture: Path | None = None,
    range_m: float = 0.0,
) -> dict[str, float | None]:
    """Shares of one source: places that stand on true ground, their area that does, and true ground that they cover."""
    world = world_of(name.kind, name.seed) if name else None
    usual = {"preset": "outdoor"} if world is not None and world.outdoors else {}
    source = world_source(name) if name else open_source(path)
    if world is not None and range_m:
        frames = seen_as_far(dataclasses.replace(world, range_m=range_m))
    else:
        frames = keyframes_of(source)
    mapped = _mapped(frames, usual | settings)
    points_m = mapped.points_m
    truth = _of_world(world, points_m) if world else _of_sequence(read_objects(Path(path)), points_m)
    state, voxel_m = mapped.runner.state, mapped.runner.cfg.voxel_m
    pieces = [piece for i, piece in state.graph.pieces.items() if i in state.ledger.places]
    tops_m = [(piece.voxels + TOP) * voxel_m for piece in pieces]
    tree = cKDTree(truth.every_m)
    near_m = max(NEAR_M, 0.75 * voxel_m)
    true = [tree.query(top_m, p=np.inf)[0] <= near_m for top_m in tops_m]
    covered = cKDTree(np.concatenate(tops_m)).query(truth.seen_m, p=np.inf)[0] <= near_m
    floors_m = np.array([region.z_min_m for region in world.truth.regions] if world else [0.0])
    if picture:
        picture.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(picture), drawn(Seen(truth.every_m, truth.seen_m, tops_m, true), floors_m, CELL_M, voxel_m))
    stairs = (np.abs(truth.seen_m[:, 2:] - floors_m) > STAIR_M).all(axis=1)
    return {
        "places": len(pieces),
        "places_true": float(np.mean([share.mean() >= 0.5 for share in true])),
        "area_true": float(np.concatenate(true).mean()),
        "covered": float(covered.mean()),
        "stairs_covered": float(covered[stairs].mean()) if stairs.any() else None,
        "ms_p50": round(float(np.percentile(mapped.spent_ms, 50)), 1),
        "ms_p99": round(float(np.percentile(mapped.spent_ms, 99)), 1),
        "map_mb": round(state.grid.size_bytes / 1e6, 1),
        "map_mb_at_most": round(mapped.largest_mb, 1),
        "peak_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3),
    }


def seen_as_far(world: World) -> Iterator[Keyframe]:
    """What a camera of the world's range would measure without noise, along the world's walk."""
    camera, scale_m = world.intrinsics, world.range_m / np.iinfo(np.uint16).max
    shape = (camera.height_px, camera.width_px)
    rays = back_project(np.ones(shape), camera).reshape(-1, 3)
    opaque = np.ones(len(rays))
    for number, (stamp_ns, pose) in enumerate(zip(world.stamps_ns.tolist(), world.world_from_camera, strict=True)):
        depth_m, _ = depths(world, pose, rays, opaque)
        units = np.floor(depth_m.reshape(shape) / scale_m).astype(np.uint16)
        yield Keyframe(
            robot="bench",
            frame_id=number,
            stamp_ns=stamp_ns,
            intrinsics=camera,
            world_from_camera=pose,
            color=b"",
            depth=cv2.imencode(".png", units)[1].tobytes(),
            depth_scale_m=scale_m,
        )


def _mapped(keyframes: Iterable[Keyframe], settings: dict[str, Any]) -> Mapped:
    named = {"name": "indoor"} | {"name" if key == "preset" else key: value for key, value in settings.items()}
    config = preset(**named, places="2d")
    runner, shown = Runner(BY_NAME["place_graph"], config, Identity("bench", "b", 1)), []
    spent_ms, largest_mb = [], 0.0
    for keyframe in keyframes:
        started_s = time.process_time()
        runner.feed(keyframe)
        spent_ms.append(1e3 * (time.process_time() - started_s))
        largest_mb = max(largest_mb, runner.state.map_bytes / 1e6)
        shown.append(_points_m(keyframe, max(RANGE_M, config.max_range_m)))
    return Mapped(runner, np.concatenate(shown), spent_ms, largest_mb)


def _points_m(keyframe: Keyframe, range_m: float) -> np.ndarray:
    depth_m = images.depth_of(keyframe, images.MAX_PRINCIPAL_OFFSET)
    points_camera_m = back_project(depth_m, keyframe.intrinsics)[::EVERY_PX, ::EVERY_PX].reshape(-1, 3)
    within = (points_camera_m[:, 2] > 0) & (points_camera_m[:, 2] < range_m)
    points_m = transform(keyframe.world_from_camera, points_camera_m[within])
    return points_m[np.unique(np.floor(points_m / POINT_M).astype(np.int64), axis=0, return_index=True)[1]]


def _of_world(world: World, points_m: np.ndarray) -> TrueGround:
    ways = ways_of(world.grid, world.origin_m, world.voxel_m)
    nodes = np.flatnonzero(ways.heights.ravel() >= 0)
    grounds_m = ways.position_m(nodes)
    camera_m = world.world_from_camera[0, :3, 3]
    apart_m = np.abs(grounds_m[:, :2] - camera_m[:2]).max(axis=1) + np.where(grounds_m[:, 2] < camera_m[2], 0.0, 1e3)
    start = nodes[np.lexsort((-grounds_m[:, 2], apart_m.round(1)))[0]]
    every_m = ways.position_m(np.flatnonzero(ways.reached(int(start), 1)))
    seen = cKDTree(points_m).query(every_m, p=np.inf)[0] <= CELL_M
    return TrueGround(every_m, every_m[seen])


def _of_sequence(objects: tuple[TrueObject, ...], points_m: np.ndarray) -> TrueGround:
    floor_m = points_m[np.abs(points_m[:, 2]) < FLAT_M]
    for item in objects:
        if item.max_m[2] >= LOW_M and item.min_m[2] < 1.0:
            inside = ((floor_m[:, :2] >= item.min_m[:2]) & (floor_m[:, :2] <= item.max_m[:2])).all(axis=1)
            floor_m = floor_m[~inside]
    cells = np.unique(np.floor(floor_m[:, :2] / CELL_M).astype(np.int64), axis=0)
    every_m = np.column_stack(((cells + 0.5) * CELL_M, np.zeros(len(cells))))
    return TrueGround(every_m, every_m)


if __name__ == "__main__":
    main()

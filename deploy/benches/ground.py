"""How true 2D places are: `python -m prior_sg.deploy.benches.ground SOURCE…`, a world such as `world:house:60` or a
sequence with the boxes of its objects.

In a world the ground is what a person reaches on foot. In a sequence it is the floor at height zero outside all boxes
of objects: of as much of it as the depth images show.
"""

import argparse
import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from prior_sg.deploy.benches.places import keyframes_of
from prior_sg.deploy.evaluation.datasets import WORLD, WorldName, named_worlds, world_source
from prior_sg.deploy.evaluation.worlds import World, world_of
from prior_sg.deploy.evaluation.worlds.ways import ways_of
from prior_sg.deploy.truth import TrueObject, read_objects
from prior_sg.schemas.frames import Keyframe
from prior_sg.services import images
from prior_sg.services.geometry import back_project, transform
from prior_sg.services.ingest.sources import Source, open_source
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


def main() -> None:
    """Print one line of JSON for each source."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sources", nargs="+")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="of the place graph")
    args = parser.parse_args()
    settings = {name: json.loads(value) for name, value in (text.split("=", 1) for text in args.set)}
    for text in args.sources:
        for name in named_worlds(text) if text.startswith(WORLD) else [None]:
            named = f"{WORLD}{name.kind}:{name.seed}" if name else Path(text).name
            print(json.dumps({"source": named} | measured(text, name, settings)), flush=True)


def measured(path: str, name: WorldName | None, settings: dict[str, Any]) -> dict[str, float | None]:
    """Shares of one source: places that stand on true ground, their area that does, and true ground that they cover."""
    world = world_of(name.kind, name.seed) if name else None
    usual = {"preset": "outdoor"} if world is not None and world.outdoors else {}
    runner, points_m = _mapped(world_source(name) if name else open_source(path), usual | settings)
    truth = _of_world(world, points_m) if world else _of_sequence(read_objects(Path(path)), points_m)
    state, voxel_m = runner.state, runner.cfg.voxel_m
    pieces = [piece for i, piece in state.graph.pieces.items() if i in state.ledger.places]
    tops_m = [(piece.voxels + TOP) * voxel_m for piece in pieces]
    tree = cKDTree(truth.every_m)
    near_m = max(NEAR_M, 0.75 * voxel_m)
    true = [tree.query(top_m, p=np.inf)[0] <= near_m for top_m in tops_m]
    covered = cKDTree(np.concatenate(tops_m)).query(truth.seen_m, p=np.inf)[0] <= near_m
    floors_m = np.array([region.z_min_m for region in world.truth.regions] if world else [0.0])
    stairs = (np.abs(truth.seen_m[:, 2:] - floors_m) > STAIR_M).all(axis=1)
    return {
        "places": len(pieces),
        "places_true": float(np.mean([share.mean() >= 0.5 for share in true])),
        "area_true": float(np.concatenate(true).mean()),
        "covered": float(covered.mean()),
        "stairs_covered": float(covered[stairs].mean()) if stairs.any() else None,
        "map_mb": round(state.grid.size_bytes / 1e6, 1),
    }


def _mapped(source: Source, settings: dict[str, Any]) -> tuple[Runner, np.ndarray]:
    """A place graph that has seen all frames, and points (n, 3) that these show, in the world."""
    named = {"name": "indoor"} | {"name" if key == "preset" else key: value for key, value in settings.items()}
    config = preset(**named, places="2d")
    runner, shown = Runner(BY_NAME["place_graph"], config, Identity("bench", "b", 1)), []
    for keyframe in keyframes_of(source):
        runner.feed(keyframe)
        shown.append(_points_m(keyframe, max(RANGE_M, config.max_range_m)))
    return runner, np.concatenate(shown)


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

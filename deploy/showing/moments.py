"""What a recorded log tells beside its final scene: how the scene came about, the surface's colours, the settings."""

from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from prior_sg.deploy.showing.material import Cloud, Moment
from prior_sg.schemas.codec import decode
from prior_sg.schemas.frames import Keyframe, PoseUpdate
from prior_sg.schemas.objects import ObjectDelta
from prior_sg.schemas.places import PlaceDelta
from prior_sg.schemas.regions import RegionDelta
from prior_sg.schemas.status import Consumed, Started
from prior_sg.schemas.topics import JOURNAL, KEYFRAME, OBJECT_DELTA, PLACE_DELTA, POSE_UPDATE, REGION_DELTA
from prior_sg.services.deltas import Follower, PoseCorrections
from prior_sg.services.images import MAX_PRINCIPAL_OFFSET, ImageFault, color_of, depth_of
from prior_sg.services.runtime.record import read_log
from prior_sg.services.scene_store.core import graph as store

CLOUD_FRAMES, CLOUD_POINTS, PIXEL_STEP, CLOUD_VOXEL_M = 60, 400_000, 4, 0.04
DELTAS = (PLACE_DELTA, REGION_DELTA, OBJECT_DELTA)


def moments_of(log: Path, robot: str, count: int) -> list[Moment]:
    """The scene of a robot after evenly many deltas of a log, at most `count`, the last included. Raises LogError."""
    deltas: list[Any] = [decode(logged.topic.type, logged.payload) for logged in read_log(log, DELTAS)]
    deltas = [delta for delta in deltas if delta.robot == robot]
    wanted = set(np.linspace(len(deltas) - 1, 0, min(count, len(deltas))).round().astype(int).tolist())
    graph = store.Graph(robot)
    followers: dict[type, Follower[Any]] = {kind: Follower() for kind in (PlaceDelta, RegionDelta, ObjectDelta)}
    found = []
    for row, delta in enumerate(deltas):
        _apply(graph, followers[type(delta)], delta)
        if row in wanted:
            found.append(Moment(graph.revision, store.scene(graph)))
    return found


def _apply(graph: store.Graph, follower: Follower[Any], delta: PlaceDelta | RegionDelta | ObjectDelta) -> None:
    if isinstance(delta, PlaceDelta):
        store.note_cameras(graph, delta)
    for due in follower.take(delta):
        match due:
            case PlaceDelta():
                store.apply_places(graph, due)
            case RegionDelta():
                store.apply_regions(graph, due)
            case ObjectDelta():
                store.apply_objects(graph, due)


def cloud_of(log: Path, robot: str) -> Cloud | None:
    """Coloured points of a log's keyframes, one per cell of 4 cm, at their corrected poses; None where there are none.

    Keyframes are read in turn, so that memory stays small; images that cannot be decoded are left out, as in the map.
    """
    total = sum(1 for logged in read_log(log, (KEYFRAME,)))
    step = max(1, total // CLOUD_FRAMES)
    corrections = PoseCorrections()
    for logged in read_log(log, (POSE_UPDATE,)):
        if (update := decode(PoseUpdate, logged.payload)).robot == robot:
            corrections.take(update)
    points, colors = [], []
    for row, logged in enumerate(read_log(log, (KEYFRAME,))):
        keyframe = decode(Keyframe, logged.payload) if row % step == 0 else None
        if keyframe is None or keyframe.robot != robot:
            continue
        try:
            found = _surface(keyframe, corrections.pose(keyframe.frame_id, keyframe.world_from_camera))
        except ImageFault:
            continue
        points.append(found.points_world)
        colors.append(found.colors)
    return _thinned(Cloud(np.concatenate(points), np.concatenate(colors))) if points else None


def _surface(keyframe: Keyframe, world_from_camera: np.ndarray) -> Cloud:
    """Every fourth pixel of a keyframe with a measurement."""
    camera, grid = keyframe.intrinsics, np.s_[::PIXEL_STEP, ::PIXEL_STEP]
    depth_m, color = depth_of(keyframe, MAX_PRINCIPAL_OFFSET)[grid], color_of(keyframe)[grid]
    v, u = np.nonzero(depth_m)
    z_m = depth_m[v, u].astype(float)
    rays = np.stack(
        ((u * PIXEL_STEP - camera.cx_px) / camera.fx_px, (v * PIXEL_STEP - camera.cy_px) / camera.fy_px), axis=1
    )
    points_camera = np.concatenate((rays, np.ones((len(rays), 1))), axis=1) * z_m[:, None]
    points_world = points_camera @ world_from_camera[:3, :3].T + world_from_camera[:3, 3]
    return Cloud(points_world.astype(np.float32), color[v, u])


def _thinned(cloud: Cloud) -> Cloud:
    cells = np.floor(cloud.points_world / CLOUD_VOXEL_M).astype(np.int32)
    _, rows = np.unique(cells, axis=0, return_index=True)
    rows = rows[:: max(1, -(-len(rows) // CLOUD_POINTS))]
    return Cloud(cloud.points_world[rows], cloud.colors[rows])


def settings_of(log: Path) -> dict[str, dict[str, Any]]:
    """The settings each service of a log last started with. Raises LogError."""
    found: dict[str, dict[str, Any]] = {}
    for logged in read_log(log, (JOURNAL,)):
        entry = decode(Consumed, logged.payload)
        if entry.topic == "START":
            found[entry.service] = msgspec.json.decode(decode(Started, entry.inline).config)
    return dict(sorted(found.items()))

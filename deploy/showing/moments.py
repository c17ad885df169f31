"""What is told beside a final scene: how it came about, and of a log the surface's colours and the settings."""

import contextlib
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from prior_sg.deploy.api.history import History
from prior_sg.deploy.showing.material import Cloud, Moment
from prior_sg.schemas.codec import DecodeError, decode
from prior_sg.schemas.frames import Keyframe, PoseUpdate
from prior_sg.schemas.status import Started
from prior_sg.schemas.topics import JOURNAL, KEYFRAME, POSE_UPDATE
from prior_sg.services.deltas import PoseCorrections
from prior_sg.services.images import MAX_PRINCIPAL_OFFSET, ImageFault, color_of, depth_of
from prior_sg.services.refusals import InputRefused
from prior_sg.services.runtime.record import LogError, read_log

CLOUD_FRAMES, CLOUD_POINTS, PIXEL_STEP, CLOUD_VOXEL_M = 60, 400_000, 4, 0.04


def moments_of(history: History, robot: str, count: int) -> list[Moment]:
    """The scene of a robot at evenly many of the revisions that are kept, at most `count`, the last included."""
    kept = [entry.revision for entry in history.revisions(robot)]
    wanted = sorted(set(np.linspace(len(kept) - 1, 0, min(count, len(kept))).round().astype(int).tolist()))
    return [Moment(kept[row], history.scene(robot, kept[row]).message) for row in wanted]


def cloud_of(log: Path, robot: str) -> Cloud | None:
    """Coloured points of a log's keyframes, one per cell of 4 cm, at their corrected poses; None where there are none.

    Keyframes are read in turn, so that memory stays small; images that cannot be decoded are left out, as in the map.
    """
    total = sum(1 for logged in read_log(log, (KEYFRAME,)))
    step = max(1, total // CLOUD_FRAMES)
    corrections = PoseCorrections()
    for logged in read_log(log, (POSE_UPDATE,)):
        with contextlib.suppress(DecodeError, InputRefused):  # nobody took it either
            if (update := decode(PoseUpdate, logged.payload)).robot == robot:
                corrections.take(update)
    points, colors = [], []
    for row, logged in enumerate(read_log(log, (KEYFRAME,))):
        if row % step:
            continue
        try:
            keyframe = decode(Keyframe, logged.payload)
            if keyframe.robot != robot:
                continue
            found = _surface(keyframe, corrections.pose(keyframe.frame_id, keyframe.world_from_camera))
        except (DecodeError, ImageFault):
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
        entry = logged.message()
        if entry.topic == "START":
            try:
                found[entry.service] = msgspec.json.decode(decode(Started, entry.inline).config)
            except (msgspec.MsgspecError, DecodeError, RecursionError) as error:
                raise LogError(f"the settings of {entry.service} in {log} cannot be read: {error}") from error
    return dict(sorted(found.items()))

"""Replica sequences as rendered for NICE-SLAM.

traj.txt              a line per frame: sixteen numbers of world_from_camera, row by row
results/frame*.jpg    8 bit; results/depth*.png 16 bit, times `scale` per metre (6553.5)
cam_params.json       {"camera": {w h fx fy cx cy scale}}, beside traj.txt or, as published, one folder above

Camera axes are x right, y down, z forward (the publisher's loader turns y and z to reach OpenGL's). The world is that
of Replica's meshes, z up; zero is not the floor. Line i belongs to the i-th number. Frames have no stamps: 30 Hz are
assumed. Ground truth: poses only; regions.json is read where one lies beside traj.txt.
Source: github.com/cvg/nice-slam, src/utils/datasets.py, configs/Replica/replica.yaml, scripts/download_replica.sh.
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from prior_sg.services.ingest.sources.base import (
    UP,
    Entry,
    FrameError,
    Rig,
    Source,
    SourceError,
    camera_of,
    file_of,
    levelling,
    matrix_pose,
    numbered,
    read_json,
    sequence,
    table,
)

POSES, IMAGES, CAMERA = "traj.txt", "results", "cam_params.json"
LOOKS = f"{POSES} and {IMAGES}/frame*.jpg (Replica folder)"
FRAME_NS = 1e9 / 30


def fits(path: Path) -> bool:
    """Whether a folder has this layout."""
    return (path / POSES).is_file() and (path / IMAGES).is_dir()


def load(path: Path, world_up: Sequence[float] = (), floor_m: float = 0.0) -> Source:
    """A Replica folder as a source. Raises SourceError."""
    file = path / CAMERA if (path / CAMERA).is_file() else path.resolve().parent / CAMERA
    camera = read_json(file)
    try:
        camera = dict(camera["camera"])
        scale = float(camera["scale"])
    except (KeyError, TypeError, ValueError) as error:
        raise SourceError(f"{file} is not a camera: {error!r}") from error
    if not scale > 0:
        raise SourceError(f"{file} is not a camera: scale must be positive")
    intrinsics = camera_of(file, camera | {"width": camera.get("w"), "height": camera.get("h")})
    colors, depths = numbered(path / IMAGES, r"frame(\d+)\.jpg"), numbered(path / IMAGES, r"depth(\d+)\.png")
    poses = table(path / POSES, 1)
    numbers = sorted(colors.keys() | depths.keys())
    entries = [
        Entry(number, round(number * FRAME_NS), partial(_read, colors, depths, poses, number)) for number in numbers
    ]
    rig = Rig(intrinsics, 1 / scale, len(entries), levelling(world_up or UP, floor_m))
    return sequence("replica", path, rig, entries)


def _read(
    colors: dict[int, Path], depths: dict[int, Path], poses: list[list[str]], number: int
) -> tuple[np.ndarray, bytes, bytes]:
    if number >= len(poses):
        raise FrameError(f"{POSES} has no line for it")
    pose = matrix_pose(" ".join(poses[number]))
    return pose, file_of(colors, number, "colour"), file_of(depths, number, "depth")

"""Replica sequences as rendered for NICE-SLAM.

traj.txt              a line per frame: sixteen numbers of world_from_camera, row by row
results/frame*.jpg    8 bit; results/depth*.png 16 bit, times `scale` per metre (6553.5)
cam_params.json       {"camera": {w h fx fy cx cy scale}}, beside traj.txt or, as published, one folder above

Camera axes are x right, y down, z forward (the publisher's loader turns y and z to reach OpenGL's). The world is that
of Replica's meshes, z up; zero is not the floor. Line i belongs to the i-th number. Frames have no stamps: 30 Hz are
assumed. Ground truth: poses only; regions.json is read where one lies beside traj.txt.
Source: github.com/cvg/nice-slam, src/utils/datasets.py, configs/Replica/replica.yaml, scripts/download_replica.sh.
"""

from functools import partial
from pathlib import Path

import numpy as np

from prior_sg.services.ingest.core.options import ReadOptions
from prior_sg.services.ingest.core.poses import Convention
from prior_sg.services.ingest.sources.base import (
    Entry,
    Found,
    FrameError,
    SourceError,
    camera_of,
    images_of,
    numbered,
    truth_beside,
)
from prior_sg.services.ingest.sources.tables import read_json, table

NAME = "replica"
POSES, IMAGES, CAMERA = "traj.txt", "results", "cam_params.json"
LOOKS = f"{POSES} and {IMAGES}/frame*.jpg (Replica folder)"
RATE_HZ = 30.0


def fits(path: Path) -> bool:
    """Whether a folder has this layout."""
    return (path / POSES).is_file() and (path / IMAGES).is_dir()


def load(path: Path, options: ReadOptions) -> Found:
    """A Replica folder. Raises SourceError."""
    file = path / CAMERA if (path / CAMERA).is_file() else path.resolve().parent / CAMERA
    camera = read_json(file)
    try:
        camera = dict(camera["camera"])
        scale = float(camera["scale"])
    except (KeyError, TypeError, ValueError) as error:
        raise SourceError(f"{file} is not a camera: {error!r}") from error
    if not scale > 0:
        raise SourceError(f"{file} is not a camera: scale must be positive")
    described = camera_of(file, camera | {"width": camera.get("w"), "height": camera.get("h")})
    colors, depths = numbered(path / IMAGES, r"frame(\d+)\.(?:jpg|png)"), numbered(path / IMAGES, r"depth(\d+)\.png")
    convention, poses = Convention().changed(options), table(path / POSES, 1)
    numbers = sorted(colors.keys() | depths.keys())
    ranked = len(poses) == len(numbers) and numbers[-1:] > [len(poses) - 1]  # numbers begin later, or have gaps
    return Found(
        NAME,
        path,
        described,
        1 / scale,
        [
            Entry(
                number,
                round(number * options.frame_ns(RATE_HZ)),
                partial(_pose, poses, line if ranked else number, convention),
                partial(images_of, colors, depths, number),
            )
            for line, number in enumerate(numbers)
        ],
        ground_truth=truth_beside(path),
        convention=convention,
        why=(f"{POSES} and {IMAGES}/ lie in it",),
        assumed_hz=0.0 if options.rate_hz else RATE_HZ,
    )


def _pose(poses: list[list[str]], number: int, convention: Convention) -> np.ndarray:
    if number >= len(poses):
        raise FrameError(f"{POSES} has no line for it")
    return convention.of_text(" ".join(poses[number]))

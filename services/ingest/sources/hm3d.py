"""Walks through HM3D scenes as HOV-SG renders them with habitat-sim.

rgb/SCENE_NNNNNN.png      8 bit (1080 x 720); depth/SCENE_NNNNNN.png 16 bit, millimetres, along the optical axis
pose/SCENE_NNNNNN.txt     sixteen numbers in one line: world_from_camera

Habitat's conventions: the world has y up, and the camera x right, y UP, z BACKWARD; the loader turns both. The images
span 90 degrees horizontally and have square pixels, so fx = fy = width / 2. The renderer's axis goes through the corner
between the middle pixels, which is (width - 1) / 2 where pixel 0 has its centre at 0 (HOV-SG writes width / 2, half a
pixel beside it). Zero is the scene's own; give the floor's height as floor_m. Steps of 0.2 m or 5 degrees without
stamps: 5 Hz are assumed, a metre per second. Ground truth: poses; HOV-SG's own graph of floors, regions and objects is
not read, regions.json is where one lies beside the folders.
Source: github.com/hovsg/HOV-SG, hovsg/data/hm3dsem/habitat_utils.py (save_obs, make_sensor_spec),
hovsg/data/hm3dsem/gen_hm3dsem_walks_from_poses.py and hovsg/dataloader/hm3dsem.py (_load_pose).
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.ingest.sources.base import (
    MILLIMETRE,
    Entry,
    Rig,
    Source,
    file_of,
    first_size,
    levelling,
    matrix_pose,
    numbered,
    sequence,
)

COLORS, DEPTHS, POSES = "rgb", "depth", "pose"
LOOKS = f"{COLORS}/*_NNNNNN.png, {DEPTHS}/ and {POSES}/*_NNNNNN.txt (HM3D walk)"
NAME = r"(?:.*[_-])?(\d+)\."
UP = (0.0, 1.0, 0.0)
FRAME_NS = 1e9 / 5
HABITAT_FROM_CAMERA = np.diag((1.0, -1.0, -1.0, 1.0))


def fits(path: Path) -> bool:
    """Whether a folder has this layout."""
    return (path / DEPTHS).is_dir() and bool(
        numbered(path / COLORS, NAME + "png") and numbered(path / POSES, NAME + "txt")
    )


def load(path: Path, world_up: Sequence[float] = (), floor_m: float = 0.0) -> Source:
    """An HM3D walk as a source. Raises SourceError."""
    colors, depths = numbered(path / COLORS, NAME + "png"), numbered(path / DEPTHS, NAME + "png")
    poses = numbered(path / POSES, NAME + "txt")
    width_px, height_px = first_size(list(colors.values()))
    focal_px = width_px / 2
    intrinsics = Intrinsics(width_px, height_px, focal_px, focal_px, (width_px - 1) / 2, (height_px - 1) / 2)
    entries = [
        Entry(number, round(number * FRAME_NS), partial(_read, colors, depths, poses, number))
        for number in sorted(colors.keys() | depths.keys() | poses.keys())
    ]
    rig = Rig(intrinsics, MILLIMETRE, len(entries), levelling(world_up or UP, floor_m))
    return sequence("hm3d", path, rig, entries)


def _read(
    colors: dict[int, Path], depths: dict[int, Path], poses: dict[int, Path], number: int
) -> tuple[np.ndarray, bytes, bytes]:
    pose = matrix_pose(file_of(poses, number, "pose")) @ HABITAT_FROM_CAMERA
    return pose, file_of(colors, number, "colour"), file_of(depths, number, "depth")

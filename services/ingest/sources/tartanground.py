"""TartanGround trajectories (and TartanAir V2, which has the same layout): the left front camera.

image_lcam_front/NNNNNN_lcam_front.png          8 bit, 640 x 640
depth_lcam_front/NNNNNN_lcam_front_depth.png    4 x 8 bit: the bytes, in OpenCV's channel order, of a little-endian
                                                32 bit float in metres along the optical axis; the sky is far away
pose_lcam_front.txt                             a line per frame: tx ty tz qx qy qz qw, world_from_camera in NED

NED: the world has x north, y east, z DOWN, and the camera x FORWARD, y right, z down; the loader turns both. The field
of view is 90 degrees, so fx = fy = width / 2, and the axis goes through the corner between the middle pixels: the
published 320 counts from the image's edge, which is 319.5 where pixel 0 has its centre at 0 (accumulate_pointcloud.py
adds the half pixel on the other side). Depth is re-encoded as millimetres; what is farther than 65.535 m has no
measurement. Images at 10 Hz. Zero is the environment's own. Ground truth: poses; semantic images are not regions and
are not read, regions.json is where one lies beside the poses.
Source: github.com/castacks/tartanairpy, docs/modalities.rst, docs/tartanground.rst, examples/accumulate_pointcloud.py.
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.ingest.sources.base import (
    MILLIMETRE,
    Entry,
    FrameError,
    Rig,
    Source,
    decode_image,
    first_size,
    levelling,
    millimetre_png,
    quaternion_pose,
    read_bytes,
    sequence,
    table,
)

CAMERA = "lcam_front"
POSES, COLORS, DEPTHS = f"pose_{CAMERA}.txt", f"image_{CAMERA}", f"depth_{CAMERA}"
LOOKS = f"{POSES}, {COLORS}/ and {DEPTHS}/ (TartanGround trajectory)"
UP = (0.0, 0.0, -1.0)
FRAME_NS = 1e9 / 10
NED_FROM_CAMERA = np.array(((0.0, 0, 1, 0), (1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 0, 1)))


def fits(path: Path) -> bool:
    """Whether a folder has this layout."""
    return (path / POSES).is_file() and (path / COLORS).is_dir() and (path / DEPTHS).is_dir()


def load(path: Path, world_up: Sequence[float] = (), floor_m: float = 0.0) -> Source:
    """A TartanGround trajectory as a source. Raises SourceError."""
    width_px, height_px = first_size(sorted((path / COLORS).glob(f"*_{CAMERA}.png")))
    focal_px = width_px / 2
    intrinsics = Intrinsics(width_px, height_px, focal_px, focal_px, (width_px - 1) / 2, (height_px - 1) / 2)
    entries = [
        Entry(number, round(number * FRAME_NS), partial(_read, path, number, words))
        for number, words in enumerate(table(path / POSES, 7))
    ]
    rig = Rig(intrinsics, MILLIMETRE, len(entries), levelling(world_up or UP, floor_m))
    return sequence("tartanground", path, rig, entries)


def _read(path: Path, number: int, words: list[str]) -> tuple[np.ndarray, bytes, bytes]:
    pose = quaternion_pose(words) @ NED_FROM_CAMERA
    color = read_bytes(path / COLORS / f"{number:06d}_{CAMERA}.png")
    depth_m = unpacked(read_bytes(path / DEPTHS / f"{number:06d}_{CAMERA}_depth.png"))
    return pose, color, millimetre_png(depth_m)


def unpacked(png: bytes) -> np.ndarray:
    """Depth in metres (h, w) of a packed depth image. Raises FrameError."""
    packed = decode_image(png, "depth")
    if packed.dtype != np.uint8 or packed.ndim != 3 or packed.shape[2] != 4:
        raise FrameError("the depth image does not have four channels of 8 bits")
    return np.ascontiguousarray(packed).view("<f4")[..., 0].astype(np.float64)

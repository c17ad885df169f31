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

from functools import partial
from pathlib import Path

import numpy as np

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.ingest.core.options import ReadOptions
from prior_sg.services.ingest.core.poses import Convention
from prior_sg.services.ingest.sources.base import (
    MILLIMETRE,
    Camera,
    Entry,
    Found,
    FrameError,
    Images,
    depth_pixels,
    first_size,
    read_bytes,
    truth_beside,
)
from prior_sg.services.ingest.sources.tables import table

NAME = "tartanground"
CAMERA = "lcam_front"
POSES, COLORS, DEPTHS = f"pose_{CAMERA}.txt", f"image_{CAMERA}", f"depth_{CAMERA}"
LOOKS = f"{POSES}, {COLORS}/ and {DEPTHS}/ (TartanGround trajectory)"
UP = (0.0, 0.0, -1.0)
RATE_HZ = 10.0


def fits(path: Path) -> bool:
    """Whether a folder has this layout."""
    return (path / POSES).is_file() and (path / COLORS).is_dir() and (path / DEPTHS).is_dir()


def load(path: Path, options: ReadOptions) -> Found:
    """A TartanGround trajectory. Raises SourceError."""
    width_px, height_px = first_size(sorted((path / COLORS).glob(f"*_{CAMERA}.png")), path / COLORS)
    focal_px = width_px / 2
    intrinsics = Intrinsics(width_px, height_px, focal_px, focal_px, (width_px - 1) / 2, (height_px - 1) / 2)
    convention = Convention(axes="ned").changed(options)
    entries = [
        Entry(
            number,
            round(number * options.frame_ns(RATE_HZ)),
            partial(convention.of_words, words),
            partial(_images, path, number),
        )
        for number, words in enumerate(table(path / POSES, 7))
    ]
    return Found(
        NAME,
        path,
        Camera(intrinsics),
        MILLIMETRE,
        entries,
        up=UP,
        ground_truth=truth_beside(path),
        convention=convention,
        why=(f"{POSES}, {COLORS}/ and {DEPTHS}/ lie in it",),
        assumed_hz=0.0 if options.rate_hz else RATE_HZ,
    )


def _images(path: Path, number: int) -> Images:
    color = read_bytes(path / COLORS / f"{number:06d}_{CAMERA}.png")
    return Images(color, unpacked(read_bytes(path / DEPTHS / f"{number:06d}_{CAMERA}_depth.png")))


def unpacked(png: bytes) -> np.ndarray:
    """Depth in metres (h, w) of a packed depth image. Raises FrameError."""
    packed = depth_pixels(png)
    if packed.dtype != np.uint8 or packed.ndim != 3 or packed.shape[2] != 4:
        raise FrameError("the depth image does not have four channels of 8 bits")
    return np.ascontiguousarray(packed).view("<f4")[..., 0].astype(np.float64)

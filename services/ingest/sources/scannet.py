"""ScanNet scans as the publisher's SensReader exports them.

color/N.jpg                      8 bit (1296 x 968); depth/N.png 16 bit, millimetres (640 x 480)
pose/N.txt                       4 x 4, world_from_camera; a frame that was not tracked has infinite numbers
intrinsic/intrinsic_color.txt    4 x 4; intrinsic/intrinsic_depth.txt 4 x 4

Camera axes are x right, y down, z forward; the world has z up and its floor near zero. The two cameras are taken to
stand in one place and to look one way (the exported extrinsics are the identity or nearly so). Colour is larger than
depth and its camera another: each colour image is resampled onto the pixels of the depth camera, whose intrinsics and
size the source has; depth is handed on as it is. An infinite pose makes a bad frame. Frames are numbered by the
export; 30 Hz are assumed. Ground truth: poses only; regions.json is read where one lies beside the folders.
Source: github.com/ScanNet/ScanNet, README.md ("Data Organization", ".sens") and SensReader/python/SensorData.py.
"""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.ingest.core.options import ReadOptions
from prior_sg.services.ingest.core.pixels import encoded
from prior_sg.services.ingest.core.poses import Convention
from prior_sg.services.ingest.sources.base import (
    MILLIMETRE,
    Camera,
    Entry,
    Found,
    FrameError,
    Images,
    SourceError,
    color_pixels,
    file_of,
    first_size,
    numbered,
    truth_beside,
)
from prior_sg.services.ingest.sources.tables import text_of
from prior_sg.services.opencv import cv2

NAME = "scannet"
COLOR_CAMERA, DEPTH_CAMERA = "intrinsic/intrinsic_color.txt", "intrinsic/intrinsic_depth.txt"
LOOKS = f"{COLOR_CAMERA} and {DEPTH_CAMERA} (ScanNet export)"
RATE_HZ = 30.0


def fits(path: Path) -> bool:
    """Whether a folder has this layout."""
    return (path / COLOR_CAMERA).is_file() and (path / DEPTH_CAMERA).is_file()


@dataclass(frozen=True)
class Files:
    """Where the images of a scan lie, and how colour gets onto the pixels of depth."""

    colors: dict[int, Path]
    depths: dict[int, Path]
    color_size: tuple[int, int]  # width, height, pixels
    color_from_depth: np.ndarray  # 3 x 3, pixels of the same ray
    camera: Intrinsics  # of depth


def load(path: Path, options: ReadOptions) -> Found:
    """A ScanNet export. Raises SourceError."""
    colors, depths = numbered(path / "color", r"(\d+)\.(?:jpg|png)"), numbered(path / "depth", r"(\d+)\.png")
    poses = numbered(path / "pose", r"(\d+)\.txt")
    depth_matrix, color_matrix = _matrix(path / DEPTH_CAMERA), _matrix(path / COLOR_CAMERA)
    (fx, _, cx), (_, fy, cy) = depth_matrix[:2].tolist()
    try:
        camera = Intrinsics(*first_size(list(depths.values()), path / "depth"), fx, fy, cx, cy)
    except ValueError as error:
        raise SourceError(f"{path / DEPTH_CAMERA} is not a camera: {error}") from error
    color_from_depth = color_matrix @ np.linalg.inv(depth_matrix)
    files = Files(colors, depths, first_size(list(colors.values()), path / "color"), color_from_depth, camera)
    convention = Convention().changed(options)

    def entry(number: int) -> Entry:
        return Entry(
            number,
            round(number * options.frame_ns(RATE_HZ)),
            lambda: convention.of_text(file_of(poses, number, "pose")),
            partial(_images, files, number),
        )

    return Found(
        NAME,
        path,
        Camera(camera),
        MILLIMETRE,
        [entry(number) for number in sorted(colors.keys() | depths.keys() | poses.keys())],
        ground_truth=truth_beside(path),
        convention=convention,
        why=(f"{COLOR_CAMERA} and {DEPTH_CAMERA} lie in it",),
        assumed_hz=0.0 if options.rate_hz else RATE_HZ,
    )


def _images(files: Files, number: int) -> Images:
    depth = file_of(files.depths, number, "depth")
    color = color_pixels(file_of(files.colors, number, "colour"))
    height_px, width_px = color.shape[:2]
    if (width_px, height_px) != files.color_size:
        raise FrameError(
            f"the colour image has {width_px} x {height_px} pixels, the first one "
            f"{files.color_size[0]} x {files.color_size[1]}"
        )
    return Images(encoded(resampled(color, files.color_from_depth, files.camera), ".jpg"), depth)


def resampled(color: np.ndarray, color_from_depth: np.ndarray, camera: Intrinsics) -> np.ndarray:
    """A colour image on the pixels of `camera`; `color_from_depth` (3 x 3) maps these to pixels of the image.

    The image is first shrunk by area to about the size it will have, so that no detail turns into noise.
    """
    shrink = max(1.0, float(color_from_depth[0, 0]), float(color_from_depth[1, 1]))
    height_px, width_px = color.shape[:2]
    size = max(1, round(width_px / shrink)), max(1, round(height_px / shrink))
    small = cv2.resize(color, size, interpolation=cv2.INTER_AREA)
    ratio_x, ratio_y = size[0] / width_px, size[1] / height_px
    small_from_color = np.array(((ratio_x, 0, (ratio_x - 1) / 2), (0, ratio_y, (ratio_y - 1) / 2), (0, 0, 1)))
    mapping = (small_from_color @ color_from_depth)[:2]
    return cv2.warpAffine(
        small,
        mapping,
        (camera.width_px, camera.height_px),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )


def _matrix(path: Path) -> np.ndarray:
    """The 3 x 3 camera matrix of a file with a 4 x 4 or 3 x 3 matrix."""
    try:
        rows = [line.replace(",", " ").split() for line in text_of(path).splitlines() if line.strip()]
        matrix = np.array(rows, float)
    except ValueError as error:
        raise SourceError(f"{path} cannot be read: {error}") from error
    if matrix.shape not in ((4, 4), (3, 3)) or not (np.diag(matrix)[:2] > 0).all() or not np.isfinite(matrix).all():
        raise SourceError(f"{path} is not a camera matrix of 4 x 4 numbers")
    if not np.array_equal(matrix[2, :3], (0, 0, 1)):
        raise SourceError(f"{path} is not a camera matrix: it must be fx 0 cx, 0 fy cy, 0 0 1")
    return matrix[:3, :3]

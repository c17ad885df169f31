"""7-Scenes folders: frame-NNNNNN.color.png, .depth.png (millimetres, 65535 = invalid) and .pose.txt (camera to world).

A folder holds frames, or sequences seq-01, seq-02 … whose numbers are counted on. There are no stamps: the Kinect's
30 Hz are assumed. The world is that of the first camera, which was held roughly level, so up is taken to be -y. Give
the measured direction and the floor's height when places must lie level.
"""

import re
from functools import partial
from pathlib import Path

import numpy as np

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.headers import ImageError, image_size
from prior_sg.services.ingest.core.options import ReadOptions
from prior_sg.services.ingest.core.poses import Convention
from prior_sg.services.ingest.sources.base import (
    MILLIMETRE,
    Camera,
    Entry,
    Found,
    FrameError,
    Images,
    SourceError,
    read_bytes,
    truth_beside,
)
from prior_sg.services.ingest.sources.tables import text_of

NAME = "7-scenes"
POSES, SEQUENCES = "frame-*.pose.txt", "seq-*"
LOOKS = f"{POSES} or {SEQUENCES}/{POSES} (7-Scenes folder)"
INTRINSICS = "camera-intrinsics.txt"
PUBLISHED = (585.0, 585.0, 320.0, 240.0)  # fx fy cx cy of the data set's description
UP = (0.0, -1.0, 0.0)
RATE_HZ = 30.0


def fits(path: Path) -> bool:
    """Whether a folder has this layout."""
    return path.is_dir() and (any(path.glob(POSES)) or any(path.glob(f"{SEQUENCES}/{POSES}")))


def load(path: Path, options: ReadOptions) -> Found:
    """A 7-Scenes scene or sequence. Raises SourceError."""
    stems = _stems(path)
    convention = Convention().changed(options)
    return Found(
        NAME,
        path,
        Camera(Intrinsics(*_size(stems), *_focal(path)), published=True),
        MILLIMETRE,
        [
            Entry(
                number,
                round(number * options.frame_ns(RATE_HZ)),
                partial(_pose, stem, convention),
                partial(_images, stem),
            )
            for number, stem in stems
        ],
        up=UP,
        ground_truth=truth_beside(path),
        convention=convention,
        why=(f"it holds {POSES}",),
        assumed_hz=0.0 if options.rate_hz else RATE_HZ,
    )


def _stems(path: Path) -> list[tuple[int, Path]]:
    """Number and the files' common beginning of each frame, sequences counted on."""
    folders = sorted(path.glob(SEQUENCES)) if any(path.glob(f"{SEQUENCES}/{POSES}")) else [path]
    stems: list[tuple[int, Path]] = []
    for folder in folders:
        offset = stems[-1][0] + 1 if stems else 0
        numbered = (re.fullmatch(r"(frame-(\d+))\.pose\.txt", file.name) for file in folder.glob(POSES))
        stems += sorted((offset + int(match[2]), folder / match[1]) for match in numbered if match)
    return stems


def _file(stem: Path, kind: str) -> Path:
    """Path of a frame's color.png, depth.png or pose.txt."""
    return stem.with_name(f"{stem.name}.{kind}")


def _pose(stem: Path, convention: Convention) -> np.ndarray:
    return convention.of_text(read_bytes(_file(stem, "pose.txt")))


def _images(stem: Path) -> Images:
    return Images(read_bytes(_file(stem, "color.png")), read_bytes(_file(stem, "depth.png")))


def _size(stems: list[tuple[int, Path]]) -> tuple[int, int]:
    for _, stem in stems:
        try:
            width_px, height_px, _ = image_size(read_bytes(_file(stem, "color.png")))
            return width_px, height_px
        except (FrameError, ImageError):
            continue
    raise SourceError(
        f"no colour image beside the poses in {stems[0][1].parent} can be read: looked for frame-*.color.png"
    )


def _focal(path: Path) -> tuple[float, float, float, float]:
    """fx fy cx cy from the 3 x 3 matrix beside the frames or above the sequence, else as published."""
    for file in (path / INTRINSICS, path.parent / INTRINSICS):
        if file.is_file():
            try:
                matrix = np.array(text_of(file).split(), float).reshape(3, 3)
            except ValueError as error:
                raise SourceError(f"{file} is not a 3 x 3 matrix: {error}") from error
            return float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2])
    return PUBLISHED

"""Dataset folders.

camera.json       width height fx fy cx cy (pixels), depth_scale_m (metres per unit); where the lens bends: `model`
                  (opencv or fisheye) and `distortion` (coefficients as OpenCV orders them), undistorted on reading
trajectory.csv    frame, stamp_ns, x_m y_m z_m qx qy qz qw: world_from_camera, world z up
color/NNNNNN.jpg  or .png, .bmp, .webp; depth/NNNNNN.png with 16 bits, 0 = no measurement, or .npy, .tiff in metres
mask/NNNNNN.png   where it exists: 8 bits, not 0 = something that moves, kept out of the map
pose_updates.csv  corrected poses, where they exist: stamp_ns (when the correction was made) and the columns of the
                  trajectory; rows that follow each other with one stamp are one correction
regions.json      ground truth, where it exists
"""

from functools import partial
from itertools import groupby
from pathlib import Path

import numpy as np

from prior_sg.services.ingest.core.options import ReadOptions
from prior_sg.services.ingest.core.poses import Convention
from prior_sg.services.ingest.core.selection import Correction
from prior_sg.services.ingest.sources.base import (
    CAMERA,
    MILLIMETRE,
    Entry,
    Found,
    FrameError,
    Images,
    SourceError,
    camera_of,
    read_bytes,
    truth_beside,
)
from prior_sg.services.ingest.sources.tables import (
    check_stamps,
    csv_rows,
    order_of,
    read_json,
    stamps_ns,
    whole_number,
)

NAME = "dataset"
TRAJECTORY, POSE_UPDATES = "trajectory.csv", "pose_updates.csv"
LOOKS = f"{CAMERA} and {TRAJECTORY} (dataset folder)"
POSED = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
COLUMNS = ("frame", "stamp_ns", *POSED)
COLORS, DEPTHS = (".jpg", ".png", ".jpeg", ".bmp", ".webp"), (".png", ".npy", ".tiff", ".tif", ".exr")
Row = dict[str, str]


def fits(path: Path) -> bool:
    """Whether a folder has this layout."""
    return (path / CAMERA).is_file() and (path / TRAJECTORY).is_file()


def load(path: Path, options: ReadOptions) -> Found:
    """A dataset folder. Raises SourceError."""
    camera = read_json(path / CAMERA)
    rows = csv_rows(path / TRAJECTORY, COLUMNS)
    described = camera_of(path / CAMERA, camera)
    convention = Convention().changed(options)
    try:
        depth_scale_m = float(camera["depth_scale_m"]) if options.depth_scale_m is None else MILLIMETRE
    except (KeyError, TypeError, ValueError) as error:
        raise SourceError(f"{path / CAMERA} is not a camera: {error!r}") from error
    entries, notes = _entries(path, rows, convention, options)
    corrections = read_corrections(path / POSE_UPDATES, convention) if (path / POSE_UPDATES).exists() else []
    return Found(
        NAME,
        path,
        described,
        depth_scale_m,
        entries,
        ground_truth=truth_beside(path),
        corrections=corrections,
        convention=convention,
        why=(f"{CAMERA} and {TRAJECTORY} lie in it",),
        notes=tuple(notes),
    )


def read_corrections(path: Path, convention: Convention | None = None) -> list[Correction]:
    """Corrected poses of a CSV file with the columns of a trajectory, one correction per stamp. Raises SourceError."""
    convention = convention or Convention()
    corrections = []
    for stamp, rows in groupby(csv_rows(path, COLUMNS), key=lambda row: row["stamp_ns"]):
        posed = list(rows)
        try:
            corrections.append(
                Correction(
                    stamp_ns=whole_number(stamp),
                    frame_ids=np.array([whole_number(row["frame"]) for row in posed], np.int64),
                    world_from_camera=np.stack([_pose(row, convention) for row in posed]),
                )
            )
        except ValueError as error:
            raise SourceError(f"{path}, stamp {stamp}: {error}") from error
    return sorted(corrections, key=lambda correction: correction.stamp_ns)


def _entries(path: Path, rows: list[Row], convention: Convention, options: ReadOptions) -> tuple[list[Entry], list]:
    """One entry per frame, in the order of recording, and what was done to the rows."""
    numbers = [_number(row["frame"]) for row in rows]
    if options.rate_hz:
        stamps: list[int | None] = [0 if n is None else round(n * options.frame_ns(1)) for n in numbers]
        note = f"{options.rate_hz:g} frames a second, as told, in place of the stamps"
    else:
        stamps, note = stamps_ns([row["stamp_ns"] for row in rows], path / TRAJECTORY, "ns", options.stamp_unit)
        check_stamps(stamps, path / TRAJECTORY)
    order, notes = order_of(numbers, stamps)
    entries = []
    for position in order:
        number, stamp = numbers[position], stamps[position]
        lacking = number is None or stamp is None
        entries.append(
            Entry(
                -1 if number is None else number,
                0 if stamp is None else stamp,
                partial(_malformed if lacking else _pose, rows[position], convention),
                partial(_images, path, -1 if number is None else number),
            )
        )
    return entries, [note, *notes] if note else notes


def _number(word: str) -> int | None:
    try:
        return whole_number(word)
    except ValueError:
        return None


def _malformed(row: Row, convention: Convention) -> np.ndarray:
    raise FrameError(f"its row of {TRAJECTORY} is malformed: {row['frame'][:20]!r} at {row['stamp_ns'][:40]!r}")


def _pose(row: Row, convention: Convention) -> np.ndarray:
    try:
        words = [str(float(row[name])) for name in POSED]
    except (TypeError, ValueError) as error:
        raise FrameError(f"its row is malformed: {error}") from error
    return convention.of_words(words)


def _images(path: Path, number: int) -> Images:
    mask = path / "mask" / f"{number:06d}.png"
    return Images(
        read_bytes(_existing(path / "color", number, COLORS)),
        read_bytes(_existing(path / "depth", number, DEPTHS)),
        read_bytes(mask) if mask.exists() else b"",
    )


def _existing(folder: Path, number: int, endings: tuple[str, ...]) -> Path:
    """The frame's file with one of these endings, or the usual name, for whoever reads it to complain."""
    files = [folder / f"{number:06d}{ending}" for ending in endings]
    return next((file for file in files if file.exists()), files[0])

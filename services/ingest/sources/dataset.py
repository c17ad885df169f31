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

import re
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from pathlib import Path

import numpy as np

from prior_sg.services.ingest.core.frames import Correction
from prior_sg.services.ingest.core.options import ReadOptions
from prior_sg.services.ingest.core.poses import Convention
from prior_sg.services.ingest.sources.base import (
    CAMERA,
    MILLIMETRE,
    Entry,
    Found,
    FrameError,
    Images,
    SourceError,
    camera_of,
    numbered,
    read_bytes,
    truth_beside,
)
from prior_sg.services.ingest.sources.tables import (
    FEW,
    NUMBER,
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
COLORS, DEPTHS = (".jpg", ".png", ".jpeg", ".bmp", ".webp", ".tif", ".tiff"), (".png", ".npy", ".tiff", ".tif", ".exr")
MASKS, FOLDERS = (".png",), ("color", "depth", "mask")
IMAGE_NAME = re.compile(r"(?:.*[/\\])?(\d{1,18})(?:" + "|".join(map(re.escape, COLORS)) + ")", re.IGNORECASE)
SPARSE = 2  # times as many poses as images: the tracker was faster than the camera
Row = dict[str, str]


@dataclass(frozen=True)
class Files:
    """Images of a dataset folder by the number of their frame."""

    path: Path
    colors: dict[int, Path]
    depths: dict[int, Path]
    masks: dict[int, Path]


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
    except KeyError as error:
        raise SourceError(f"{path / CAMERA} lacks depth_scale_m: add it, or give --depth-scale METRES") from error
    except (TypeError, ValueError) as error:
        raise SourceError(f"{path / CAMERA} is not a camera: depth_scale_m: {error}") from error
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
    files = _files(path)
    rows, numbers, left_out = _with_images(rows, [_number(row["frame"]) for row in rows], files)
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
                partial(_images, files, -1 if number is None else number),
            )
        )
    return entries, [text for text in (left_out, note, *notes) if text]


def _number(word: str) -> int | None:
    """A frame's number, also of the name of its image."""
    try:
        return whole_number(word)
    except ValueError:
        image = IMAGE_NAME.fullmatch(word)
        return int(image[1]) if image else None


def _malformed(row: Row, convention: Convention) -> np.ndarray:
    raise FrameError(f"its row of {TRAJECTORY} is malformed: {row['frame'][:20]!r} at {row['stamp_ns'][:40]!r}")


def _pose(row: Row, convention: Convention) -> np.ndarray:
    for name in POSED:
        if not NUMBER.fullmatch(row[name]):
            raise FrameError(f"its row of {TRAJECTORY} is malformed: {name} is {row[name][:20]!r}")
    return convention.of_words([row[name] for name in POSED])


def _images(files: Files, number: int) -> Images:
    mask = files.masks.get(number)
    return Images(
        read_bytes(files.colors.get(number, files.path / "color" / f"{number:06d}{COLORS[0]}")),
        read_bytes(files.depths.get(number, files.path / "depth" / f"{number:06d}{DEPTHS[0]}")),
        b"" if mask is None else read_bytes(mask),
    )


def _files(path: Path) -> Files:
    """The images of a dataset folder by number."""
    return Files(
        path, *(_by_number(path / name, of) for name, of in zip(FOLDERS, (COLORS, DEPTHS, MASKS), strict=True))
    )


def _by_number(folder: Path, endings: tuple[str, ...]) -> dict[int, Path]:
    """Of several files with one number the one with six digits is taken, then the one whose ending comes first."""
    found: dict[int, Path] = {}
    for ending in reversed(endings):
        found |= numbered(folder, rf"(\d+){re.escape(ending)}")
    for ending in reversed(endings):
        found |= numbered(folder, rf"(\d{{6}}){re.escape(ending)}")
    return found


def _with_images(rows: list[Row], numbers: list[int | None], files: Files) -> tuple[list[Row], list[int | None], str]:
    """The rows that have an image and their numbers, where there are many more rows than images, and a note on it."""
    kept = [i for i, number in enumerate(numbers) if number in files.colors or number in files.depths]
    if not kept or len(rows) < FEW or len(rows) <= SPARSE * len(kept):
        return rows, numbers, ""
    said = f"{len(rows) - len(kept)} of {len(rows)} rows of {TRAJECTORY} have no image: they are left out"
    return [rows[i] for i in kept], [numbers[i] for i in kept], said

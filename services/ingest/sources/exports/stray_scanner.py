"""Datasets of the app Stray Scanner.

rgb.mp4                    the pictures
depth/NNNNNN.png           16 bits, millimetres, 256 x 192 (older: .npy); confidence/NNNNNN.png 0 to 2
odometry.csv               timestamp, frame, x, y, z, qx, qy, qz, qw: world_from_camera, ARKit's world (y up), camera
                           axes x right, y down, z forward
camera_matrix.csv          3 x 3, for the film's pixels

The picture of a row is the one of its number in the film. Depth is enlarged to pictures that tell something (phone.py).
Source: github.com/strayrobots/scanner, docs/format.md; github.com/kekeblom/StrayVisualizer, stray_visualize.py.
"""

from functools import partial
from pathlib import Path

import numpy as np

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.ingest.core.options import ReadOptions
from prior_sg.services.ingest.core.poses import Convention
from prior_sg.services.ingest.sources import base
from prior_sg.services.ingest.sources.base import (
    MILLIMETRE,
    Entry,
    Found,
    Images,
    SourceError,
    file_of,
    numbered,
    truth_beside,
)
from prior_sg.services.ingest.sources.exports import phone
from prior_sg.services.ingest.sources.exports.film import Film
from prior_sg.services.ingest.sources.tables import csv_rows, stamps_ns, text_of

NAME = "stray-scanner"
FILM, ODOMETRY, MATRIX = "rgb.mp4", "odometry.csv", "camera_matrix.csv"
LOOKS = f"{FILM}, depth/, {ODOMETRY} and {MATRIX} (Stray Scanner)"
POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")


def fits(path: Path) -> bool:
    """Whether a folder has this layout, if perhaps not all of it."""
    return sum((path / name).is_file() for name in (FILM, ODOMETRY, MATRIX)) >= 2


def load(path: Path, options: ReadOptions) -> Found:
    """A dataset of Stray Scanner. Raises SourceError."""
    if not (path / FILM).is_file():
        raise SourceError(f"{path} lacks {FILM}, the pictures: export the dataset with it")
    rows = csv_rows(path / ODOMETRY, ("timestamp", "frame", *POSE))
    film, depths = Film(path / FILM), numbered(path / "depth", r"(\d+)\.(?:png|npy)")
    confidences = numbered(path / "confidence", r"(\d+)\.png")
    stamps, note = stamps_ns([row["timestamp"] for row in rows], path / ODOMETRY, "s", options.stamp_unit)
    convention = Convention().changed(options)
    entries = [
        Entry(
            number,
            options.told_ns(number, stamp),
            partial(_pose, row, convention),
            partial(_images, film, depths, confidences, number),
        )
        for row, stamp in zip(rows, stamps, strict=True)
        if stamp is not None and (number := _number(row)) is not None
    ]
    return Found(
        NAME,
        path,
        base.Camera(_camera(path / MATRIX, film.size_px)),
        MILLIMETRE,
        entries,
        up=phone.UP,
        ground_truth=truth_beside(path),
        convention=convention,
        why=(f"{ODOMETRY} and {MATRIX} lie in it",),
        notes=tuple(filter(None, (phone.NOTE, note))),
    )


def _number(row: dict[str, str]) -> int | None:
    return int(row["frame"]) if row["frame"].isdecimal() else None


def _pose(row: dict[str, str], convention: Convention) -> np.ndarray:
    return convention.of_words([row[name] for name in POSE])


def _images(film: Film, depths: dict[int, Path], confidences: dict[int, Path], number: int) -> Images:
    units = phone.pixels(partial(file_of, depths, number, "depth"), "depth image")
    sure = phone.pixels(partial(file_of, confidences, number, "confidence"), "confidence") if confidences else None
    return phone.images(film.picture(number), units * MILLIMETRE, sure)


def _camera(path: Path, size_px: tuple[int, int]) -> Intrinsics:
    try:
        matrix = np.array(text_of(path).replace(",", " ").split(), float).reshape(3, 3)
        return Intrinsics(*size_px, matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])
    except ValueError as error:
        raise SourceError(f"{path} is not a camera: {error}") from error

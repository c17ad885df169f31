"""cameras.bin and images.bin of COLMAP, as the words of its text files.

Source: colmap.github.io/format.html; the order of the models is that of src/colmap/sensor/models.h.
"""

import struct
from pathlib import Path
from typing import Any

from prior_sg.services.ingest.sources.tables import SourceError

MODELS = dict(enumerate((
    ("SIMPLE_PINHOLE", 3), ("PINHOLE", 4), ("SIMPLE_RADIAL", 4), ("RADIAL", 5), ("OPENCV", 8), ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12), ("FOV", 5), ("SIMPLE_RADIAL_FISHEYE", 4), ("RADIAL_FISHEYE", 5), ("THIN_PRISM_FISHEYE", 12),
)))  # fmt: skip
COUNT, CAMERA, IMAGE = struct.Struct("<Q"), struct.Struct("<iiQQ"), struct.Struct("<i7di")
POINT_BYTES = 24


def cameras_of(path: Path) -> dict[str, list[Any]]:
    """Model, width, height and parameters by the camera's number. Raises SourceError."""
    data = _read(path)
    try:
        (count,), at = COUNT.unpack_from(data), COUNT.size
        cameras: dict[str, list[Any]] = {}
        for _ in range(count):
            number, model, width, height = CAMERA.unpack_from(data, at)
            name, parameters = MODELS[model]
            values = struct.unpack_from(f"<{parameters}d", data, at + CAMERA.size)
            cameras[str(number)] = [name, width, height, *values]
            at += CAMERA.size + 8 * parameters
    except (struct.error, KeyError, OverflowError) as error:
        raise SourceError(f"{path} is damaged, or of a model of cameras that is not known: {error}") from error
    return cameras


def images_of(path: Path) -> list[list[Any]]:
    """Number, qw qx qy qz, tx ty tz, number of the camera, and name of each image. Raises SourceError."""
    data = _read(path)
    try:
        (count,), at = COUNT.unpack_from(data), COUNT.size
        images: list[list[Any]] = []
        for _ in range(count):
            number, *pose, camera = IMAGE.unpack_from(data, at)
            end = data.index(b"\0", at + IMAGE.size)
            name = data[at + IMAGE.size : end].decode(errors="replace")
            images.append([number, *pose, str(camera), name])
            (points,) = COUNT.unpack_from(data, end + 1)
            at = end + 1 + COUNT.size + POINT_BYTES * points
    except (struct.error, ValueError, OverflowError) as error:
        raise SourceError(f"{path} is damaged: {error}") from error
    return images


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise SourceError(f"{path} cannot be read: {error.strerror}") from error

"""Recordings of the app Record3D: a .r3d file, or the folder that it unpacks to.

metadata                 JSON: w, h, K (3 x 3 by columns) or perFrameIntrinsicCoeffs (fx fy cx cy), dw, dh, fps or
                         frameTimestamps (seconds), poses (qx qy qz qw tx ty tz of each frame: world_from_camera,
                         ARKit's world, y up, OpenGL camera axes)
rgbd/N.jpg               the pictures
rgbd/N.depth N.conf      32 bit floats, metres, and bytes 0 to 2, dh x dw, each compressed with LZFSE

Depth is enlarged to pictures that tell something (phone.py). Depth needs `pip install 'prior-sg[record3d]'`.
Source: record3d.app; checked against the readers of nerfstudio (record3d_utils.py) and viser (extras/_record3d.py).
"""

import json
import zipfile
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from prior_sg.services.ingest.core.options import ReadOptions
from prior_sg.services.ingest.core.poses import Convention, PoseError
from prior_sg.services.ingest.sources import base
from prior_sg.services.ingest.sources.base import (
    MILLIMETRE,
    Entry,
    Found,
    FrameError,
    Images,
    SourceError,
    color_pixels,
    read_bytes,
    truth_beside,
)
from prior_sg.services.ingest.sources.exports import phone
from prior_sg.services.runtime import extras

NAME = "record3d"
ENDING, METADATA, FRAMES = ".r3d", "metadata", "rgbd"
LOOKS = "a file .r3d, or metadata and rgbd/ (Record3D)"
RATE_HZ = 60.0
MOST_BYTES = 1 << 26
Read = Callable[[str], bytes]  # content of a file of the recording; raises FrameError


def fits(path: Path) -> bool:
    """Whether a path is a recording of Record3D."""
    return path.suffix.lower() == ENDING if path.is_file() else (path / FRAMES).is_dir()


def load(path: Path, options: ReadOptions) -> Found:
    """A recording of Record3D. Raises SourceError, and ExtraMissing where LZFSE cannot be unpacked."""
    extras.require("record3d", f"{path}, whose depth is compressed with LZFSE,")
    read = _reader(path)
    try:
        said = json.loads(read(METADATA))
        poses = np.array(said["poses"], np.float64).reshape(-1, 7)
        depth_shape = int(said["dh"]), int(said["dw"])
        camera = base.camera_of(path, {"width": said["w"], "height": said["h"], **_lens(said)})
        stamps = _stamps(said, len(poses), options)
    except (FrameError, KeyError, TypeError, ValueError, IndexError, OverflowError, RecursionError) as error:
        lacks = f"it lacks {error}" if isinstance(error, KeyError) else str(error)[:200]
        raise SourceError(f"{path} has no metadata of Record3D: {lacks}; export it again as .r3d") from error
    convention = Convention(axes="opengl").changed(options)
    entries = [
        Entry(number, stamp, partial(_pose, pose, convention), partial(_images, read, number, depth_shape))
        for number, (pose, stamp) in enumerate(zip(poses, stamps, strict=True))
    ]
    return Found(
        NAME,
        path,
        camera,
        MILLIMETRE,
        entries,
        up=phone.UP,
        ground_truth=truth_beside(path) if path.is_dir() else None,
        convention=convention,
        why=("it is a recording of Record3D",),
        notes=(phone.NOTE,),
    )


def _reader(path: Path) -> Read:
    """Reads files of a folder or of a packed one. Raises SourceError."""
    if path.is_dir():
        return lambda name: read_bytes(path / name)
    try:
        packed = zipfile.ZipFile(path)
    except (zipfile.BadZipFile, OSError) as error:
        raise SourceError(f"{path} is no recording of Record3D, or it is cut off: export it again as .r3d") from error
    return partial(_member, packed)


def _member(packed: zipfile.ZipFile, name: str) -> bytes:
    try:
        if packed.getinfo(name).file_size > MOST_BYTES:
            raise FrameError(f"{name} is larger than any picture")
        return packed.read(name)
    except KeyError as error:
        raise FrameError(f"it has no {name}") from error
    except (zipfile.BadZipFile, zlib.error, OSError, EOFError, NotImplementedError, RuntimeError) as error:
        raise FrameError(f"{name} is damaged: {str(error)[:100]}") from error


def _lens(said: dict[str, Any]) -> dict[str, float]:
    """fx fy cx cy, the median of those of all frames where each has its own."""
    if said.get("perFrameIntrinsicCoeffs"):
        values = np.median(np.array(said["perFrameIntrinsicCoeffs"], np.float64).reshape(-1, 4), axis=0)
    else:
        values = np.array(said["K"], np.float64).reshape(9)[[0, 4, 6, 7]]
    return dict(zip(("fx", "fy", "cx", "cy"), values.tolist(), strict=True))


def _stamps(said: dict[str, Any], frames: int, options: ReadOptions) -> list[int]:
    written = said.get("frameTimestamps")
    if isinstance(written, list) and len(written) == frames and not options.rate_hz:
        return [round(float(stamp) * 1e9) for stamp in written]
    return [round(number * options.frame_ns(float(said.get("fps") or RATE_HZ))) for number in range(frames)]


def _pose(pose: np.ndarray, convention: Convention) -> np.ndarray:
    x, y, z, w = pose[:4]
    order = (w, x, y, z) if convention.quaternion == "wxyz" else (x, y, z, w)
    if not np.isfinite(pose).all():
        raise PoseError("its pose is not finite")
    return convention.of_words([repr(float(value)) for value in (*pose[4:], *order)])


def _images(read: Read, number: int, depth_shape: tuple[int, int]) -> Images:
    """Raises FrameError."""
    depth_m = _unpacked(read(f"{FRAMES}/{number}.depth"), "<f4", depth_shape)
    sure = _unpacked(read(f"{FRAMES}/{number}.conf"), "u1", depth_shape)
    picture = color_pixels(read(f"{FRAMES}/{number}.jpg"))
    return phone.images(picture, np.nan_to_num(depth_m.astype(np.float64), posinf=0.0, neginf=0.0), sure)


def _unpacked(data: bytes, kind: str, shape: tuple[int, int]) -> np.ndarray:
    """Numbers of a compressed image. Raises FrameError."""
    import lzfse

    try:
        return np.frombuffer(lzfse.decompress(data), kind).reshape(shape)
    except (lzfse.error, ValueError, MemoryError) as error:  # the last of a few bytes that promise much
        raise FrameError(f"its depth is damaged: it does not unpack to {shape[0]} x {shape[1]} numbers") from error

"""What every source is, and the arithmetic all of them share."""

import json
import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.geometry import pose_from_quaternion
from prior_sg.services.ingest.core.selection import BadFrame, Correction, RawFrame
from prior_sg.services.ingest.sources.images import ImageError, image_size
from prior_sg.services.runtime.service import ServiceError

UP = (0.0, 0.0, 1.0)
CAMERA, REGIONS = "camera.json", "regions.json"
MILLIMETRE = 0.001
DEPTH_MAX = 65535


class SourceError(ServiceError):
    """A source cannot be opened; the text is one sentence for the user."""


class FrameError(ValueError):
    """One frame cannot be used; the text is the reason."""


@dataclass(frozen=True)
class Source:
    """A sequence of posed RGB-D frames. Iterating it reads files; each iteration begins at the first frame."""

    layout: str  # its name in docs/sources.md
    path: Path
    intrinsics: Intrinsics
    total: int
    frames: Callable[[], Iterator[RawFrame | BadFrame]]
    ground_truth: dict[str, Any] | None = None  # content of regions.json
    corrections: Callable[[], Iterator[Correction]] = lambda: iter(())  # corrected poses, stamps not falling

    def __iter__(self) -> Iterator[RawFrame | BadFrame]:
        return self.frames()

    def events(self) -> Iterator[RawFrame | BadFrame | Correction]:
        """Frames, with each correction before the first frame of a later stamp, or at the end."""
        corrections = self.corrections()
        waiting = next(corrections, None)
        for frame in self.frames():
            while waiting is not None and isinstance(frame, RawFrame) and waiting.stamp_ns < frame.stamp_ns:
                yield waiting
                waiting = next(corrections, None)
            yield frame
        if waiting is not None:
            yield waiting
        yield from corrections


@dataclass(frozen=True)
class Rig:
    """What is the same for all frames of a source."""

    intrinsics: Intrinsics
    depth_scale_m: float
    total: int
    world_from_source: np.ndarray | None  # None = the source's world has z up and its floor at zero already

    def frame(
        self,
        index: int,
        frame_id: int,
        stamp_ns: int,
        source_from_camera: np.ndarray,
        *,
        color: bytes,
        depth: bytes,
        mask: bytes = b"",
    ) -> RawFrame:
        """A frame whose images fit the camera and whose pose is a rigid motion. Raises FrameError."""
        check_images(self.intrinsics, color, depth)
        pose = np.asarray(source_from_camera, np.float64)
        if not np.isfinite(pose).all():
            raise FrameError("its pose is not finite")
        try:
            return RawFrame(
                frame_id=frame_id,
                stamp_ns=stamp_ns,
                intrinsics=self.intrinsics,
                world_from_camera=pose if self.world_from_source is None else self.world_from_source @ pose,
                color=color,
                depth=depth,
                mask=mask,
                depth_scale_m=self.depth_scale_m,
                index=index,
                total=self.total,
            )
        except ValueError as error:
            raise FrameError(str(error)) from error


@dataclass(frozen=True)
class Entry:
    """One frame before it is read: `read` gives source_from_camera, colour and depth, or raises FrameError."""

    frame_id: int
    stamp_ns: int
    read: Callable[[], tuple[np.ndarray, bytes, bytes]]


def sequence(layout: str, path: Path, rig: Rig, entries: Sequence[Entry]) -> Source:
    """A source of these entries, with the ground truth of a regions.json beside them. Raises SourceError."""
    ground_truth = read_json(path / REGIONS) if (path / REGIONS).is_file() else None
    return Source(layout, path, rig.intrinsics, len(entries), lambda: _frames(rig, entries), ground_truth)


def _frames(rig: Rig, entries: Sequence[Entry]) -> Iterator[RawFrame | BadFrame]:
    for index, entry in enumerate(entries):
        try:
            pose, color, depth = entry.read()
            yield rig.frame(index, entry.frame_id, entry.stamp_ns, pose, color=color, depth=depth)
        except FrameError as error:
            yield BadFrame(frame_id=entry.frame_id, reason=str(error), index=index, total=rig.total)


def check_images(intrinsics: Intrinsics, color: bytes, depth: bytes) -> None:
    """Raise FrameError unless both images are whole, of the camera's size, and depth has 16 bits."""
    expected = (intrinsics.width_px, intrinsics.height_px)
    for name, data, bits in (("colour", color, 8), ("depth", depth, 16)):
        try:
            width_px, height_px, depth_bits = image_size(data)
        except ImageError as error:
            raise FrameError(f"the {name} image is damaged: {error}") from error
        if (width_px, height_px) != expected:
            raise FrameError(
                f"the {name} image has {width_px} x {height_px} pixels, the camera {expected[0]} x {expected[1]}"
            )
        if depth_bits != bits:
            raise FrameError(f"the {name} image has {depth_bits} bits per channel instead of {bits}")


def read_bytes(path: Path) -> bytes:
    """A file's content. Raises FrameError."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise FrameError(f"{path.name} cannot be read: {error.strerror}") from error


def read_json(path: Path) -> Any:
    """A JSON file's content. Raises SourceError."""
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise SourceError(f"{path} cannot be read: {error}") from error


def camera_of(path: Path, camera: Any) -> Intrinsics:
    """The camera of a JSON object with width, height, fx, fy, cx, cy; `path` is for the reader of an error."""
    try:
        return Intrinsics(
            int(camera["width"]), int(camera["height"]), *(float(camera[name]) for name in ("fx", "fy", "cx", "cy"))
        )
    except (KeyError, TypeError, ValueError) as error:
        raise SourceError(f"{path} is not a camera: {error!r}") from error


def table(path: Path, columns: int) -> list[list[str]]:
    """Rows of a text file of words; empty lines and lines that begin with # are left out. Raises SourceError."""
    try:
        lines = path.read_text().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise SourceError(f"{path} cannot be read: {error}") from error
    rows = [line.split() for line in lines if line.strip() and not line.startswith("#")]
    short = next((row for row in rows if len(row) < columns), None)
    if short is not None:
        raise SourceError(f"{path} has a line with {len(short)} instead of {columns} columns: {' '.join(short)[:80]}")
    return rows


def stamp_ns(word: str, path: Path) -> int:
    """Nanoseconds, exact, of a stamp written in seconds; `path` is for the reader of an error. Raises SourceError."""
    try:
        stamp = round(Decimal(word) * 10**9)
        if abs(stamp) < 2**63:
            return stamp
    except (InvalidOperation, ValueError, OverflowError):
        pass
    raise SourceError(f"{path} has a line that does not begin with a stamp in seconds: {word}")


def numbered(folder: Path, pattern: str) -> dict[int, Path]:
    """Files of a folder by number, the first group of a regular expression that matches the whole name."""
    matches = ((re.fullmatch(pattern, file.name), file) for file in folder.iterdir()) if folder.is_dir() else ()
    return dict(sorted((int(match[1]), file) for match, file in matches if match))


def file_of(files: dict[int, Path], number: int, kind: str) -> bytes:
    """Content of the file with this number. Raises FrameError."""
    if number not in files:
        raise FrameError(f"it has no {kind} file")
    return read_bytes(files[number])


def first_size(files: Sequence[Path]) -> tuple[int, int]:
    """Width and height, pixels, of the first image that can be read. Raises SourceError."""
    for file in files:
        try:
            width_px, height_px, _ = image_size(read_bytes(file))
            return width_px, height_px
        except (FrameError, ImageError):
            continue
    raise SourceError(f"no image in {files[0].parent if files else 'the source'} can be read")


def matrix_pose(text: str | bytes) -> np.ndarray:
    """The 4 x 4 matrix of sixteen numbers, row by row. Raises FrameError."""
    try:
        matrix = np.array(text.split(), float).reshape(4, 4)
    except ValueError as error:
        raise FrameError(f"its pose is not sixteen numbers: {error}") from error
    if not np.isfinite(matrix).all():
        raise FrameError("its pose is not finite")
    return matrix


def quaternion_pose(words: Sequence[str], *, scalar_first: bool = False) -> np.ndarray:
    """The 4 x 4 matrix of tx ty tz qx qy qz qw, or tx ty tz qw qx qy qz. Raises FrameError."""
    try:
        numbers = np.array(words[:7], float)
    except ValueError as error:
        raise FrameError(f"its pose is not seven numbers: {error}") from error
    quaternion_xyzw = np.roll(numbers[3:], -1) if scalar_first else numbers[3:]
    if not np.isfinite(numbers).all() or not np.linalg.norm(quaternion_xyzw) > 0:
        raise FrameError("its pose is not finite")
    return pose_from_quaternion(numbers[:3], quaternion_xyzw)


def decode_image(data: bytes, kind: str) -> np.ndarray:
    """Pixels of an image file as they are stored (OpenCV's channel order). Raises FrameError."""
    try:
        image_size(data)  # OpenCV would fill up an image that is cut off
    except ImageError as error:
        raise FrameError(f"the {kind} image is damaged: {error}") from error
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise FrameError(f"the {kind} image is damaged: it cannot be decoded")
    return image


def encode_image(image: np.ndarray, extension: str) -> bytes:
    """An image file, .png or .jpg."""
    settings = [cv2.IMWRITE_JPEG_QUALITY, 95] if extension == ".jpg" else []
    return cv2.imencode(extension, image, settings)[1].tobytes()


def millimetre_png(depth_m: np.ndarray) -> bytes:
    """A depth image (h, w), metres, as a 16 bit PNG in millimetres; what does not fit becomes 0, no measurement."""
    depth_mm = np.rint(depth_m * 1000.0)
    fits = np.isfinite(depth_mm) & (depth_mm > 0) & (depth_mm <= DEPTH_MAX)
    return encode_image(np.where(fits, depth_mm, 0).astype(np.uint16), ".png")


def levelling(world_up: Sequence[float], floor_m: float) -> np.ndarray | None:
    """world_from_source: the smallest rotation that turns `world_up` into z, and a shift that puts the floor at zero.

    None when nothing is to be done, so that poses pass unchanged to the last bit. Raises SourceError.
    """
    up = np.asarray(world_up, float)
    length = float(np.linalg.norm(up)) if up.shape == (3,) else 0.0
    if not (math.isfinite(length) and length > 0 and math.isfinite(floor_m)):
        raise SourceError(f"world_up must be three numbers, not all zero, such as 0 -1 0; got {list(world_up)}")
    if tuple(up) == UP and floor_m == 0.0:
        return None
    x, y, z = up / length
    world_from_source = np.eye(4)
    if z < -1 + 1e-12:
        world_from_source[:3, :3] = np.diag((1.0, -1.0, -1.0))  # upside down: every horizontal axis serves; x is taken
    else:
        cross = np.array(((0, 0, -x), (0, 0, -y), (x, y, 0)))  # Rodrigues' formula for the axis up x z
        world_from_source[:3, :3] = np.eye(3) + cross + cross @ cross / (1 + z)
    world_from_source[2, 3] = -floor_m
    return world_from_source

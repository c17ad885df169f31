"""What every source is, and the arithmetic all of them share."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from schemas.frames import Intrinsics
from services.ingest.core import BadFrame, RawFrame
from services.ingest.sources.images import ImageError, image_size

UP = (0.0, 0.0, 1.0)


class SourceError(RuntimeError):
    """A source cannot be opened; the text is one sentence for the user."""


class FrameError(ValueError):
    """One frame cannot be used; the text is the reason."""


@dataclass(frozen=True)
class Source:
    """A sequence of posed RGB-D frames. Iterating it reads files; each iteration begins at the first frame."""

    layout: str  # dataset, 7-scenes or log
    path: Path
    intrinsics: Intrinsics
    total: int
    frames: Callable[[], Iterator[RawFrame | BadFrame]]
    ground_truth: dict[str, Any] | None = None  # content of regions.json

    def __iter__(self) -> Iterator[RawFrame | BadFrame]:
        return self.frames()


@dataclass(frozen=True)
class Rig:
    """What is the same for all frames of a source."""

    intrinsics: Intrinsics
    depth_scale_m: float
    total: int
    world_from_source: np.ndarray | None  # None = the source's world has z up and its floor at zero already

    def frame(
        self, index: int, frame_id: int, stamp_ns: int, source_from_camera: np.ndarray, *, color: bytes, depth: bytes
    ) -> RawFrame:
        """A frame whose images fit the camera and whose pose is a rigid motion. Raises FrameError."""
        check_images(self.intrinsics, color, depth)
        pose = np.asarray(source_from_camera, np.float64)
        try:
            return RawFrame(
                frame_id=frame_id,
                stamp_ns=stamp_ns,
                intrinsics=self.intrinsics,
                world_from_camera=pose if self.world_from_source is None else self.world_from_source @ pose,
                color=color,
                depth=depth,
                depth_scale_m=self.depth_scale_m,
                index=index,
                total=self.total,
            )
        except ValueError as error:
            raise FrameError(str(error)) from error


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

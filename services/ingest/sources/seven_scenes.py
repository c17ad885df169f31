"""7-Scenes folders: frame-NNNNNN.color.png, .depth.png (millimetres, 65535 = invalid) and .pose.txt (camera to world).

A folder holds frames, or sequences seq-01, seq-02 … whose numbers are counted on. There are no stamps: the Kinect's
30 Hz are assumed. The world is that of the first camera, which was held roughly level, so up is taken to be -y. Give
the measured direction and the floor's height when places must lie level.
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.ingest.core.selection import BadFrame, RawFrame
from prior_sg.services.ingest.sources.base import FrameError, Rig, Source, SourceError, levelling, read_bytes
from prior_sg.services.ingest.sources.images import ImageError, image_size

POSES, SEQUENCES = "frame-*.pose.txt", "seq-*"
LOOKS = f"{POSES} or {SEQUENCES}/{POSES} (7-Scenes folder)"
INTRINSICS = "camera-intrinsics.txt"
PUBLISHED = (585.0, 585.0, 320.0, 240.0)  # fx fy cx cy of the data set's description
UP = (0.0, -1.0, 0.0)
FRAME_NS = 1e9 / 30
INVALID = 65535


@dataclass(frozen=True)
class Entry:
    """Where one frame lies."""

    frame_id: int
    stem: Path  # the files' common beginning

    def file(self, kind: str) -> Path:
        """Path of the frame's color.png, depth.png or pose.txt."""
        return self.stem.with_name(f"{self.stem.name}.{kind}")


def fits(path: Path) -> bool:
    """Whether a folder has this layout."""
    return path.is_dir() and (any(path.glob(POSES)) or any(path.glob(f"{SEQUENCES}/{POSES}")))


def load(path: Path, world_up: Sequence[float] = (), floor_m: float = 0.0) -> Source:
    """A 7-Scenes scene or sequence as a source. Raises SourceError."""
    entries = _entries(path)
    intrinsics = Intrinsics(*_size(entries), *_focal(path))
    rig = Rig(intrinsics, 0.001, len(entries), levelling(world_up or UP, floor_m))
    return Source("7-scenes", path, intrinsics, len(entries), lambda: _frames(rig, entries))


def _entries(path: Path) -> list[Entry]:
    folders = sorted(path.glob(SEQUENCES)) if any(path.glob(f"{SEQUENCES}/{POSES}")) else [path]
    entries: list[Entry] = []
    for folder in folders:
        offset = entries[-1].frame_id + 1 if entries else 0
        numbered = ((re.fullmatch(r"(frame-(\d+))\.pose\.txt", file.name), folder) for file in folder.glob(POSES))
        found = sorted((int(match[2]), folder / match[1]) for match, folder in numbered if match)
        entries += [Entry(offset + number, stem) for number, stem in found]
    return entries


def _frames(rig: Rig, entries: list[Entry]) -> Iterator[RawFrame | BadFrame]:
    for index, entry in enumerate(entries):
        try:
            color, depth = read_bytes(entry.file("color.png")), _valid_depth(read_bytes(entry.file("depth.png")))
            stamp_ns = round(entry.frame_id * FRAME_NS)
            yield rig.frame(index, entry.frame_id, stamp_ns, _pose(entry), color=color, depth=depth)
        except FrameError as error:
            yield BadFrame(frame_id=entry.frame_id, reason=str(error), index=index, total=rig.total)


def _pose(entry: Entry) -> np.ndarray:
    try:
        return np.array(read_bytes(entry.file("pose.txt")).split(), float).reshape(4, 4)
    except ValueError as error:
        raise FrameError(f"its pose is not sixteen numbers: {error}") from error


def _valid_depth(png: bytes) -> bytes:
    """The same depth image with 0 where it said "invalid"."""
    depth = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED) if png else None
    if depth is None or depth.dtype != np.uint16 or depth.ndim != 2:
        raise FrameError("the depth image is not a PNG file with one channel of 16 bits")
    if not (depth == INVALID).any():
        return png
    return cv2.imencode(".png", np.where(depth == INVALID, 0, depth).astype(np.uint16))[1].tobytes()


def _size(entries: list[Entry]) -> tuple[int, int]:
    for entry in entries:
        try:
            width_px, height_px, _ = image_size(read_bytes(entry.file("color.png")))
            return width_px, height_px
        except (FrameError, ImageError):
            continue
    raise SourceError(
        f"no colour image beside the poses in {entries[0].stem.parent} can be read: looked for frame-*.color.png"
    )


def _focal(path: Path) -> tuple[float, float, float, float]:
    """fx fy cx cy from the 3 x 3 matrix beside the frames or above the sequence, else as published."""
    for file in (path / INTRINSICS, path.parent / INTRINSICS):
        if file.is_file():
            try:
                matrix = np.array(file.read_text().split(), float).reshape(3, 3)
            except (OSError, ValueError) as error:
                raise SourceError(f"{file} is not a 3 x 3 matrix: {error}") from error
            return float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2])
    return PUBLISHED

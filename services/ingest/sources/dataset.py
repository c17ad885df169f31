"""Dataset folders.

camera.json       width height fx fy cx cy (pixels), depth_scale_m (metres per unit)
trajectory.csv    frame, stamp_ns, x_m y_m z_m qx qy qz qw: world_from_camera, world z up
color/NNNNNN.jpg  or .png; depth/NNNNNN.png with 16 bits, 0 = no measurement
mask/NNNNNN.png   where it exists: 8 bits, not 0 = something that moves, kept out of the map
pose_updates.csv  corrected poses, where they exist: stamp_ns (when the correction was made) and the columns of the
                  trajectory; rows that follow each other with one stamp are one correction
regions.json      ground truth, where it exists
"""

import csv
from collections.abc import Iterator, Sequence
from itertools import groupby
from pathlib import Path

import numpy as np

from prior_sg.services.ingest.core.selection import BadFrame, Correction, RawFrame
from prior_sg.services.ingest.sources.base import (
    CAMERA,
    REGIONS,
    UP,
    FrameError,
    Rig,
    Source,
    SourceError,
    camera_of,
    levelling,
    quaternion_pose,
    read_bytes,
    read_json,
)

TRAJECTORY, POSE_UPDATES = "trajectory.csv", "pose_updates.csv"
LOOKS = f"{CAMERA} and {TRAJECTORY} (dataset folder)"
COLUMNS = ("frame", "stamp_ns", "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")


def fits(path: Path) -> bool:
    """Whether a folder has this layout."""
    return (path / CAMERA).is_file() and (path / TRAJECTORY).is_file()


def load(path: Path, world_up: Sequence[float] = (), floor_m: float = 0.0) -> Source:
    """A dataset folder as a source. Raises SourceError."""
    camera = read_json(path / CAMERA)
    rows = _rows(path / TRAJECTORY)
    intrinsics = camera_of(path / CAMERA, camera)
    try:
        depth_scale_m = float(camera["depth_scale_m"])
    except (KeyError, TypeError, ValueError) as error:
        raise SourceError(f"{path / CAMERA} is not a camera: {error!r}") from error
    rig = Rig(intrinsics, depth_scale_m, len(rows), levelling(world_up or UP, floor_m))
    corrections = read_corrections(path / POSE_UPDATES, rig.world_from_source) if (path / POSE_UPDATES).exists() else []
    ground_truth = read_json(path / REGIONS) if (path / REGIONS).is_file() else None
    return Source(
        layout="dataset",
        path=path,
        intrinsics=intrinsics,
        total=len(rows),
        frames=lambda: _frames(path, rig, rows),
        ground_truth=ground_truth,
        corrections=lambda: iter(corrections),
    )


def read_corrections(path: Path, world_from_source: np.ndarray | None = None) -> list[Correction]:
    """Corrected poses of a CSV file with the columns of a trajectory, one correction per stamp. Raises SourceError."""
    corrections = []
    for stamp, rows in groupby(_rows(path), key=lambda row: row["stamp_ns"]):
        try:
            posed = [_posed(row) for row in rows]
            poses = np.stack([pose for _, _, pose in posed])
            corrections.append(
                Correction(
                    stamp_ns=int(stamp),
                    frame_ids=np.array([frame_id for frame_id, _, _ in posed], np.int64),
                    world_from_camera=poses if world_from_source is None else world_from_source @ poses,
                )
            )
        except ValueError as error:
            raise SourceError(f"{path}, stamp {stamp}: {error}") from error
    return sorted(corrections, key=lambda correction: correction.stamp_ns)


def _frames(path: Path, rig: Rig, rows: list[dict[str, str]]) -> Iterator[RawFrame | BadFrame]:
    for index, row in enumerate(rows):
        frame_id = -1
        try:
            frame_id, stamp_ns, pose = _posed(row)
            color, depth, mask = _images(path, frame_id)
            yield rig.frame(index, frame_id, stamp_ns, pose, color=color, depth=depth, mask=mask)
        except FrameError as error:
            yield BadFrame(frame_id=frame_id, reason=str(error), index=index, total=rig.total)


def _posed(row: dict[str, str]) -> tuple[int, int, np.ndarray]:
    try:
        frame_id, stamp_ns = int(row["frame"]), int(row["stamp_ns"])
        words = [str(float(row[name])) for name in COLUMNS[2:]]
    except (TypeError, ValueError) as error:
        raise FrameError(f"its row of {TRAJECTORY} is malformed: {error}") from error
    return frame_id, stamp_ns, quaternion_pose(words)


def _images(path: Path, frame_id: int) -> tuple[bytes, bytes, bytes]:
    color = path / "color" / f"{frame_id:06d}.jpg"
    if not color.exists() and color.with_suffix(".png").exists():
        color = color.with_suffix(".png")
    mask = path / "mask" / f"{frame_id:06d}.png"
    depth = read_bytes(path / "depth" / f"{frame_id:06d}.png")
    return read_bytes(color), depth, read_bytes(mask) if mask.exists() else b""


def _rows(path: Path) -> list[dict[str, str]]:
    try:
        with path.open(newline="") as file:
            reader = csv.DictReader(file, skipinitialspace=True)
            missing = [name for name in COLUMNS if name not in (reader.fieldnames or ())]
            if missing:
                raise SourceError(f"{path} lacks the columns {', '.join(missing)}")
            return list(reader)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise SourceError(f"{path} cannot be read: {error}") from error

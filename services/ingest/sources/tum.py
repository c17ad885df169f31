"""TUM RGB-D folders, and what is written in their format.

rgb.txt, depth.txt    stamp (seconds) and image file, a line each; lines that begin with # are comments
groundtruth.txt       stamp tx ty tz qx qy qz qw: world_from_camera of the colour camera, metres
rgb/*.png             8 bit; depth/*.png 16 bit, factor 5000, 0 = no measurement, registered to colour
camera.json           optional, ours: width height fx fy cx cy, and depth_scale_m where the factor is another

The three lists have stamps of their own. As the publisher's associate.py does, each colour image gets the depth image
and the pose closest in time, within 20 ms and each used once; the frame bears the colour image's stamp. Camera axes
are x right, y down, z forward. The world is the motion capture system's, z up, floor near zero. Without camera.json
the camera is the published one of freiburg1, freiburg2 or freiburg3, by the folder's name. Lens distortion (freiburg1
and freiburg2) is left in the images, as in the publisher's generate_pointcloud.py. Ground truth: poses only.
Source: "File Formats" and "Intrinsic Camera Calibration" on cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats.
"""

import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.ingest.sources.base import (
    CAMERA,
    UP,
    Entry,
    FrameError,
    Rig,
    Source,
    SourceError,
    camera_of,
    levelling,
    quaternion_pose,
    read_bytes,
    read_json,
    sequence,
    stamp_ns,
    table,
)

COLORS, DEPTHS, POSES = "rgb.txt", "depth.txt", "groundtruth.txt"
LOOKS = f"{COLORS}, {DEPTHS} and {POSES} (TUM RGB-D folder)"
WITHIN_NS = 20_000_000  # associate.py's largest difference
DEPTH_SCALE_M = 1 / 5000
PUBLISHED = {
    "freiburg1": Intrinsics(640, 480, 517.3, 516.5, 318.6, 255.3),
    "freiburg2": Intrinsics(640, 480, 520.9, 521.0, 325.1, 249.7),
    "freiburg3": Intrinsics(640, 480, 535.4, 539.2, 320.1, 247.6),
}


def fits(path: Path) -> bool:
    """Whether a folder has this layout."""
    return all((path / name).is_file() for name in (COLORS, DEPTHS, POSES))


def load(path: Path, world_up: Sequence[float] = (), floor_m: float = 0.0) -> Source:
    """A TUM RGB-D folder as a source. Raises SourceError."""
    intrinsics, depth_scale_m = _camera(path)
    colors, depths, poses = (_stamped(path / n, columns) for n, columns in ((COLORS, 2), (DEPTHS, 2), (POSES, 8)))
    stamps_ns = [stamp for stamp, _ in colors]
    depth_of = associate(stamps_ns, [stamp for stamp, _ in depths], WITHIN_NS)
    pose_of = associate(stamps_ns, [stamp for stamp, _ in poses], WITHIN_NS)
    entries = [
        Entry(
            index,
            stamp,
            partial(
                _read,
                path,
                words[0],
                depths[depth_of[index]][1][0] if index in depth_of else None,
                poses[pose_of[index]][1] if index in pose_of else None,
            ),
        )
        for index, (stamp, words) in enumerate(colors)
    ]
    return sequence(
        "tum", path, Rig(intrinsics, depth_scale_m, len(entries), levelling(world_up or UP, floor_m)), entries
    )


def associate(first_ns: Sequence[int], second_ns: Sequence[int], within_ns: int) -> dict[int, int]:
    """Index in `second_ns` (rising) of each index in `first_ns` that finds one: closest first, each used once."""
    second = np.asarray(second_ns, np.int64)
    first = np.asarray(first_ns, np.int64)
    begins = np.searchsorted(second, first - within_ns, side="right")
    ends = np.searchsorted(second, first + within_ns, side="left")
    pairs = sorted(
        (abs(int(first[i] - second[j])), i, j)
        for i, (begin, end) in enumerate(zip(begins, ends, strict=True))
        for j in range(begin, end)
    )
    partner: dict[int, int] = {}
    used: set[int] = set()
    for _, i, j in pairs:
        if i not in partner and j not in used:
            partner[i] = j
            used.add(j)
    return partner


def _read(path: Path, color: str, depth: str | None, pose: list[str] | None) -> tuple[np.ndarray, bytes, bytes]:
    if depth is None or pose is None:
        raise FrameError(f"no {'depth image' if depth is None else 'pose'} lies within 20 ms of it")
    return quaternion_pose(pose), read_bytes(path / color), read_bytes(path / depth)


def _stamped(path: Path, columns: int) -> list[tuple[int, list[str]]]:
    """Stamp (nanoseconds) and the other words of each line, by stamp."""
    return sorted((stamp_ns(row[0], path), row[1:]) for row in table(path, columns))


def _camera(path: Path) -> tuple[Intrinsics, float]:
    if (path / CAMERA).is_file():
        camera = read_json(path / CAMERA)
        intrinsics = camera_of(path / CAMERA, camera)
        try:
            return intrinsics, float(camera.get("depth_scale_m", DEPTH_SCALE_M))
        except (TypeError, ValueError) as error:
            raise SourceError(f"{path / CAMERA} is not a camera: {error!r}") from error
    match = re.search(r"freiburg[123]", path.resolve().name)
    if match is None:
        raise SourceError(
            f"the camera of {path} is unknown: put freiburg1, freiburg2 or freiburg3 into the folder's name, "
            f"or a {CAMERA} with width, height, fx, fy, cx, cy beside {COLORS}"
        )
    return PUBLISHED[match[0]], DEPTH_SCALE_M

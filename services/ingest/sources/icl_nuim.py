"""ICL-NUIM sequences as "TUM RGB-D compatible PNGs", with their trajectory beside them.

associations.txt      frame, depth file, frame, colour file, a line each: 0 depth/0.png 0 rgb/0.png
*.gt.freiburg         frame tx ty tz qx qy qz qw (livingRoomN.gt.freiburg, trajN.gt.freiburg)
rgb/N.png             8 bit; depth/N.png 16 bit, factor 5000, along the optical axis

The renderer's frames are left-handed: world x right, y up, z forward, and camera x right, y UP, z forward. Hence the
published camera has fy = -480, which points y up in an image whose first row is the upper one. A camera with y down
is the same with fy = +480 and its y axis mirrored; to be a rigid motion, the pose must then be mirrored on the
world's side too. We do so by exchanging the world's y and z, which also turns it to z up. A pose [R t] with fy = -480
thus becomes exchange(y, z) [R t] mirror(y) with fy = +480, and rooms come out as they are and not as in a mirror.
Frames have no stamps: 30 Hz, as published. A trajectory may lack its first frame: that frame is bad. Ground truth:
poses only. Source: A. Handa et al., ICRA 2014, and www.doc.ic.ac.uk/~ahanda/VaFRIC/iclnuim.html.
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.ingest.sources.base import (
    UP,
    Entry,
    FrameError,
    Rig,
    Source,
    SourceError,
    levelling,
    quaternion_pose,
    read_bytes,
    sequence,
    table,
)

PAIRS, POSES = "associations.txt", "*.gt.freiburg"
LOOKS = f"{PAIRS} and {POSES} (ICL-NUIM folder)"
CAMERA = Intrinsics(640, 480, 481.2, 480.0, 319.5, 239.5)
DEPTH_SCALE_M = 1 / 5000
FRAME_NS = 1e9 / 30
MIRRORED_Y = np.diag((1.0, -1.0, 1.0, 1.0))
EXCHANGED_YZ = np.eye(4)[[0, 2, 1, 3]]


def fits(path: Path) -> bool:
    """Whether a folder has this layout."""
    return path.is_dir() and (path / PAIRS).is_file() and any(path.glob(POSES))


def load(path: Path, world_up: Sequence[float] = (), floor_m: float = 0.0) -> Source:
    """An ICL-NUIM folder as a source. Raises SourceError."""
    trajectories = sorted(path.glob(POSES))
    if len(trajectories) > 1:
        raise SourceError(f"{path} holds several trajectories: keep one of {', '.join(t.name for t in trajectories)}")
    poses = {_number(row[0], trajectories[0]): row[1:] for row in table(trajectories[0], 8)}
    entries = []
    for row in table(path / PAIRS, 4):
        number = _number(row[0], path / PAIRS)
        depth, color = sorted((row[1], row[3]), key=lambda name: "depth" not in name)
        read = partial(_read, path / color, path / depth, poses.get(number))
        entries.append(Entry(number, round(number * FRAME_NS), read))
    rig = Rig(CAMERA, DEPTH_SCALE_M, len(entries), levelling(world_up or UP, floor_m))
    return sequence("icl-nuim", path, rig, entries)


def _read(color: Path, depth: Path, pose: list[str] | None) -> tuple[np.ndarray, bytes, bytes]:
    if pose is None:
        raise FrameError("the trajectory has no pose for it")
    return EXCHANGED_YZ @ quaternion_pose(pose) @ MIRRORED_Y, read_bytes(color), read_bytes(depth)


def _number(word: str, path: Path) -> int:
    try:
        return int(float(word))
    except (ValueError, OverflowError) as error:
        raise SourceError(f"{path} has a line that does not begin with a frame number: {word}") from error

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

from functools import partial
from pathlib import Path

import numpy as np

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.ingest.core.options import ReadOptions
from prior_sg.services.ingest.core.poses import quaternion_of
from prior_sg.services.ingest.sources.base import (
    Camera,
    Entry,
    Found,
    FrameError,
    Images,
    SourceError,
    read_bytes,
    truth_beside,
)
from prior_sg.services.ingest.sources.tables import table

NAME = "icl-nuim"
PAIRS, POSES = "associations.txt", "*.gt.freiburg"
LOOKS = f"{PAIRS} and {POSES} (ICL-NUIM folder)"
CAMERA = Intrinsics(640, 480, 481.2, 480.0, 319.5, 239.5)
DEPTH_SCALE_M = 1 / 5000
RATE_HZ = 30.0
MIRRORED_Y = np.diag((1.0, -1.0, 1.0, 1.0))
EXCHANGED_YZ = np.eye(4)[[0, 2, 1, 3]]


def fits(path: Path) -> bool:
    """Whether a folder has this layout."""
    return path.is_dir() and (path / PAIRS).is_file() and any(path.glob(POSES))


def load(path: Path, options: ReadOptions) -> Found:
    """An ICL-NUIM folder. Raises SourceError."""
    trajectories = sorted(path.glob(POSES))
    if len(trajectories) > 1:
        raise SourceError(f"{path} holds several trajectories: keep one of {', '.join(t.name for t in trajectories)}")
    if options.poses or options.camera_axes:
        raise SourceError("an ICL-NUIM folder has left-handed poses of its own: leave out --poses and --axes")
    order = options.quaternion or "xyzw"
    poses = {_number(row[0], trajectories[0]): row[1:] for row in table(trajectories[0], 8)}
    entries = []
    for row in sorted(table(path / PAIRS, 4), key=lambda row: _number(row[0], path / PAIRS)):
        number = _number(row[0], path / PAIRS)
        depth, color = sorted((row[1], row[-1]), key=lambda name: "depth" not in name)
        entries.append(
            Entry(
                number,
                round(number * options.frame_ns(RATE_HZ)),
                partial(_pose, poses.get(number), order),
                partial(_images, path / color, path / depth),
            )
        )
    return Found(
        NAME,
        path,
        Camera(CAMERA, published=True),
        DEPTH_SCALE_M,
        entries,
        ground_truth=truth_beside(path),
        why=(f"{PAIRS} and {trajectories[0].name} lie in it",),
        assumed_hz=0.0 if options.rate_hz else RATE_HZ,
    )


def _pose(pose: list[str] | None, order: str) -> np.ndarray:
    if pose is None:
        raise FrameError("the trajectory has no pose for it")
    return EXCHANGED_YZ @ quaternion_of(pose, order) @ MIRRORED_Y


def _images(color: Path, depth: Path) -> Images:
    return Images(read_bytes(color), read_bytes(depth))


def _number(word: str, path: Path) -> int:
    try:
        return int(float(word))
    except (ValueError, OverflowError) as error:
        raise SourceError(f"{path} has a line that does not begin with a frame number: {word}") from error

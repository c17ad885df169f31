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
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.ingest.core.options import ReadOptions
from prior_sg.services.ingest.core.pairing import associate
from prior_sg.services.ingest.core.poses import Convention
from prior_sg.services.ingest.sources.base import (
    CAMERA,
    Camera,
    Entry,
    Found,
    FrameError,
    Images,
    SourceError,
    camera_of,
    read_bytes,
    truth_beside,
)
from prior_sg.services.ingest.sources.tables import FEW, lines_of, named, read_json, stamps_ns, table

NAME = "tum"
COLORS, DEPTHS, POSES = "rgb.txt", "depth.txt", "groundtruth.txt"
LOOKS = f"{COLORS}, {DEPTHS} and {POSES} (TUM RGB-D folder)"
WITHIN_NS = 20_000_000  # associate.py's largest difference
DEPTH_SCALE_M = 1 / 5000
NEARLY_NONE, MOST, NEARLY_ALL = 0.1, 0.5, 0.9  # shares of the colour images that find a partner
PUBLISHED = {
    "freiburg1": Intrinsics(640, 480, 517.3, 516.5, 318.6, 255.3),
    "freiburg2": Intrinsics(640, 480, 520.9, 521.0, 325.1, 249.7),
    "freiburg3": Intrinsics(640, 480, 535.4, 539.2, 320.1, 247.6),
}


def fits(path: Path) -> bool:
    """Whether a folder has this layout."""
    return all((path / name).is_file() for name in (COLORS, DEPTHS, POSES))


@dataclass(frozen=True)
class Stamped:
    """The lines of one list, by stamp."""

    path: Path
    stamps_ns: list[int]
    lines: list[list[str]]  # the words behind the stamp


def load(path: Path, options: ReadOptions) -> Found:
    """A TUM RGB-D folder. Raises SourceError."""
    camera, depth_scale_m = _camera(path, options)
    (colors, said), (depths, _) = (_stamped(path / name, 2, options) for name in (COLORS, DEPTHS))
    poses, poses_said = _stamped(path / POSES, 8, options)
    depth_of, depth_shift = _partners(colors, depths, None)
    pose_of, pose_shift = _partners(colors, poses, options.stamp_offset_s)
    convention = Convention().changed(options)
    entries = []
    for index, (stamp, words) in enumerate(zip(colors.stamps_ns, colors.lines, strict=True)):
        depth = depths.lines[depth_of[index]][0] if index in depth_of else None
        pose = poses.lines[pose_of[index]] if index in pose_of else None
        entries.append(
            Entry(
                index,
                options.told_ns(index, stamp),
                partial(_pose, depth, pose, convention),
                partial(_images, path, words[0], depth),
            )
        )
    return Found(
        NAME,
        path,
        camera,
        depth_scale_m,
        entries,
        ground_truth=truth_beside(path),
        convention=convention,
        why=(f"{COLORS}, {DEPTHS} and {POSES} lie in it",),
        notes=tuple(filter(None, (said, poses_said, depth_shift, pose_shift))),
    )


def _partners(colors: Stamped, others: Stamped, offset_s: float | None) -> tuple[dict[int, int], str]:
    """Index in `others` of each colour image that finds one, and what was shifted to find it. Raises SourceError."""
    shift_ns = round((offset_s or 0.0) * 1e9)
    found = associate(colors.stamps_ns, [stamp + shift_ns for stamp in others.stamps_ns], WITHIN_NS)
    count = len(colors.stamps_ns)
    note = f"{offset_s:g} s are added to the stamps of {others.path.name}, as told" if offset_s else ""
    if count < FEW or len(found) >= MOST * count:
        return found, note
    if offset_s is None and (best := _constant_shift(colors.stamps_ns, others.stamps_ns)) is not None:
        shifted = associate(colors.stamps_ns, [stamp + best for stamp in others.stamps_ns], WITHIN_NS)
        return shifted, (
            f"the clock of {others.path.name} is another: {best / 1e9:+.3f} s are added to its stamps, with which "
            f"{len(shifted)} of {count} colour images find a line (say otherwise with --stamp-offset)"
        )
    if not others.stamps_ns:
        raise SourceError(f"{others.path} holds no lines")
    if len(found) < NEARLY_NONE * count:
        begin_s = (others.stamps_ns[0] - colors.stamps_ns[0]) / 1e9
        raise SourceError(
            f"{len(found)} of {count} colour images find a line within 20 ms in {others.path}, which begins "
            f"{begin_s:+.3f} s after {COLORS}: give the difference of the clocks with --stamp-offset SECONDS"
        )
    return found, note


def _constant_shift(first_ns: Sequence[int], second_ns: Sequence[int]) -> int | None:
    """The one constant that, added to `second_ns`, gives nearly all of `first_ns` a partner; None when several do.

    Candidates are the differences between the first stamps of one list and those of the other; those that
    associate as many lie within a few times the tolerance of each other, or the constant cannot be told.
    """
    first, second = np.asarray(first_ns, np.int64), np.asarray(second_ns, np.int64)
    if not len(second):
        return None
    anchors = first[np.unique(np.linspace(0, len(first) - 1, 8).astype(int))]
    candidates = np.unique((anchors[:, None] - second[None, :]).ravel())
    ends = np.concatenate((first[:1] - second[:1], first[-1:] - second[-1:]))
    candidates = np.unique(np.concatenate((candidates[:: max(1, len(candidates) // 20_000)], ends)))
    counts = np.array([_met(first, second + shift) for shift in candidates])
    if counts.max() < NEARLY_ALL * len(first):
        return None
    best = candidates[counts == counts.max()]
    if best[-1] - best[0] > 2 * WITHIN_NS:
        return None
    return int(np.median(best))


def _met(first: np.ndarray, second: np.ndarray) -> int:
    """How many of `first` have one of `second` (both rising) within the tolerance."""
    begins = np.searchsorted(second, first - WITHIN_NS, side="right")
    ends = np.searchsorted(second, first + WITHIN_NS, side="left")
    return int((ends > begins).sum())


def _pose(depth: str | None, pose: list[str] | None, convention: Convention) -> np.ndarray:
    if depth is None or pose is None:
        raise FrameError(f"no {'depth image' if depth is None else 'pose'} lies within 20 ms of it")
    return convention.of_words(pose)


def _images(path: Path, color: str, depth: str | None) -> Images:
    return Images(read_bytes(path / color), read_bytes(path / (depth or "")))


def _stamped(path: Path, columns: int, options: ReadOptions) -> tuple[Stamped, str]:
    """The lines of a list by stamp, and a note on its unit; lines without a stamp are left out. Raises SourceError."""
    if columns == 2:  # a file's name may have blanks
        rows: list[list[str]] = [list(named(line)) for line in lines_of(path)]
    else:
        rows = table(path, columns)
    if rows and re.match(r"[A-Za-z]", rows[0][0]) and rows[0][0].lower() not in ("nan", "inf"):
        rows = rows[1:]  # names of columns without the sign of a comment
    stamps, note = stamps_ns([row[0] for row in rows], path, "s", options.stamp_unit)
    lines = sorted((stamp, row[1:]) for stamp, row in zip(stamps, rows, strict=True) if stamp is not None)
    return Stamped(path, [stamp for stamp, _ in lines], [words for _, words in lines]), note


def _camera(path: Path, options: ReadOptions) -> tuple[Camera, float]:
    if (path / CAMERA).is_file():
        camera = read_json(path / CAMERA)
        described = camera_of(path / CAMERA, camera)
        try:
            return described, float(camera.get("depth_scale_m", DEPTH_SCALE_M))
        except (TypeError, ValueError) as error:
            raise SourceError(f"{path / CAMERA} is not a camera: {error!r}") from error
    match = re.search(r"freiburg[123]", path.resolve().name)
    if match is not None:
        return Camera(PUBLISHED[match[0]], published=True), DEPTH_SCALE_M
    if options.intrinsics:
        return Camera(PUBLISHED["freiburg3"], published=True), DEPTH_SCALE_M
    raise SourceError(
        f"the camera of {path} is unknown: put freiburg1, freiburg2 or freiburg3 into the folder's name, give "
        f"--intrinsics FX,FY,CX,CY, or a {CAMERA} with width, height, fx, fy, cx, cy beside {COLORS}"
    )

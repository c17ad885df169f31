"""The poses of a folder of one's own, and what they mean.

What the poses map, the camera's axes, the order of quaternions and the unit of depth are taken from the options, or
found by how well depth images agree under each meaning; what cannot be told is asked for.
"""

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.headers import ImageError
from prior_sg.services.ingest.core.detection import (
    CHOICES,
    LEAST_SHARE,
    OPTIONS,
    USUAL_UNIT_M,
    Meaning,
    Verdict,
    Written,
    meaning_of,
    moving_pairs,
    plausible_units,
)
from prior_sg.services.ingest.core.options import ReadOptions
from prior_sg.services.ingest.core.pixels import NPY_MAGIC, stored
from prior_sg.services.ingest.core.poses import Convention, PoseError, matrix_of, rigid
from prior_sg.services.ingest.sources.base import Camera, FrameError, SourceError, depth_pixels, read_bytes
from prior_sg.services.ingest.sources.cameras import scaled
from prior_sg.services.ingest.sources.own_files import Files, Folder
from prior_sg.services.ingest.sources.pose_lists import PoseList

POSITION_SCALES_M = (0.001, 0.01)  # millimetres and centimetres, tried when metres make no sense
PAIRS = 8  # pairs of frames that tell what poses mean


@dataclass(frozen=True)
class Known:
    """What the camera's file says."""

    camera: Camera
    depth_unit_m: float | None


def _numbers_of(file: Files) -> np.ndarray:
    """The pose as it is written, (4, 4) or (7,). Raises FrameError or PoseError."""
    if file.pose is None:
        raise FrameError("it has no pose file, and no line in a list of poses")
    if isinstance(file.pose, np.ndarray):
        return file.pose
    data = read_bytes(file.pose)
    if data.startswith(NPY_MAGIC):
        text = " ".join(repr(float(number)) for number in np.ravel(stored(data)))
    else:
        lines = data.decode("utf-8-sig", errors="replace").splitlines()
        text = re.sub(r"[,;\[\]]", " ", " ".join(line for line in lines if not line.lstrip().startswith("#")))
    words = text.split()
    if len(words) != 7:
        return matrix_of(text)
    try:
        return np.array(words, float)
    except ValueError as error:
        raise PoseError(f"its pose is not seven numbers: {error}") from error


def pose_of(file: Files, convention: Convention) -> np.ndarray:
    """Source from camera (4, 4), as the numbers mean it. Raises FrameError or PoseError."""
    pose = _numbers_of(file)
    return Written(np.zeros((1, 1)), pose).source_from_camera(convention)


def usable_pose(file: Files, convention: Convention) -> np.ndarray | None:
    """The same made rigid; None where there is none that can be used."""
    try:
        return rigid(pose_of(file, convention))
    except (FrameError, PoseError, ImageError):
        return None


def verdict_of(
    path: Path, files: list[Files], known: Known, folder: Folder, options: ReadOptions
) -> tuple[Verdict, list[str]]:
    """What poses and depth mean, and how that is known. Raises SourceError that names the options."""
    pairs = _pairs(path, files)
    if folder.depthless:
        return _told_verdict(path, files, folder.listed, options)
    depths = [written.depth for pair in pairs for written in pair]
    told = _told(pairs, folder.listed, options)
    open_ = [name for name, value in told.items() if not value]
    if not pairs and open_:
        raise SourceError(f"{path} does not tell what its poses mean, the camera hardly moves: give {_asked(open_)}")
    camera, known_m = known.camera.intrinsics, options.depth_scale_m or known.depth_unit_m
    floats = any(depth.dtype.kind == "f" for depth in depths)
    units_m = [known_m] if known_m else [1.0] if floats else plausible_units(depths) or [USUAL_UNIT_M]
    size = depths[0].shape if depths else (camera.height_px, camera.width_px)
    at = _at(camera, (size[1], size[0]))
    verdict = meaning_of(pairs, at, _conventions(told, options.position_scale_m), units_m)
    if verdict.share < LEAST_SHARE and options.position_scale_m == 1.0:
        tried = [meaning_of(pairs, at, _conventions(told, scale), units_m) for scale in POSITION_SCALES_M]
        verdict = max((verdict, *tried), key=lambda one: one.share if one.share >= LEAST_SHARE else 0.0)
    unclear = [name for name in verdict.unclear if name in open_]
    if open_ and (unclear or verdict.share < LEAST_SHARE):
        raise SourceError(
            f"{path} does not tell what its poses mean: depth images agree by {verdict.share:.0%} at best; "
            f"give {_asked(unclear or open_)}, and --depth-scale"
        )
    said = _said(verdict, folder.listed, open_)
    return verdict, said if floats else [*said, _unit_said(known_m, units_m, verdict)]


def _told_verdict(
    path: Path, files: list[Files], listed: PoseList | None, options: ReadOptions
) -> tuple[Verdict, list[str]]:
    """What poses mean where no depth images could tell. Raises SourceError that names the options."""
    first = Written(np.zeros((1, 1)), _first_numbers(files))
    told = _told([(first, first)], listed, options)
    if open_ := [name for name, value in told.items() if not value]:
        raise SourceError(f"{path} has no depth that would tell what its poses mean: give {_asked(open_)}")
    (convention,) = _conventions(told, options.position_scale_m)
    verdict = Verdict(Meaning(convention, USUAL_UNIT_M), 0.0, ())
    return verdict, _said(verdict, listed, ())


def _first_numbers(files: list[Files]) -> np.ndarray:
    """The first pose that can be read, as it is written; there is one."""
    for file in files:
        try:
            return _numbers_of(file)
        except (FrameError, PoseError, ImageError):
            continue
    raise AssertionError("_pairs has found one")


def _told(pairs: Sequence[tuple[Written, Written]], listed: PoseList | None, options: ReadOptions) -> dict[str, str]:
    """What options, or the format of a list, say of the poses; empty = nobody says."""
    told: dict[str, str] = {"poses": options.poses, "axes": options.camera_axes, "quaternion": options.quaternion}
    if listed is not None and listed.convention is not None:
        told = {name: value or getattr(listed.convention, name) for name, value in told.items()}
    if not any(written.pose.shape == (7,) for pair in pairs for written in pair):
        told["quaternion"] = told["quaternion"] or "xyzw"
    return told


def _conventions(told: dict[str, str], position_scale_m: float) -> list[Convention]:
    choices = [(told[name],) if told[name] else CHOICES[name] for name in CHOICES]
    return [Convention(poses, axes, quaternion, position_scale_m) for poses, axes, quaternion in product(*choices)]


def _unit_said(known_m: float | None, units_m: Sequence[float], verdict: Verdict) -> str:
    how = "found by the same agreement" if len(units_m) > 1 else "the one that makes a room"
    if "unit" in verdict.unclear:
        how = "assumed, the movement does not tell; --depth-scale says otherwise"
    return f"{verdict.meaning.unit_m:.6g} metres per depth unit ({'as told' if known_m else how})"


def _said(verdict: Verdict, listed: PoseList | None, open_: Sequence[str]) -> list[str]:
    """What the poses were taken for, and how that is known."""
    convention = verdict.meaning.convention
    how = f"found: depth images agree by {verdict.share:.0%}" if open_ else "as told"
    if listed is not None and listed.convention == replace(convention, position_scale_m=1.0):
        how = f"as {listed.path.name} has them"
    said = [f"{convention.said()} ({how})"]
    if convention.position_scale_m != 1.0:
        said.append(
            f"positions are read as units of {convention.position_scale_m:g} m (--position-scale says otherwise)"
        )
    return said


def _at(camera: Intrinsics, size: tuple[int, int]) -> Intrinsics:
    return camera if (camera.width_px, camera.height_px) == size else scaled(camera, size)


def _asked(names: Sequence[str]) -> str:
    return " and ".join(f"{OPTIONS[name]} {'|'.join(CHOICES[name])}" for name in names)


def _pairs(path: Path, files: list[Files]) -> list[tuple[Written, Written]]:
    """Pairs of frames between which the camera moved, as they are written. Raises SourceError without any pose."""
    posed, reasons = [], []
    for file in files:
        try:
            numbers = _numbers_of(file)
            pose = rigid(Written(np.zeros((1, 1)), numbers).source_from_camera(Convention()))
            posed.append((file, numbers, pose))
        except (FrameError, PoseError, ImageError) as error:
            reasons.append(str(error))
    if reasons and not posed:
        raise SourceError(f"none of the poses of {path} can be used: {Counter(reasons).most_common(1)[0][0]}")
    pairs = []
    for i, j in moving_pairs([pose for _, _, pose in posed], PAIRS):
        try:
            first, second = (Written(_depth(posed[k][0]), posed[k][1]) for k in (i, j))
            pairs.append((first, second))
        except FrameError:
            continue
    return pairs


def _depth(file: Files) -> np.ndarray:
    """A depth image in its own units, 0 where it says nothing. Raises FrameError."""
    depth = depth_pixels(read_bytes(file.depth) if file.depth else b"")
    if depth.ndim != 2:
        raise FrameError("the depth image does not have one channel")
    with np.errstate(invalid="ignore"):
        return np.where(np.isfinite(depth) & (depth > 0) & (depth != 65535), depth, 0)

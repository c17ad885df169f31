"""What `rtabmap-export --images --poses_camera` (or `--poses`) writes of a database of RTAB-Map.

NAME_rgb/STAMP.jpg            the pictures; with --images_id the number of the node in place of the stamp
NAME_depth/STAMP.png          16 bits, millimetres
NAME_calib/STAMP.yaml         image_width, image_height, camera_matrix, distortion_coefficients, local_transform
NAME_camera_poses.txt         world_from_camera, z up, x right, y down, z forward; else NAME_poses.txt: those of the
                              robot, carried to the camera by local_transform
                              rows of stamp x y z qx qy qz qw, and the node's number in format 11, the default; format 0
                              has twelve numbers and takes the pictures in their order

Source: github.com/introlab/rtabmap, tools/Export/main.cpp, corelib/src/Graph.cpp, CameraModel.cpp.
"""

import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from prior_sg.services.ingest.core.options import ReadOptions
from prior_sg.services.ingest.core.poses import Convention, PoseError, quaternion_of
from prior_sg.services.ingest.sources import base
from prior_sg.services.ingest.sources.base import (
    MILLIMETRE,
    Entry,
    Found,
    FrameError,
    Images,
    SourceError,
    camera_of,
    read_bytes,
    truth_beside,
)
from prior_sg.services.ingest.sources.own_cameras import fields_of, in_brackets
from prior_sg.services.ingest.sources.tables import lines_of, text_of

NAME = "rtabmap"
COLORS, DEPTHS, CALIBRATIONS = "_rgb", "_depth", "_calib"
LOOKS = "NAME_rgb/, NAME_depth/, NAME_calib/ and NAME_camera_poses.txt (rtabmap-export)"
AGAIN = "export it again with `rtabmap-export --images --poses_camera DATABASE`"
NEAR_S = 0.002  # stamps are written with six decimals, and images may lie a little beside their node


def fits(path: Path) -> bool:
    """Whether a folder has this layout."""
    return _name(path) is not None


def load(path: Path, options: ReadOptions) -> Found:
    """An export of RTAB-Map. Raises SourceError."""
    name = _name(path)
    if name is None:
        raise SourceError(f"{path} lacks pictures, or both depth and calibration: {AGAIN}")
    colors, depths = (_by_stem(path / f"{name}{part}") for part in (COLORS, DEPTHS))
    calibration = next(iter(sorted((path / f"{name}{CALIBRATIONS}").glob("*.yaml"))), None)
    if calibration is None:
        raise SourceError(f"{path} has no calibration in {name}{CALIBRATIONS}/: {AGAIN}")
    poses, poses_file = _poses(path, name, sorted(colors, key=float), calibration)
    convention = Convention().changed(options)
    stamped = all("." in stem for stem in colors)
    entries = [
        Entry(
            number,
            options.told_ns(number, round(float(stem) * 1e9)) if stamped else round(number * options.frame_ns(1.0)),
            partial(_pose, poses, stem, convention),
            partial(_images, colors, depths, stem),
        )
        for number, stem in enumerate(sorted(colors, key=float))
    ]
    return Found(
        NAME,
        path,
        _camera(calibration),
        MILLIMETRE,
        entries,
        ground_truth=truth_beside(path),
        convention=convention,
        why=(f"{name}{COLORS}/ and {name}{CALIBRATIONS}/ lie in it",),
        notes=(f"poses of {poses_file.name}",),
        assumed_hz=0.0 if stamped or options.rate_hz else 1.0,
    )


def _name(path: Path) -> str | None:
    """What the export was called."""
    folders = sorted(child.name for child in path.iterdir() if child.is_dir()) if path.is_dir() else []
    names = [folder.removesuffix(COLORS) for folder in folders if folder.endswith(COLORS)]
    return next((n for n in names if {f"{n}{DEPTHS}", f"{n}{CALIBRATIONS}"} & set(folders)), None)


def _by_stem(folder: Path) -> dict[str, Path]:
    """Files by the stamp or number that names them."""
    if not folder.is_dir():
        raise SourceError(f"{folder} is not there: {AGAIN}")
    files = sorted(file for file in folder.iterdir() if re.fullmatch(r"\d+(?:\.\d+)?", file.stem))
    return {file.stem: file for file in files}


def _camera(calibration: Path) -> base.Camera:
    try:
        return camera_of(calibration, fields_of(calibration) | _lens(calibration))
    except (ValueError, TypeError, AttributeError) as error:
        raise SourceError(f"{calibration} is not a camera: {error}") from error


def _lens(calibration: Path) -> dict[str, str]:
    found = re.search(r"^distortion_model:\s*\"?(\w+)", text_of(calibration), re.MULTILINE)
    return {"model": found[1]} if found else {}


def _poses(
    path: Path, name: str, stems: Sequence[str], calibration: Path
) -> tuple[dict[str, np.ndarray | PoseError], Path]:
    """world_from_camera by the picture's name, and the file it is from. Raises SourceError."""
    files = (path / f"{name}_camera_poses.txt", path / f"{name}_poses.txt")
    file = next((file for file in files if file.is_file()), None)
    if file is None:
        raise SourceError(f"{path} has no {files[0].name}: {AGAIN}")
    body_from_camera = np.eye(4) if file == files[0] else _local_transform(calibration)
    rows = [line.split() for line in lines_of(file)]
    widths = {len(row) for row in rows}
    if widths == {12}:
        return _in_order(file, rows, stems, body_from_camera), file
    if widths not in ({8}, {9}):
        raise SourceError(f"{file} has rows that are no poses of format 11, 10 or 0: {AGAIN}")
    return _by_name(rows, stems, body_from_camera), file


def _in_order(
    file: Path, rows: list[list[str]], stems: Sequence[str], body_from_camera: np.ndarray
) -> dict[str, np.ndarray | PoseError]:
    if len(rows) != len(stems):
        raise SourceError(f"{file} has {len(rows)} poses without stamps for {len(stems)} pictures: {AGAIN}")
    try:
        table = np.array(rows, np.float64).reshape(-1, 3, 4)
    except ValueError as error:
        raise SourceError(f"{file} is no list of poses: {error}") from error
    last = np.tile(np.array((0.0, 0.0, 0.0, 1.0)), (len(table), 1, 1))
    matrices = np.concatenate((table, last), axis=1) @ body_from_camera
    return dict(zip(stems, matrices, strict=True))


def _by_name(
    rows: list[list[str]], stems: Sequence[str], body_from_camera: np.ndarray
) -> dict[str, np.ndarray | PoseError]:
    """By the node's number where pictures are named so, else by the nearest stamp."""
    found: dict[str, np.ndarray | PoseError] = {}
    by_node = {row[8]: row for row in rows if len(row) == 9}
    stamps = np.array([_stamp(row[0]) for row in rows])
    for stem in stems:
        row = by_node.get(stem)
        if row is None and "." in stem:
            nearest = int(np.abs(stamps - float(stem)).argmin())
            row = rows[nearest] if abs(stamps[nearest] - float(stem)) <= NEAR_S else None
        if row is not None:
            try:
                found[stem] = quaternion_of(row[1:8], "xyzw") @ body_from_camera
            except PoseError as error:
                found[stem] = error
    return found


def _stamp(word: str) -> float:
    """The stamp of a row, far away where it is none."""
    try:
        value = float(word)
    except ValueError:
        return np.inf
    return value if np.isfinite(value) else np.inf


def _local_transform(calibration: Path) -> np.ndarray:
    """body_from_camera (4, 4). Raises SourceError."""
    numbers = in_brackets(text_of(calibration), r"^local_transform:.*?data:\s*")
    if numbers is None or len(numbers) != 12:
        raise SourceError(f"{calibration} has no local_transform of 3 x 4 numbers: {AGAIN}")
    return np.vstack((np.array(numbers).reshape(3, 4), (0, 0, 0, 1)))


def _pose(poses: dict[str, np.ndarray | PoseError], stem: str, convention: Convention) -> np.ndarray:
    pose = poses.get(stem)
    if pose is None or isinstance(pose, PoseError):
        raise pose or PoseError("it has no pose: it is not part of the optimised graph")
    return convention.of_matrix(pose)


def _images(colors: dict[str, Path], depths: dict[str, Path], stem: str) -> Images:
    if stem not in depths:
        raise FrameError("it has no depth file")
    return Images(read_bytes(colors[stem]), read_bytes(depths[stem]))

"""Poses of a folder of one's own in one file: rows, an array, or the file of a tool that wrote the camera too.

poses.npy poses.txt    (or pose, traj, trajectory, camera_poses, groundtruth) an array (n, 4, 4), or rows of 16 or 12
                       numbers as KITTI has them, of tx ty tz and a quaternion, or of a stamp or number and these seven
*.log                  Redwood, Open3D (also in scene/): a line of three whole numbers, then four rows of four
trajectory.json        Open3D's PinholeCameraTrajectory (also camera_trajectory.json): camera_from_world, by columns
transforms.json        nerfstudio, instant-ngp: file_path and transform_matrix of each frame, OpenGL camera axes
images.txt             COLMAP, beside cameras.txt, here or in sparse/ or sparse/0/: camera_from_world, quaternions wxyz;
                       or images.bin beside cameras.bin

Rows without a number or name belong to the images in their order, so that there must be as many.
"""

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from prior_sg.services.errors import reason_of
from prior_sg.services.headers import ImageError
from prior_sg.services.ingest.core.options import ReadOptions
from prior_sg.services.ingest.core.pixels import array_of
from prior_sg.services.ingest.core.poses import Convention
from prior_sg.services.ingest.core.ros.transforms import Stamped, Track
from prior_sg.services.ingest.sources import colmap_binary
from prior_sg.services.ingest.sources.tables import SourceError, lines_of, read_json, words_of

LISTS = ("poses", "pose", "traj", "trajectory", "camera_poses", "groundtruth")
ENDINGS = (".npy", ".txt", ".csv", ".log")
TRANSFORMS, COLMAP_IMAGES, COLMAP_CAMERAS = "transforms.json", "images.txt", "cameras.txt"
COLMAP_KINDS = (".txt", ".bin")
OPEN3D = ("camera_trajectory.json", "trajectory.json")
COLMAP_FOLDERS = (".", "sparse/0", "sparse", "colmap/sparse/0", "colmap")
UNDERSTOOD = (
    "a folder pose/ with a file of 4 x 4 numbers for each frame, poses.npy or poses.txt (rows of 16, 12, 8 or 7 "
    f"numbers), a Redwood .log, {TRANSFORMS}, trajectory.json of Open3D, or {COLMAP_IMAGES} with {COLMAP_CAMERAS}"
)
COLMAP_PARAMETERS = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "OPENCV_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
}
NEAR_S = 0.02  # between the number of a row and that of an image
STAMPED, QUATERNION = 8, 7  # columns


@dataclass(frozen=True)
class PoseList:
    """Poses as they are written, (4, 4) or (7,), by what they belong to."""

    path: Path
    rows: list[np.ndarray]
    names: list[str] = field(default_factory=list)  # of images, one each; empty = by number or order
    numbers: list[float] = field(default_factory=list)  # of frames, or stamps; empty = by name or order
    convention: Convention | None = None  # what the format says of them
    camera: dict[str, Any] = field(default_factory=dict)  # named numbers, where the file holds them
    images: Path | None = None  # folder of the images that it names
    depth_names: dict[str, str] = field(default_factory=dict)  # file of depth by that of colour

    def of(self, keys: Sequence[float], stems: dict[str, float]) -> dict[float, np.ndarray]:
        """Poses by the number of their image; `stems` gives it by the image's name. Raises SourceError."""
        if self.names:
            named = zip((Path(name).stem for name in self.names), self.rows, strict=True)
            found = {stems[stem]: row for stem, row in named if stem in stems}
        elif self.numbers:
            found = _nearest(self.numbers, self.rows, keys)
        elif len(self.rows) != len(keys):
            raise SourceError(
                f"{self.path} has {len(self.rows)} poses for {len(keys)} images: give every image its own, in its order"
            )
        else:
            found = dict(zip(keys, self.rows, strict=True))
        if not found:
            raise SourceError(f"none of the {len(self.rows)} poses of {self.path} belongs to an image by its name")
        return found


def find(path: Path) -> Path | None:
    """The one file of poses in a folder, if there is one."""
    if (path / TRANSFORMS).is_file():
        return path / TRANSFORMS
    for images in (
        (path / folder / COLMAP_IMAGES).with_suffix(kind) for folder in COLMAP_FOLDERS for kind in COLMAP_KINDS
    ):
        if images.is_file() and images.with_stem("cameras").is_file():
            return images
    files = {file.name.lower(): file for file in sorted(path.iterdir()) if file.is_file()}
    named = (files.get(name + ending) for name in LISTS for ending in ENDINGS)
    logs = (file for name, file in files.items() if name.endswith(".log") and _is_redwood(file))
    scene = (file for file in sorted((path / "scene").glob("trajectory.log")) if _is_redwood(file))
    open3d = (path / name for name in OPEN3D if (path / name).is_file())
    return next((file for file in (*named, *logs, *open3d, *scene) if file is not None), None)


def read(path: Path) -> PoseList:
    """The poses of a file. Raises SourceError."""
    if path.name == TRANSFORMS:
        return _transforms(path)
    if path.stem == Path(COLMAP_IMAGES).stem and path.suffix in COLMAP_KINDS:
        return _colmap(path)
    if path.name in OPEN3D:
        return _open3d(path)
    if path.suffix.lower() == ".npy":
        return _array(path)
    lines = lines_of(path)
    if _redwood_lines(lines):
        return _redwood(path, lines)
    return _table(path, [words_of(line) for line in lines])


def track_of(path: Path, stamps_ns: Sequence[int | None], rows: Iterable[np.ndarray], options: ReadOptions) -> Track:
    """Where a body was over time, of rows of tx ty tz qx qy qz qw; those without stamp are left out.

    Raises SourceError.
    """
    shift_ns = round((options.stamp_offset_s or 0.0) * 1e9)
    track = Track(
        [
            Stamped(stamp + shift_ns, "world", "body", tuple(row[:3].tolist()), tuple(row[3:].tolist()))
            for stamp, row in zip(stamps_ns, rows, strict=True)
            if stamp is not None
        ]
    )
    if not len(track.stamps_ns):
        raise SourceError(f"{path} has no pose that can be used")
    return track


def _nearest(numbers: Sequence[float], rows: Sequence[np.ndarray], keys: Sequence[float]) -> dict[float, np.ndarray]:
    """The row with the number of each image, or that within 20 ms of it."""
    order = np.argsort(numbers, kind="stable")
    known = np.asarray(numbers, float)[order]
    found = {}
    for key in keys:
        at = int(np.searchsorted(known, key))
        near = min((i for i in (at - 1, at) if 0 <= i < len(known)), key=lambda i: abs(known[i] - key))
        if abs(known[near] - key) <= NEAR_S:
            found[key] = rows[order[near]]
    return found


def _array(path: Path) -> PoseList:
    try:
        array = array_of(path.read_bytes())
    except (ImageError, OSError) as error:
        raise SourceError(f"{path} holds no poses: {reason_of(error)}") from error
    size = int(np.prod(array.shape[1:])) if array.ndim > 1 else 0
    if array.ndim not in (2, 3) or size not in (STAMPED, QUATERNION, 12, 16):
        raise SourceError(f"{path} holds no poses: its array has the shape {array.shape} instead of (n, 4, 4)")
    return _of_rows(path, array.reshape(len(array), size).astype(float))


def _table(path: Path, words: list[list[str]]) -> PoseList:
    if words and re.match(r"[A-Za-z_]", words[0][0]):
        words = words[1:]  # names of columns
    widths = {len(row) for row in words}
    if widths == {4} and len(words) % 4 == 0:  # matrices below each other
        words = [list(chain(*words[i : i + 4])) for i in range(0, len(words), 4)]
        widths = {16}
    if len(widths) != 1 or widths & {QUATERNION, STAMPED, 12, 16} == set():
        told = ", ".join(map(str, sorted(widths)[:5])) or "no"
        raise SourceError(f"{path} is no list of poses: its rows have {told} numbers instead of 16, 12, 8 or 7")
    try:
        return _of_rows(path, np.array(words, float))
    except ValueError as error:
        raise SourceError(f"{path} is no list of poses: {error}") from error


def _of_rows(path: Path, table: np.ndarray) -> PoseList:
    """Poses of rows of 16, 12, 8 or 7 numbers."""
    columns = table.shape[1]
    if columns in (QUATERNION, STAMPED):
        return PoseList(path, list(table[:, -QUATERNION:]), numbers=table[:, 0].tolist() if columns == STAMPED else [])
    return PoseList(path, [_matrix(row) for row in table])


def _matrix(numbers: np.ndarray) -> np.ndarray:
    matrix = np.eye(4)
    matrix[: numbers.size // 4] = numbers.reshape(-1, 4)
    return matrix


def _is_redwood(path: Path) -> bool:
    try:
        return _redwood_lines(lines_of(path))
    except SourceError:
        return False


def _redwood_lines(lines: Sequence[str]) -> bool:
    """Whether every fifth line begins with whole numbers and has three, and the others have four."""
    counts = [len(line.split()) for line in lines[:50]]
    heads = [word for line in lines[:50:5] for word in line.split()[:2]]
    return (
        len(lines) >= 5
        and len(lines) % 5 == 0
        and all(count == (3 if i % 5 == 0 else 4) for i, count in enumerate(counts))
        and all(re.fullmatch(r"-?\d+", word) for word in heads)
    )


def _redwood(path: Path, lines: Sequence[str]) -> PoseList:
    try:
        rows = [np.array(" ".join(lines[i + 1 : i + 5]).split(), float).reshape(4, 4) for i in range(0, len(lines), 5)]
    except ValueError as error:
        raise SourceError(f"{path} is no list of poses: {error}") from error
    return PoseList(path, rows, convention=Convention())


def _transforms(path: Path) -> PoseList:
    content = read_json(path)
    frames = content.get("frames") if isinstance(content, dict) else None
    try:
        if not frames:
            raise KeyError("frames")
        names = [str(frame["file_path"]) for frame in frames]
        rows = [np.array(frame["transform_matrix"], float).reshape(4, 4) for frame in frames]
        depths = {
            Path(name).stem: str(frame["depth_file_path"])
            for name, frame in zip(names, frames, strict=True)
            if frame.get("depth_file_path")
        }
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        said = f"it lacks {error}" if isinstance(error, KeyError) else "a transform_matrix is not 4 x 4 numbers"
        raise SourceError(f"{path} is not a {TRANSFORMS} of nerfstudio or instant-ngp: {said}") from error
    camera = {
        str(key): value for key, value in {**frames[0], **content}.items() if isinstance(value, str | int | float)
    }
    return PoseList(
        path,
        rows,
        names=names,
        convention=Convention(axes="opengl"),
        camera=_with_focal_length(camera),
        images=(path.parent / names[0]).parent,
        depth_names=depths,
    )


def _with_focal_length(camera: dict[str, Any]) -> dict[str, Any]:
    """The same with fl_x, fl_y, cx and cy where the file tells the angle of view instead."""
    width, height, angle = (camera.get(name) for name in ("w", "h", "camera_angle_x"))
    if "fl_x" not in camera and isinstance(width, int | float) and isinstance(angle, int | float) and angle > 0:
        camera |= {"fl_x": width / 2 / math.tan(angle / 2)}
    if "fl_x" in camera:
        camera = {"fl_y": camera["fl_x"]} | camera
    if isinstance(width, int | float) and isinstance(height, int | float):
        camera = {"cx": width / 2, "cy": height / 2} | camera
    return camera


def _colmap(path: Path) -> PoseList:
    """Poses by the names of images, and the camera of most of them."""
    cameras_file = path.with_stem(Path(COLMAP_CAMERAS).stem)
    if path.suffix == ".bin":
        cameras, images = colmap_binary.cameras_of(cameras_file), colmap_binary.images_of(path)
        images = [words for words in images if words[8] in cameras]
    else:
        cameras, images = _colmap_words(path)
    if not images:
        raise SourceError(f"{path} has no image with a pose and a camera of {cameras_file.name}")
    try:
        rows = [np.array([*words[5:8], *words[1:5]], float) for words in images]
        used = [words[8] for words in images]
        model, width, height, *numbers = cameras[max(set(used), key=used.count)]
        named = dict(zip(COLMAP_PARAMETERS[model], map(float, numbers), strict=False))
    except (KeyError, ValueError) as error:
        known = ", ".join(COLMAP_PARAMETERS)
        raise SourceError(f"{cameras_file} has a camera that is not read ({error}): {known} are") from error
    if "f" in named:
        named |= {"fx": named["f"], "fy": named.pop("f")}
    lens = {"model": "opencv_fisheye" if "FISHEYE" in model else "opencv"} if {"k1", "k2"} & set(named) else {}
    return PoseList(
        path,
        rows,
        names=[words[9] for words in images],
        convention=Convention("camera_from_world", "opencv", "wxyz"),
        camera={**named, **lens, "width": int(width), "height": int(height)},
    )


def _colmap_words(path: Path) -> tuple[dict[str, list[str]], list[list[str]]]:
    """Lines of cameras.txt by number, and every other line of images.txt."""
    cameras = {words[0]: words[1:] for words in (line.split() for line in lines_of(path.parent / COLMAP_CAMERAS))}
    images = [line.split(maxsplit=9) for line in lines_of(path)]
    return cameras, [w for w in images if len(w) == 10 and w[8] in cameras and not _is_number(w[9])]


def _open3d(path: Path) -> PoseList:
    """Poses of a PinholeCameraTrajectory, in the order of the images, and its first camera."""
    try:
        parameters = read_json(path)["parameters"]
        rows = [np.array(one["extrinsic"], float).reshape(4, 4).T for one in parameters]
        said = parameters[0]["intrinsic"]
        matrix = np.array(said["intrinsic_matrix"], float).reshape(3, 3).T
        camera = {"width": int(said["width"]), "height": int(said["height"])}
        camera |= {"fx": matrix[0, 0], "fy": matrix[1, 1], "cx": matrix[0, 2], "cy": matrix[1, 2]}
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise SourceError(f"{path} is no PinholeCameraTrajectory of Open3D: {type(error).__name__} {error}") from error
    return PoseList(path, rows, convention=Convention("camera_from_world"), camera=camera)


def _is_number(word: str) -> bool:
    return re.fullmatch(r"[-+\d.\seE]+", word) is not None

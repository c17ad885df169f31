"""Sequences of the UT Campus Object Dataset (CODa): one colour camera, with depth from the lidar.

2d_raw/cam0/SEQ/2d_raw_cam0_SEQ_FRAME.png      8 bit, with lens distortion; or
2d_rect/cam0/SEQ/2d_rect_cam0_SEQ_FRAME.jpg    (or .png) rectified; cam1 likewise
3d_comp/os1/SEQ/3d_comp_os1_SEQ_FRAME.bin      128 x 1024 points of 32 bit floats x y z intensity (more may follow)
calibrations/SEQ/calib_cam0_intrinsics.yaml    camera_matrix, distortion_coefficients, rectification_, projection_matrix
calibrations/SEQ/calib_os1_to_cam0.yaml        extrinsic_matrix: 4 x 4, camera_from_lidar
poses/dense_global/SEQ.txt or poses/dense/     a line per scan: stamp x y z qw qx qy qz, world_from_lidar
timestamps/SEQ.txt                             a stamp (seconds) per frame; the line is the frame's number

The source is the folder of images, such as CODa/2d_rect/cam0/10, which names camera and sequence; or the root where it
holds a single sequence (rectified images before raw ones, cam0 before cam1). Supported are cam0 and cam1, which the
lidar triggers, with ego-compensated scans. Not supported: cam2 to cam4 (not synchronised, other depth), 3d_raw,
extrinsics given as R and T, and annotations. Raw images are undistorted onto the pinhole of camera_matrix; rectified
ones are handed on as they are, with the pinhole of projection_matrix, turned by rectification_matrix.

The lidar has x forward, y left, z up, and its first pose is the world's origin: z is up as far as the robot stood
level, and the floor lies below zero (give floor_m, about the lidar's height, negative). Camera axes are x right, y
down, z forward. Poses of dense_global are taken where they exist, else those of dense; the pose nearest in time, within
50 ms. Depth: neighbouring points of the scan are joined to a surface, see lidar.py; in millimetres, up to 65.535 m.
Ground truth: poses; regions.json is read where one lies beside the images.
Source: github.com/ut-amrl/coda-devkit, docs/DATA_REPORT.md, helpers/calibration.py, helpers/geometry.py.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.geometry import inverse, transform
from prior_sg.services.ingest.sources.base import (
    MILLIMETRE,
    UP,
    Entry,
    FrameError,
    Rig,
    Source,
    SourceError,
    decode_image,
    encode_image,
    file_of,
    levelling,
    millimetre_png,
    numbered,
    quaternion_pose,
    sequence,
    stamp_ns,
    table,
)
from prior_sg.services.ingest.sources.lidar import depth_image

RAW, RECTIFIED, SCANS = "2d_raw", "2d_rect", "3d_comp/os1"
LOOKS = f"{RECTIFIED}/cam0/SEQUENCE or {RAW}/cam0/SEQUENCE beside {SCANS} (CODa)"
POSES = ("poses/dense_global", "poses/dense")
SCAN_ROWS, SCAN_COLUMNS = 128, 1024
WITHIN_NS = 50_000_000
NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"


@dataclass(frozen=True)
class Camera:
    """One camera of one sequence, as its images are handed on."""

    intrinsics: Intrinsics
    camera_from_lidar: np.ndarray
    distorted: tuple[np.ndarray, np.ndarray] | None  # camera matrix and coefficients of images yet to be undistorted


@dataclass(frozen=True)
class Files:
    """Where the frames of one sequence lie, and when and where they were taken."""

    colors: dict[int, Path]
    scans: dict[int, Path]
    stamps_ns: list[int]
    pose_stamps_ns: np.ndarray
    poses: list[list[str]]


def fits(path: Path) -> bool:
    """Whether a folder is one of images of this layout, or the root."""
    return bool(_image_folders(path))


def load(path: Path, world_up: Sequence[float] = (), floor_m: float = 0.0) -> Source:
    """A CODa sequence as a source. Raises SourceError."""
    folders = _image_folders(path)
    if len({folder.name for folder in folders}) > 1:
        raise SourceError(f"{path} holds several sequences: name the images of one, such as {folders[0]}")
    folder = folders[0].resolve()
    root, kind, name, number = folder.parents[2], folder.parents[1].name, folder.parent.name, folder.name
    camera = _camera(root / "calibrations" / number, name, rectified=kind == RECTIFIED)
    files = _files(root, kind, name, number)
    entries = [
        Entry(
            frame,
            files.stamps_ns[frame] if frame < len(files.stamps_ns) else 0,
            partial(_read, files, camera, frame),
        )
        for frame in sorted(files.colors.keys() | files.scans.keys())
    ]
    rig = Rig(camera.intrinsics, MILLIMETRE, len(entries), levelling(world_up or UP, floor_m))
    return sequence("coda", folder, rig, entries)


def _files(root: Path, kind: str, name: str, number: str) -> Files:
    stamps = root / "timestamps" / f"{number}.txt"
    poses = next((root / p / f"{number}.txt" for p in POSES if (root / p / f"{number}.txt").is_file()), None)
    if poses is None:
        raise SourceError(f"{root} has no poses of sequence {number}: looked for {number}.txt in {' and '.join(POSES)}")
    rows = table(poses, 8)
    return Files(
        numbered(root / kind / name / number, rf"{kind}_{name}_{number}_(\d+)\.(?:png|jpg)"),
        numbered(root / SCANS / number, rf"3d_comp_os1_{number}_(\d+)\.bin"),
        [stamp_ns(row[0], stamps) for row in table(stamps, 1)],
        np.array([stamp_ns(row[0], poses) for row in rows], np.int64),
        [row[1:] for row in rows],
    )


def _image_folders(path: Path) -> list[Path]:
    """The folder itself when it is one of images, else those below a root that the first camera has."""
    path = path.resolve()
    if len(path.parents) > 2 and path.parents[1].name in (RAW, RECTIFIED) and (path.parents[2] / SCANS).is_dir():
        return [path]
    for kind in (RECTIFIED, RAW):
        for name in ("cam0", "cam1"):
            folders = sorted(folder for folder in (path / kind / name).glob("*") if folder.is_dir())
            if folders and (path / SCANS).is_dir():
                return folders
    return []


def _read(files: Files, camera: Camera, frame: int) -> tuple[np.ndarray, bytes, bytes]:
    if frame >= len(files.stamps_ns):
        raise FrameError("the list of timestamps has no line for it")
    world_from_lidar = quaternion_pose(_nearest(files, files.stamps_ns[frame]), scalar_first=True)
    color = file_of(files.colors, frame, "colour")
    points_lidar = _points(file_of(files.scans, frame, "lidar"))
    points_camera = transform(camera.camera_from_lidar, points_lidar.reshape(-1, 3)).reshape(points_lidar.shape)
    empty = ~points_lidar.any(axis=-1, keepdims=True)  # the lidar writes 0 0 0 where nothing came back
    depth_m = depth_image(np.where(empty, np.nan, points_camera), camera.intrinsics)
    if camera.distorted is not None:
        color = encode_image(cv2.undistort(decode_image(color, "colour"), *camera.distorted), ".jpg")
    return world_from_lidar @ inverse(camera.camera_from_lidar), color, millimetre_png(depth_m)


def _nearest(files: Files, stamp: int) -> list[str]:
    differences_ns = np.abs(files.pose_stamps_ns - stamp)
    if not len(differences_ns) or differences_ns.min() > WITHIN_NS:
        raise FrameError("no pose lies within 50 ms of it")
    return files.poses[int(differences_ns.argmin())]


def _points(scan: bytes) -> np.ndarray:
    """Points (128, 1024, 3) in the lidar's frame. Raises FrameError."""
    fields, rest = divmod(len(scan), SCAN_ROWS * SCAN_COLUMNS * 4)
    if rest or fields < 3:
        raise FrameError(f"its scan of {len(scan)} bytes does not have {SCAN_ROWS} x {SCAN_COLUMNS} points")
    return np.frombuffer(scan, "<f4").reshape(SCAN_ROWS, SCAN_COLUMNS, fields)[..., :3].astype(np.float64)


def _camera(folder: Path, name: str, *, rectified: bool) -> Camera:
    file = folder / f"calib_{name}_intrinsics.yaml"
    camera_from_lidar = _matrix(folder / f"calib_os1_to_{name}.yaml", "extrinsic_matrix", 16).reshape(4, 4)
    distorted = None
    if rectified:
        matrix = _matrix(file, "projection_matrix", 12).reshape(3, 4)
        turn = np.eye(4)
        turn[:3, :3] = _matrix(file, "rectification_matrix", 9).reshape(3, 3)
        camera_from_lidar = turn @ camera_from_lidar
    else:
        matrix = _matrix(file, "camera_matrix", 9).reshape(3, 3)
        distorted = matrix, _matrix(file, "distortion_coefficients", 5)
    size = [_first_number(file, key) for key in ("image_width", "image_height")]
    try:
        focal_and_centre = (float(matrix[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
        return Camera(Intrinsics(*size, *focal_and_centre), _rigid(camera_from_lidar), distorted)
    except ValueError as error:
        raise SourceError(f"{file} is not a camera: {error}") from error


def _rigid(matrix: np.ndarray) -> np.ndarray:
    """The matrix with the nearest rotation; the files have few digits."""
    u, _, vt = np.linalg.svd(matrix[:3, :3])
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = u @ vt, matrix[:3, 3]
    return result


def _matrix(path: Path, key: str, count: int) -> np.ndarray:
    """The numbers of `key: … data: […]`, in brackets or as a list with dashes. Raises SourceError."""
    match = re.search(rf"^{key}:.*?^\s+data:((?:[\s,\[\]-]|{NUMBER})+)", _text(path), re.DOTALL | re.MULTILINE)
    numbers = [float(number) for number in re.findall(NUMBER, match[1])] if match else []
    if len(numbers) != count:
        raise SourceError(f"{path} has no {key} with {count} numbers")
    return np.array(numbers)


def _first_number(path: Path, key: str) -> int:
    match = re.search(rf"^{key}:\s*(\d+)", _text(path), re.MULTILINE)
    if match is None:
        raise SourceError(f"{path} has no {key}")
    return int(match[1])


def _text(path: Path) -> str:
    try:
        return path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise SourceError(f"{path} cannot be read: {error}") from error

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
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.geometry import inverse, transform
from prior_sg.services.ingest.core.options import ReadOptions
from prior_sg.services.ingest.core.pixels import encoded
from prior_sg.services.ingest.core.poses import quaternion_of
from prior_sg.services.ingest.sources import base
from prior_sg.services.ingest.sources.base import (
    MILLIMETRE,
    Entry,
    Found,
    FrameError,
    Images,
    SourceError,
    color_pixels,
    file_of,
    numbered,
    truth_beside,
)
from prior_sg.services.ingest.sources.tables import stamps_ns, table, text_of
from prior_sg.services.opencv import cv2

NAME = "coda"
RAW, RECTIFIED, SCANS = "2d_raw", "2d_rect", "3d_comp/os1"
LOOKS = f"{RECTIFIED}/cam0/SEQUENCE or {RAW}/cam0/SEQUENCE beside {SCANS} (CODa)"
POSES = ("poses/dense_global", "poses/dense")
SCAN_ROWS, SCAN_COLUMNS = 128, 1024
WITHIN_NS = 50_000_000
FEW, NEARLY_NONE = 4, 0.1  # frames that tell whether stamps fit, and the share that does when they do not
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
    stamps_ns: list[int | None]
    pose_stamps_ns: np.ndarray
    poses: list[list[str]]


def fits(path: Path) -> bool:
    """Whether a folder is one of images of this layout, or the root."""
    return bool(_image_folders(path))


def load(path: Path, options: ReadOptions) -> Found:
    """A CODa sequence. Raises SourceError."""
    folders = _image_folders(path)
    if len({folder.name for folder in folders}) > 1:
        raise SourceError(f"{path} holds several sequences: name the images of one, such as {folders[0]}")
    if options.poses or options.camera_axes:
        raise SourceError("CODa has poses of its lidar: leave out --poses and --axes")
    folder = folders[0].resolve()
    root, kind, name, number = folder.parents[2], folder.parents[1].name, folder.parent.name, folder.name
    camera = _camera(root / "calibrations" / number, name, rectified=kind == RECTIFIED)
    files, notes = _files(root, kind, name, number, options)
    order = options.quaternion or "wxyz"
    entries = [
        Entry(
            frame,
            options.told_ns(frame, _stamp(files, frame) or 0),
            partial(_pose, files, camera, frame, order),
            partial(_images, files, camera, frame),
        )
        for frame in sorted(files.colors.keys() | files.scans.keys())
    ]
    return Found(
        NAME,
        folder,
        base.Camera(camera.intrinsics),
        MILLIMETRE,
        entries,
        ground_truth=truth_beside(folder),
        why=(f"it lies in {kind}/{name} beside {SCANS}",),
        notes=notes,
    )


def _files(root: Path, kind: str, name: str, number: str, options: ReadOptions) -> tuple[Files, tuple[str, ...]]:
    stamps = root / "timestamps" / f"{number}.txt"
    poses = next((root / p / f"{number}.txt" for p in POSES if (root / p / f"{number}.txt").is_file()), None)
    if poses is None:
        raise SourceError(f"{root} has no poses of sequence {number}: looked for {number}.txt in {' and '.join(POSES)}")
    rows = table(poses, 8)
    frame_stamps, said = stamps_ns([row[0] for row in table(stamps, 1)], stamps, "s", options.stamp_unit)
    pose_stamps, also_said = stamps_ns([row[0] for row in rows], poses, "s", options.stamp_unit)
    shift_ns = round((options.stamp_offset_s or 0.0) * 1e9)
    posed = [(stamp + shift_ns, row[1:]) for stamp, row in zip(pose_stamps, rows, strict=True) if stamp is not None]
    files = Files(
        numbered(root / kind / name / number, rf"{kind}_{name}_{number}_(\d+)\.(?:png|jpg)"),
        numbered(root / SCANS / number, rf"3d_comp_os1_{number}_(\d+)\.bin"),
        frame_stamps,
        np.array([stamp for stamp, _ in posed], np.int64),
        [words for _, words in posed],
    )
    numbers = [n for n in files.colors if _stamp(files, n) is not None]
    if len(numbers) >= FEW and sum(_nearest(files, n) is not None for n in numbers) < NEARLY_NONE * len(numbers):
        raise SourceError(f"no pose of {poses} lies within 50 ms of nearly any frame: give --stamp-offset SECONDS")
    return files, tuple(filter(None, (said, also_said)))


def _stamp(files: Files, frame: int) -> int | None:
    return files.stamps_ns[frame] if frame < len(files.stamps_ns) else None


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


def _pose(files: Files, camera: Camera, frame: int, order: str) -> np.ndarray:
    if _stamp(files, frame) is None:
        raise FrameError("the list of timestamps has no line for it")
    words = _nearest(files, frame)
    if words is None:
        raise FrameError("no pose lies within 50 ms of it")
    return quaternion_of(words, order) @ inverse(camera.camera_from_lidar)


def _nearest(files: Files, frame: int) -> list[str] | None:
    differences_ns = np.abs(files.pose_stamps_ns - files.stamps_ns[frame])
    if not len(differences_ns) or differences_ns.min() > WITHIN_NS:
        return None
    return files.poses[int(differences_ns.argmin())]


def _images(files: Files, camera: Camera, frame: int) -> Images:
    color = file_of(files.colors, frame, "colour")
    points_lidar = _points(file_of(files.scans, frame, "lidar"))
    points_camera = transform(camera.camera_from_lidar, points_lidar.reshape(-1, 3)).reshape(points_lidar.shape)
    empty = ~points_lidar.any(axis=-1, keepdims=True)  # the lidar writes 0 0 0 where nothing came back
    from prior_sg.services.ingest.core.lidar import depth_image  # takes numba, which other layouts do without

    depth_m = depth_image(np.where(empty, np.nan, points_camera), camera.intrinsics)
    if camera.distorted is not None:
        color = encoded(cv2.undistort(color_pixels(color), *camera.distorted), ".jpg")
    return Images(color, depth_m)


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
    match = re.search(rf"^{key}:.*?^\s+data:((?:[\s,\[\]-]|{NUMBER})+)", text_of(path), re.DOTALL | re.MULTILINE)
    numbers = [float(number) for number in re.findall(NUMBER, match[1])] if match else []
    if len(numbers) != count:
        raise SourceError(f"{path} has no {key} with {count} numbers")
    return np.array(numbers)


def _first_number(path: Path, key: str) -> int:
    match = re.search(rf"^{key}:\s*(\d+)", text_of(path), re.MULTILINE)
    if match is None:
        raise SourceError(f"{path} has no {key}")
    return int(match[1])

"""Printed markers of known size in a colour image, posed by the depth image (pure).

Four corners alone leave two poses that look nearly alike, and a far marker's heading is lost in them. So the marker's
plane is that of the depth inside it, its corners lie where their rays meet the plane, and the pose is that of the
square of the given size on these four points. Their distances are a measurement of the size, which must agree.
"""

from functools import lru_cache
from typing import Any, NamedTuple

import msgspec
import numpy as np

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.opencv import cv2

LEAST_MEASURED = 0.5  # share of a marker's pixels that must have a depth
TRIMMED, TRIMS = 3.0, 3  # median deviations beyond which a depth is left out of the plane, and how often that is done
LEAST_NOISE = 1e-3  # of an inverse depth, as a share of it: below that none is left out
SKEW = 0.2  # by which sides of a square may differ from their mean, as shares of it


class MarkersConfig(msgspec.Struct, frozen=True, kw_only=True):
    """Which printed markers are looked for."""

    dictionary: str = ""  # apriltag_36h11, 4x4_50, …, as OpenCV names them; empty = none are looked for
    size_m: float = 0.0  # side of their black squares, without the white margin
    size_tolerance: float = 0.15  # by which a side may measure otherwise, as a share
    least_px: float = 16.0  # smaller ones are left out: mean of the four sides as seen

    def __post_init__(self) -> None:
        if self.dictionary and self.dictionary not in dictionaries():
            raise ValueError(f"no such dictionary: {self.dictionary}; there are {', '.join(sorted(dictionaries()))}")
        if self.dictionary and not self.size_m > 0:
            raise ValueError("size_m is missing: measure the side of the markers' black square")
        if not (0 < self.size_tolerance < 1 and self.least_px > 0):
            raise ValueError("size_tolerance or least_px is out of range")


class MarkersSeen(NamedTuple):
    """Columns of equal length, and why others of the same dictionary were left out."""

    ids: np.ndarray  # (marker,) int32
    sides_px: np.ndarray  # (marker,) float32
    camera_from_marker: np.ndarray  # (marker, 4, 4)
    faults: list[str]


NO_MARKERS = MarkersSeen(np.zeros(0, np.int32), np.zeros(0, np.float32), np.zeros((0, 4, 4)), [])


def seen_markers(color: np.ndarray, depth_m: np.ndarray, camera: Intrinsics, cfg: MarkersConfig) -> MarkersSeen:
    """The markers in a colour image (h, w, 3), uint8 RGB, with its depth (h, w) in metres, 0 = no measurement."""
    if not cfg.dictionary:
        return NO_MARKERS
    found, faults = [], []
    for number, corners_px in _found(color, cfg):
        side_px = float(np.linalg.norm(corners_px - np.roll(corners_px, 1, axis=0), axis=1).mean())
        if side_px < cfg.least_px:
            faults.append(f"marker {number} is only {side_px:.0f} pixels wide")
            continue
        corners_m = _on_plane(corners_px, depth_m, camera)
        fault = f"marker {number} has no depth" if corners_m is None else _fault_of(number, corners_m, cfg)
        if fault or corners_m is None:
            faults.append(fault)
            continue
        found.append((number, side_px, _posed(corners_m)))
    if not found:
        return NO_MARKERS._replace(faults=faults)
    ids, sides_px, poses = zip(*found, strict=True)
    return MarkersSeen(np.array(ids, np.int32), np.array(sides_px, np.float32), np.stack(poses), faults)


@lru_cache(maxsize=1)
def dictionaries() -> dict[str, int]:
    """OpenCV's number of each dictionary of markers, by its name in lower case."""
    names = [name for name in dir(cv2.aruco) if name.startswith("DICT_")]
    return {name.removeprefix("DICT_").lower(): getattr(cv2.aruco, name) for name in names}


def _found(color: np.ndarray, cfg: MarkersConfig) -> list[tuple[int, np.ndarray]]:
    """Number and corners (4, 2) of each, from the upper left one as printed, clockwise, by number and place."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    dictionary = cv2.aruco.getPredefinedDictionary(dictionaries()[cfg.dictionary])
    detector: Any = cv2.aruco.ArucoDetector(dictionary, parameters)
    corners, ids, _ = detector.detectMarkers(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY))
    if ids is None:
        return []
    named = [
        (int(number), np.asarray(one, float).reshape(4, 2)) for number, one in zip(ids.ravel(), corners, strict=True)
    ]
    return sorted(named, key=lambda one: (one[0], one[1].tolist()))


def _on_plane(corners_px: np.ndarray, depth_m: np.ndarray, camera: Intrinsics) -> np.ndarray | None:
    """The corners (4, 3) in the camera frame, on the plane of the depth between them; None without enough of it.

    Of a plane the inverse depth is linear in the image.
    """
    inside = np.zeros(depth_m.shape, np.uint8)
    cv2.fillConvexPoly(inside, np.round(corners_px).astype(np.int32), 1)
    rows, columns = np.nonzero(inside)
    measured = depth_m[rows, columns] > 0
    if not len(rows) or measured.mean() < LEAST_MEASURED:
        return None
    rows, columns = rows[measured], columns[measured]
    rays = _rays(np.column_stack((columns, rows)), camera)
    inverses = 1.0 / depth_m[rows, columns].astype(float)
    kept = np.ones(len(rays), bool)
    plane = np.zeros(3)
    for _ in range(TRIMS):
        plane = np.linalg.lstsq(rays[kept], inverses[kept], rcond=None)[0]
        off = np.abs(rays @ plane - inverses)
        kept = off <= TRIMMED * max(float(np.median(off)), LEAST_NOISE * float(np.median(inverses)))
    corners = _rays(corners_px, camera)
    at_corners = corners @ plane
    if not (at_corners > 0).all():
        return None
    return np.asarray(corners / at_corners[:, None])


def _rays(points_px: np.ndarray, camera: Intrinsics) -> np.ndarray:
    """Directions (n, 3) of unit depth through pixels (n, 2)."""
    x = (points_px[:, 0] - camera.cx_px) / camera.fx_px
    y = (points_px[:, 1] - camera.cy_px) / camera.fy_px
    return np.column_stack((x, y, np.ones(len(points_px))))


def _fault_of(number: int, corners_m: np.ndarray, cfg: MarkersConfig) -> str:
    """Why four corners are not those of a square of the given size; empty when they are."""
    sides_m = np.linalg.norm(corners_m - np.roll(corners_m, 1, axis=0), axis=1)
    mean_m = float(sides_m.mean())
    if np.abs(sides_m / mean_m - 1).max() > SKEW:
        return f"marker {number} is no square by the depth image"
    if abs(mean_m / cfg.size_m - 1) > cfg.size_tolerance:
        return f"marker {number} measures {mean_m:.3f} m by the depth image, markers.size_m says {cfg.size_m:g} m"
    return ""


def _posed(corners_m: np.ndarray) -> np.ndarray:
    """The rigid motion (4, 4) from the marker's frame (x right, y up, z out of the paper) that fits its corners."""
    middle_m = corners_m.mean(axis=0)
    square = np.array(((-1, 1, 0), (1, 1, 0), (1, -1, 0), (-1, -1, 0)), float)
    u, _, vt = np.linalg.svd((corners_m - middle_m).T @ square)
    pose = np.eye(4)
    pose[:3, :3] = u @ np.diag((1.0, 1.0, np.linalg.det(u @ vt))) @ vt
    pose[:3, 3] = middle_m
    return pose

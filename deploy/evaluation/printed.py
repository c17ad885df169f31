"""Printed markers in images of generated worlds, by the homography of their plane; and walls on which they can hang."""

from collections.abc import Iterator, Sequence

import cv2
import numpy as np

from prior_sg.schemas.frames import Intrinsics

CELLS, MARGIN_CELLS, CELL_PX = 8, 1, 40  # of AprilTag 36h11 with its white margin, as printed
NEAREST_M = 0.1
ON_PLANE_M = 0.05  # between a surface and the plane of a paper on it
BLUR_PX = 0.7
PATCH_M, FLAT_M = 0.2, 0.005  # half the side of a piece of wall, and how flat it is
NEAR_M, FAR_M = 1.0, 2.5  # of a wall from which a spot is chosen
LEAST_FACING = 0.7  # cosine between a wall's direction and the way to it
UPRIGHT = 0.05  # of its direction's vertical part
HEIGHTS_M = (0.8, 2.0)


def printed(number: int, size_m: float) -> tuple[np.ndarray, float]:
    """A paper as an image, and the metres of one of its pixels; `size_m` = side of the black square."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    black = cv2.aruco.generateImageMarker(dictionary, number, CELLS * CELL_PX)
    edge = MARGIN_CELLS * CELL_PX
    paper = cv2.copyMakeBorder(black, edge, edge, edge, edge, cv2.BORDER_CONSTANT, value=255)
    return np.asarray(paper), size_m / (CELLS * CELL_PX)


def painted(
    gray: np.ndarray,
    depth_m: np.ndarray,
    camera: Intrinsics,
    camera_from_markers: Sequence[tuple[int, np.ndarray]],
    size_m: float,
) -> tuple[np.ndarray, np.ndarray]:
    """An image (h, w) uint8 with papers (number, pose) on surfaces of their depth, of (h, w), and a mask of them."""
    shape, gray = depth_m.shape, gray.copy()
    lens = np.array(((camera.fx_px, 0, camera.cx_px), (0, camera.fy_px, camera.cy_px), (0, 0, 1)))
    papers = np.zeros(shape, bool)
    for number, pose in camera_from_markers:
        if pose[2, 3] < NEAREST_M or pose[:3, 2] @ pose[:3, 3] > 0:
            continue  # behind the camera, or seen from behind
        paper, pixel_m = printed(number, size_m)
        half_px = (len(paper) - 1) / 2
        to_paper = pixel_m * np.array(((1, 0, -half_px), (0, -1, half_px), (0, 0, 1 / pixel_m)))
        homography = lens @ np.column_stack((pose[:3, 0], pose[:3, 1], pose[:3, 3])) @ to_paper
        flat = cv2.warpPerspective(paper, homography, shape[::-1], flags=cv2.INTER_AREA)
        inside = cv2.warpPerspective(np.full_like(paper, 255), homography, shape[::-1]) > 250
        inside &= np.abs(plane_m(pose, camera) - depth_m) < ON_PLANE_M
        gray[inside] = flat[inside]
        papers |= inside
    return np.asarray(cv2.GaussianBlur(gray, (0, 0), BLUR_PX)), papers


def plane_m(camera_from_marker: np.ndarray, camera: Intrinsics) -> np.ndarray:
    """Depth (h, w) of a marker's plane, infinite where it is not before the camera."""
    v, u = np.mgrid[: camera.height_px, : camera.width_px]
    rays = np.stack(((u - camera.cx_px) / camera.fx_px, (v - camera.cy_px) / camera.fy_px, np.ones(u.shape)), axis=-1)
    normal = camera_from_marker[:3, 2]
    with np.errstate(divide="ignore"):
        depth_m = (normal @ camera_from_marker[:3, 3]) / (rays @ normal)
    return np.where(depth_m > 0, depth_m, np.inf)


def on_wall(position_m: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """world_from_marker (4, 4) of a paper that hangs upright and looks along a level direction (3,)."""
    up = np.array((0.0, 0.0, 1.0))
    out = direction * (1, 1, 0) / np.linalg.norm(direction[:2])
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack((np.cross(up, out), up, out))
    pose[:3, 3] = position_m
    return pose


def wall_spots(depth_m: np.ndarray, camera: Intrinsics, world_from_camera: np.ndarray) -> Iterator[np.ndarray]:
    """Poses (4, 4) of papers that could hang where a view shows flat wall: at most one at each of a few pixels."""
    for v in np.linspace(0.3, 0.6, 3) * camera.height_px:
        for u in np.linspace(0.2, 0.8, 4) * camera.width_px:
            row, column = int(v), int(u)
            far_m = float(depth_m[row, column])
            half_px = int(PATCH_M * camera.fx_px / max(far_m, 1e-3))
            if not NEAR_M <= far_m <= FAR_M or min(row, column) < half_px:
                continue
            rows, columns = np.mgrid[row - half_px : row + half_px + 1 : 4, column - half_px : column + half_px + 1 : 4]
            if rows.max() >= camera.height_px or columns.max() >= camera.width_px:
                continue
            z = depth_m[rows, columns].ravel().astype(float)
            x = (columns.ravel() - camera.cx_px) / camera.fx_px * z
            y = (rows.ravel() - camera.cy_px) / camera.fy_px * z
            points_m = np.column_stack((x, y, z)) @ world_from_camera[:3, :3].T + world_from_camera[:3, 3]
            middle_m = points_m.mean(axis=0)
            _, spreads, axes = np.linalg.svd(points_m - middle_m)
            way = world_from_camera[:3, 3] - middle_m
            normal = axes[2] * np.sign(axes[2] @ way)
            flat = (z > 0).all() and spreads[2] / len(z) ** 0.5 < FLAT_M and abs(normal[2]) < UPRIGHT
            if flat and HEIGHTS_M[0] < middle_m[2] < HEIGHTS_M[1] and normal @ way > LEAST_FACING * np.linalg.norm(way):
                yield on_wall(middle_m, normal)

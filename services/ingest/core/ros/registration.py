"""Depth of one camera, drawn into another (pure)."""

import numpy as np

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.geometry import transform
from prior_sg.services.opencv import cv2


def rays(camera: Intrinsics, model: str, distortion: tuple[float, ...]) -> np.ndarray:
    """Directions (h, w, 3) with z = 1 of a camera's pixels, its lens taken into account."""
    v, u = np.indices((camera.height_px, camera.width_px), dtype=np.float64)
    pixels = np.stack((u, v), axis=-1).reshape(-1, 1, 2)
    matrix = np.array(((camera.fx_px, 0, camera.cx_px), (0, camera.fy_px, camera.cy_px), (0, 0, 1)))
    if model == "fisheye":
        straight = cv2.fisheye.undistortPoints(pixels, matrix, np.array(distortion or (0.0,) * 4))
    else:
        straight = cv2.undistortPoints(pixels, matrix, np.array(distortion))
    flat = straight.reshape(camera.height_px, camera.width_px, 2)
    return np.concatenate((flat, np.ones((*flat.shape[:2], 1))), axis=-1)


def registered(depth_m: np.ndarray, rays: np.ndarray, color_from_depth: np.ndarray, color: Intrinsics) -> np.ndarray:
    """Depth (h, w), metres, 0 = no measurement, as a pinhole camera for colour sees it.

    `depth_m` (a, b) and `rays` (a, b, 3) are of the depth camera. Neighbours on one surface are joined to it, so that
    a finer image for colour has no holes, and what is hidden from it is hidden.
    """
    points_depth = np.where(depth_m[..., None] > 0, rays * depth_m[..., None], np.nan)
    points_color = transform(color_from_depth, points_depth.reshape(-1, 3)).reshape(points_depth.shape)
    seam = np.full((len(points_color), 1, 3), np.nan)  # an image, unlike a scan, does not close
    from prior_sg.services.ingest.core.lidar import depth_image  # takes numba: few cameras need registration

    return depth_image(np.concatenate((points_color, seam), axis=1), color)

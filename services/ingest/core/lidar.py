"""Depth images from an organised lidar scan (pure)."""

import numpy as np

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.compiled import compiled
from prior_sg.services.geometry import project

NEAR_M = 0.2  # nothing nearer to the camera is drawn
MAX_STEP = 0.1  # neighbours whose depths differ by more than this share lie on two surfaces


def depth_image(points_camera: np.ndarray, camera: Intrinsics) -> np.ndarray:
    """Depth (h, w), metres, 0 = no measurement, of a scan (rows, columns, 3) in the camera's frame.

    Neighbours in the scan span triangles, which are drawn as the flat pieces they are (inverse depth is linear in the
    image), the nearest in front. So points that the lidar sees past an edge do not shine through it. Triangles across
    a jump in depth are left out, and so are points that are not finite. The scan's last column neighbours its first.
    """
    rows, columns = points_camera.shape[:2]
    points = np.where(np.isfinite(points_camera), points_camera, 0.0).reshape(-1, 3).astype(np.float64)
    pixels, depths_m = project(points, camera)
    inverse_image = np.zeros((camera.height_px, camera.width_px))
    u, v = np.ascontiguousarray(pixels.T)
    _draw(rows, columns, u, v, depths_m, inverse_image, NEAR_M, MAX_STEP)
    return np.divide(1.0, inverse_image, out=np.zeros_like(inverse_image), where=inverse_image > 0)


@compiled()
def draw_triangles(corners, u, v, z, image, near_m, max_step):  # noqa: ANN001, ANN201, PLR0917
    """Raise the image's inverse depth to that of triangles: (n, 3) indices of corners, at pixels u, v in depths z."""
    for a, b, c in corners:
        _triangle(u, v, z, a, b, c, image, near_m, max_step)


@compiled()
def _draw(rows, columns, u, v, z, image, near_m, max_step):  # noqa: ANN001, ANN202, PLR0917
    """Two triangles for each four neighbours of the scan, whose rows follow each other."""
    for i in range(rows - 1):
        for j in range(columns):
            k = (j + 1) % columns
            above, beside, below, across = (
                i * columns + j,
                i * columns + k,
                (i + 1) * columns + j,
                (i + 1) * columns + k,
            )
            _triangle(u, v, z, above, beside, below, image, near_m, max_step)
            _triangle(u, v, z, across, beside, below, image, near_m, max_step)


@compiled()
def _triangle(u, v, z, a, b, c, image, near_m, max_step):  # noqa: ANN001, ANN202, PLR0917
    """Raise the image's inverse depth to that of a triangle, on the pixels whose centres it holds."""
    z0, z1, z2 = z[a], z[b], z[c]
    nearest, farthest = min(z0, z1, z2), max(z0, z1, z2)
    if nearest < near_m or farthest - nearest > max_step * nearest:
        return
    u0, v0, u1, v1, u2, v2 = u[a], v[a], u[b], v[b], u[c], v[c]
    area = (u1 - u0) * (v2 - v0) - (u2 - u0) * (v1 - v0)
    if area == 0:
        return
    height, width = image.shape
    left, right = max(0.0, np.ceil(min(u0, u1, u2))), min(width - 1.0, np.floor(max(u0, u1, u2)))
    top, bottom = max(0.0, np.ceil(min(v0, v1, v2))), min(height - 1.0, np.floor(max(v0, v1, v2)))
    y = top
    while y <= bottom:
        x = left
        while x <= right:
            b1 = ((x - u0) * (v2 - v0) - (u2 - u0) * (y - v0)) / area
            b2 = ((u1 - u0) * (y - v0) - (x - u0) * (v1 - v0)) / area
            if b1 >= 0 and b2 >= 0 and b1 + b2 <= 1:
                inverse = (1 - b1 - b2) / z0 + b1 / z1 + b2 / z2
                image[int(y), int(x)] = max(image[int(y), int(x)], inverse)
            x += 1
        y += 1

"""Depth images from sparse points, guided by the picture (pure).

Each pixel gets the inverse depth of the plane through the points around it, weighted by how far one walks to them
through the picture: a step across an edge is long. The walk is the domain transform of Gastal and Oliveira 2011 ("Domain
transform for edge-aware image and video processing", equations 11 and 21, recursive form), the weights normalised by
those of the measured pixels, as joint bilateral upsampling does (Kopf et al. 2007, equation 4). A plane, because inverse
depth is linear in the image on every flat surface: with a plain average floors become stairs between two rings.
"""

import cv2
import numpy as np

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.compiled import compiled
from prior_sg.services.geometry import project

NEAR_M = 0.2  # nothing nearer to the camera is drawn
HIDDEN = 0.1  # a point this share behind its neighbours is seen past an edge by the lidar, not by the camera
EDGE = 20.0  # difference of grey levels that is as long as one spread in pixels
PASSES = 3
GAP_QUANTILE = 0.95
REACH = 1.25  # no depth farther from a point than this many half gaps
FLAT = 0.1  # most of inverse depth that the points around a pixel may lie off their plane
STIFF = 0.05  # pulls planes level that too few directions hold; in spreads squared


def upsampled(points_camera: np.ndarray, camera: Intrinsics, guide: np.ndarray) -> np.ndarray:
    """Depth (h, w), metres, 0 = no measurement, of points (n, 3) in the camera's frame.

    `guide` (h, w) or (h, w, 3) uint8 is what the camera saw. Pixels that lie farther from all points than the points lie
    from each other, or between surfaces, stay empty.
    """
    sparse = splatted(points_camera, camera)
    measured = sparse > 0
    if not measured.any():
        return sparse
    away_px = cv2.distanceTransform((~measured).astype(np.uint8), cv2.DIST_L2, 5)
    half_gap_px = max(1.0, float(np.quantile(away_px[_hull(measured)], GAP_QUANTILE)))
    plane, off = _planes(np.divide(1.0, sparse, out=np.zeros_like(sparse), where=measured), measured, guide, half_gap_px)
    kept = (away_px <= REACH * half_gap_px) & (plane > 0) & (off <= FLAT * plane)
    return np.divide(1.0, plane, out=np.zeros_like(plane), where=kept)


def splatted(points_camera: np.ndarray, camera: Intrinsics) -> np.ndarray:
    """Depth (h, w), metres, 0 = none, of the nearest point (n, 3) in each pixel; hidden ones are left out."""
    points = points_camera[np.isfinite(points_camera).all(axis=1)]
    points = points[points[:, 2] >= NEAR_M]
    pixels, depths_m = project(points, camera)
    u, v = np.rint(pixels).astype(np.int64).T
    seen = (u >= 0) & (u < camera.width_px) & (v >= 0) & (v < camera.height_px)
    image = np.full((camera.height_px, camera.width_px), np.inf)
    np.minimum.at(image, (v[seen], u[seen]), depths_m[seen])
    return _without_hidden(image)


def _without_hidden(image: np.ndarray) -> np.ndarray:
    """Points behind a neighbour on both of two opposite sides are seen through gaps between nearer ones."""
    count = int(np.isfinite(image).sum())
    side = 2 * round(np.sqrt(image.size / max(count, 1))) + 1
    nearest = cv2.erode(np.where(np.isfinite(image), image, 1e9), np.ones((side, side)))
    farther = np.isfinite(image) & (image > (1 + HIDDEN) * nearest)
    halves = [cv2.erode(np.where(np.isfinite(image), image, 1e9), _half(side, way)) for way in range(4)]
    behind = [np.where(np.isfinite(image), image, 0) > (1 + HIDDEN) * half for half in halves]
    hidden = farther & ((behind[0] & behind[1]) | (behind[2] & behind[3]))
    return np.where(np.isfinite(image) & ~hidden, image, 0.0)


def _half(side: int, way: int) -> np.ndarray:
    """The left, right, upper or lower half of a square window."""
    window = np.zeros((side, side), np.uint8)
    middle = side // 2
    window[(slice(None), slice(None, middle)) if way == 0 else (slice(None), slice(middle + 1, None)) if way == 1 else
           (slice(None, middle),) if way == 2 else (slice(middle + 1, None),)] = 1
    return window


def _hull(measured: np.ndarray) -> np.ndarray:
    """Where the points lie, as their convex hull."""
    corners = cv2.convexHull(np.argwhere(measured)[:, ::-1].astype(np.int32))
    hull = np.zeros(measured.shape, np.uint8)
    cv2.fillConvexPoly(hull, corners, 1)
    return hull.astype(bool)


def _planes(inverse: np.ndarray, measured: np.ndarray, guide: np.ndarray, spread_px: float):
    """Inverse depth (h, w) of the plane around each pixel, and how far the points lie off it."""
    v, u = np.indices(inverse.shape) / spread_px
    moments = (np.ones_like(u), u, v, u * u, u * v, v * v, inverse, inverse * u, inverse * v, inverse * inverse)
    sums = np.stack(moments, axis=-1) * measured[..., None]
    across, down = _steps(guide, spread_px)
    for number in range(PASSES):
        share = np.sqrt(3.0) * 2 ** (PASSES - number - 1) / np.sqrt(4.0**PASSES - 1)
        decay = np.exp(-np.sqrt(2.0) / (spread_px * share))
        _walk(sums, decay**across)
        _walk(sums.transpose(1, 0, 2), (decay**down).T)
    return _fit(sums, u, v)


def _steps(guide: np.ndarray, spread_px: float) -> tuple[np.ndarray, np.ndarray]:
    """How long the step to each pixel is from the one on its left (h, w), and from the one above it."""
    levels = guide.reshape(*guide.shape[:2], -1).astype(np.float64)
    across, down = np.ones(guide.shape[:2]), np.ones(guide.shape[:2])
    across[:, 1:] += spread_px / EDGE * np.abs(np.diff(levels, axis=1)).mean(axis=-1)
    down[1:] += spread_px / EDGE * np.abs(np.diff(levels, axis=0)).mean(axis=-1)
    return across, down


@compiled()
def _walk(sums, feedback):  # noqa: ANN001, ANN202
    """Smooth (rows, columns, channels) along rows, there and back; `feedback` is that of the step to each pixel."""
    rows, columns, channels = sums.shape
    for i in range(rows):
        for j in range(1, columns):
            for c in range(channels):
                sums[i, j, c] += feedback[i, j] * (sums[i, j - 1, c] - sums[i, j, c])
        for j in range(columns - 2, -1, -1):
            for c in range(channels):
                sums[i, j, c] += feedback[i, j + 1] * (sums[i, j + 1, c] - sums[i, j, c])


def _fit(sums: np.ndarray, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The weighted plane's value at each pixel, and the standard deviation from it."""
    weight = sums[..., 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        mu, mv, muu, muv, mvv, mw, muw, mvw, mww = np.moveaxis(sums[..., 1:] / weight[..., None], -1, 0)
        cuu, cuv, cvv = muu - mu * mu + STIFF, muv - mu * mv, mvv - mv * mv + STIFF
        cuw, cvw = muw - mu * mw, mvw - mv * mw
        determinant = cuu * cvv - cuv * cuv
        slope_u, slope_v = (cvv * cuw - cuv * cvw) / determinant, (cuu * cvw - cuv * cuw) / determinant
        plane = mw + slope_u * (u - mu) + slope_v * (v - mv)
        off = np.sqrt(np.maximum(mww - mw * mw - slope_u * cuw - slope_v * cvw, 0.0))
    return np.nan_to_num(plane), np.nan_to_num(off, nan=np.inf)

"""Depth images from sparse points, along the surfaces they lie on and the edges of the picture (pure).

First the points are joined to triangles (Delaunay's, in the image), which are drawn as the flat pieces they are; none
are drawn across a jump in depth. What is left lies at jumps and margins, and goes to the side it looks like: each pixel
there gets the inverse depth of the plane through what is known around it, weighted by how far one walks to it through
the picture, where a step across an edge is long. The walk is the domain transform of Gastal and Oliveira 2011 ("Domain
transform for edge-aware image and video processing", equations 11 and 21, recursive form), the weights normalised by
those of the measured pixels, as in joint bilateral upsampling (Kopf et al. 2007, equation 4). Planes, as inverse depth
is linear in the image on every flat surface: a plain average makes stairs of a floor between two rings.
"""

import numpy as np
from scipy.spatial import Delaunay, QhullError

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.compiled import compiled
from prior_sg.services.geometry import project
from prior_sg.services.ingest.core.lidar import draw_triangles
from prior_sg.services.opencv import cv2

NEAR_M = 0.2  # nothing nearer to the camera is drawn
HIDDEN = 0.1  # a point this share behind its neighbours on two sides is seen through them
MAX_STEP = 0.2  # neighbours whose depths differ by more than this share lie on two surfaces; rings are far apart
EDGE = 20.0  # difference of grey levels that is as long as one spread in pixels
PASSES = 3
GAP_QUANTILE = 0.95
REACH = 1.25  # no depth farther from a point than this many half gaps
FLAT = 0.1  # most of its inverse depth that what is known around a pixel may lie off the plane
STIFF = 0.05  # pulls planes level that too few directions hold; in spreads squared
FAR_M = 1e9


def upsampled(points_camera: np.ndarray, camera: Intrinsics, picture: np.ndarray | None) -> np.ndarray:
    """Depth (h, w), metres, 0 = no measurement, of points (n, 3) in the camera's frame.

    `picture` (h, w) or (h, w, 3) uint8 is what the camera saw; without one only surfaces are drawn. Pixels that lie
    farther from all points than the points lie from each other, or that could be of two surfaces, stay empty.
    """
    points = splatted(points_camera, camera)
    if not points.any():
        return points
    depth_m = _surfaces(points)
    if picture is None:
        return depth_m
    away_px = cv2.distanceTransform((points == 0).astype(np.uint8), cv2.DIST_L2, 5)
    half_gap_px = max(1.0, float(np.quantile(away_px[_hull(points > 0)], GAP_QUANTILE)))
    plane, off = _planes(depth_m, picture, half_gap_px)
    filled = (depth_m == 0) & (away_px <= REACH * half_gap_px) & (plane > 0) & (off <= FLAT * plane)
    depth_m[filled] = 1.0 / plane[filled]
    return depth_m


def splatted(points_camera: np.ndarray, camera: Intrinsics) -> np.ndarray:
    """Depth (h, w), metres, 0 = none, of the nearest point (n, 3) in each pixel; hidden ones are left out."""
    points = points_camera[np.isfinite(points_camera).all(axis=1)]
    points = points[points[:, 2] >= NEAR_M]
    pixels, depths_m = project(points, camera)
    u, v = np.rint(pixels).astype(np.int64).T
    seen = (u >= 0) & (u < camera.width_px) & (v >= 0) & (v < camera.height_px)
    image = np.full((camera.height_px, camera.width_px), FAR_M)
    np.minimum.at(image, (v[seen], u[seen]), depths_m[seen])
    return np.where(image < FAR_M, np.where(_hidden(image), 0.0, image), 0.0)


def _hidden(image: np.ndarray) -> np.ndarray:
    """Points with nearer ones on two opposite sides: the lidar, which is elsewhere, saw them past these."""
    side = round(np.sqrt(image.size / max(int((image < FAR_M).sum()), 1)))
    before, after, whole = slice(None, side), slice(side + 1, None), slice(None)
    behind = []
    for part in ((before, whole), (after, whole), (whole, before), (whole, after)):
        window = np.zeros((2 * side + 1, 2 * side + 1), np.uint8)
        window[part] = 1
        behind.append(
            image > (1 + HIDDEN) * cv2.erode(image, window, borderType=cv2.BORDER_CONSTANT, borderValue=FAR_M)
        )
    return (behind[0] & behind[1]) | (behind[2] & behind[3])


def _surfaces(points: np.ndarray) -> np.ndarray:
    """Depth (h, w) of the triangles between the pixels that have one, and of these."""
    v, u = np.nonzero(points)
    try:
        corners = Delaunay(np.stack((u, v), axis=1)).simplices.astype(np.int64)
    except QhullError:  # too few points, or all on one line
        return points.copy()
    inverse = np.zeros_like(points)
    draw_triangles(corners, u.astype(np.float64), v.astype(np.float64), points[v, u], inverse, NEAR_M, MAX_STEP)
    return np.divide(1.0, inverse, out=points.copy(), where=inverse > 0)


def _hull(measured: np.ndarray) -> np.ndarray:
    """Where the points lie, as their convex hull."""
    corners = cv2.convexHull(np.argwhere(measured)[:, ::-1].astype(np.int32))
    hull = np.zeros(measured.shape, np.uint8)
    cv2.fillConvexPoly(hull, corners, 1)
    return hull.astype(bool)


def _planes(depth_m: np.ndarray, picture: np.ndarray, spread_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Inverse depth (h, w) of the plane around each pixel, and how far what is known lies off it."""
    height, width = depth_m.shape
    v, u = np.indices(depth_m.shape, dtype=np.float32)
    u, v = (u - width / 2) / np.float32(spread_px), (v - height / 2) / np.float32(spread_px)
    known = (depth_m > 0).astype(np.float32)
    w = np.divide(1.0, depth_m, out=np.zeros(depth_m.shape, np.float32), where=depth_m > 0)
    sums = np.stack(
        (known, u * known, v * known, u * u * known, u * v * known, v * v * known, w, w * u, w * v, w * w), -1
    )
    across, down = _steps(picture, spread_px)
    for number in range(PASSES):
        share = np.sqrt(3.0) * 2 ** (PASSES - number - 1) / np.sqrt(4.0**PASSES - 1)
        decay = np.float32(np.exp(-np.sqrt(2.0) / (spread_px * share)))
        _walk(sums, decay**across)
        _walk(sums.transpose(1, 0, 2), (decay**down).T)
    return _fit(sums, u, v)


def _steps(picture: np.ndarray, spread_px: float) -> tuple[np.ndarray, np.ndarray]:
    """How long the step to each pixel is from the one on its left (h, w), and from the one above it."""
    levels = picture.reshape(*picture.shape[:2], -1).astype(np.float32)
    across, down = np.ones(picture.shape[:2], np.float32), np.ones(picture.shape[:2], np.float32)
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
    with np.errstate(divide="ignore", invalid="ignore"):
        mu, mv, muu, muv, mvv, mw, muw, mvw, mww = np.moveaxis(sums[..., 1:] / sums[..., :1], -1, 0)
        cuu, cuv, cvv = muu - mu * mu + STIFF, muv - mu * mv, mvv - mv * mv + STIFF
        cuw, cvw = muw - mu * mw, mvw - mv * mw
        determinant = cuu * cvv - cuv * cuv
        slope_u, slope_v = (cvv * cuw - cuv * cvw) / determinant, (cuu * cvw - cuv * cuw) / determinant
        plane = mw + slope_u * (u - mu) + slope_v * (v - mv)
        off = np.sqrt(np.maximum(mww - mw * mw - slope_u * cuw - slope_v * cvw, 0.0))
    return np.nan_to_num(plane), np.nan_to_num(off, nan=np.inf)

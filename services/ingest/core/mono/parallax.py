"""Inverse depth of points of a picture, by pictures around it whose poses are known (pure).

A point at (u, v, 1), normalised, with inverse depth w lies along r + w t in another picture, where r = R (u, v, 1) and
(R, t) is other_from_picture. Seen there at (u', v'), it gives two equations that are linear in w (Hartley and Zisserman
2004, 12.2):

    a = w c,    a = (r_x - u' r_z, r_y - v' r_z),    c = (u' t_z - t_x, v' t_z - t_y)

What is left of a across c is the distance from the epipolar line. Over all pictures w = sum(a c) / sum(c c), with the
standard deviation n / (f sqrt(sum(c c))), about the same for near and far points; n, pixels, is what points are off
their epipolar lines, at least NOISE_PX. A picture in which half of the points are not on their lines tells nothing.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.opencv import cv2

MOST_POINTS, QUALITY, APART_PX = 400, 0.005, 9
WINDOW, LEVELS = (21, 21), 4
RETURN_PX = 0.7  # a point followed there and back ends this close to where it began
OFF_LINE_PX = 1.5  # from its epipolar line
OFF_PX = 2.0  # of what one picture sees from what all say
NOISE_PX = 0.5
LEAST_SHARE = 0.5  # of the points followed into a picture that lie on their epipolar lines
NORMAL = 1.4826  # standard deviation over median of what is off
FARTHEST, NEAREST = 1 / 200, 1 / 0.1  # inverse depths between which a point is believed, 1/m
TINY = 1e-12


@dataclass(frozen=True)
class View:
    """Where points of a picture are in another one."""

    other_from_picture: np.ndarray  # (4, 4)
    points_px: np.ndarray  # (n, 2)
    followed: np.ndarray  # (n,) bool


@dataclass(frozen=True)
class Measured:
    """Points of a picture whose depth is known."""

    points_px: np.ndarray  # (n, 2)
    inverse_depth: np.ndarray  # (n,), 1/m
    sigma: np.ndarray  # (n,), 1/m


def corners(grey: np.ndarray) -> np.ndarray:
    """Points (n, 2), pixels, of a picture (h, w) uint8 that can be found again (Shi and Tomasi 1994)."""
    found = cv2.goodFeaturesToTrack(grey, MOST_POINTS, QUALITY, APART_PX)
    return np.zeros((0, 2), np.float32) if found is None else found.reshape(-1, 2)


def look(  # noqa: PLR0917
    picture: np.ndarray,
    other: np.ndarray,
    points_px: np.ndarray,
    other_from_picture: np.ndarray,
    camera: Intrinsics,
    guess: float,
) -> View:
    """Follow points (n, 2) of a picture into another one, from where they would be at the inverse depth `guess` (1/m).

    Optical flow by Lucas and Kanade (Bouguet 2001), there and back.
    """
    if not len(points_px):
        return View(other_from_picture, points_px, np.zeros(0, bool))
    start_px = _seen_from(points_px, other_from_picture, camera, guess)
    there_px, found = _flow(picture, other, points_px, start_px)
    back_px, returned = _flow(other, picture, there_px, there_px - (start_px - points_px))
    height, width = other.shape
    inside = (there_px >= 0).all(axis=1) & (there_px[:, 0] < width) & (there_px[:, 1] < height)
    closed = np.linalg.norm(back_px - points_px, axis=1) < RETURN_PX
    return View(other_from_picture, there_px, inside & closed & found & returned)


def _flow(
    picture: np.ndarray, other: np.ndarray, points_px: np.ndarray, start_px: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Where points (n, 2) went, looked for from `start_px` on, and whether (n,) they were found."""
    there_px, found, _ = cv2.calcOpticalFlowPyrLK(
        picture,
        other,
        points_px,
        start_px.copy(),
        winSize=WINDOW,
        maxLevel=LEVELS,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    return np.asarray(there_px), np.asarray(found)[:, 0] > 0


def measure(points_px: np.ndarray, views: Sequence[View], camera: Intrinsics) -> Measured:
    """Inverse depths of those points (n, 2) that views tell."""
    focal_px = (camera.fx_px + camera.fy_px) / 2
    rays = _normalised(points_px, camera)
    equations = [_equations(rays, view, camera) for view in views]
    off_px = [_off_line(a, c, view.followed, focal_px) for (a, c), view in zip(equations, views, strict=True)]
    used = [_on_line(off, view.followed) for off, view in zip(off_px, views, strict=True)]
    seen_px = np.concatenate([np.zeros(0), *(off[ok] for off, ok in zip(off_px, used, strict=True))])
    noise_px = max(NOISE_PX, NORMAL * float(np.median(seen_px))) if len(seen_px) else NOISE_PX
    inverse_depth, strength = _solved(equations, used, len(rays))
    used = [
        ok & (focal_px * np.linalg.norm(a - inverse_depth[:, None] * c, axis=1) < OFF_PX)
        for ok, (a, c) in zip(used, equations, strict=True)
    ]
    inverse_depth, strength = _solved(equations, used, len(rays))
    known = (strength > 0) & (inverse_depth > FARTHEST) & (inverse_depth < NEAREST)
    sigma = noise_px / focal_px / np.sqrt(strength[known])
    return Measured(points_px[known], inverse_depth[known], sigma)


def _normalised(points_px: np.ndarray, camera: Intrinsics) -> np.ndarray:
    """Points (n, 2) as (u, v, 1)."""
    flat = (points_px - (camera.cx_px, camera.cy_px)) / (camera.fx_px, camera.fy_px)
    return np.column_stack((flat, np.ones(len(flat))))


def _seen_from(
    points_px: np.ndarray, other_from_picture: np.ndarray, camera: Intrinsics, inverse_depth: float
) -> np.ndarray:
    """Where points (n, 2) of one inverse depth are in another picture, pixels; those behind it stay where they are."""
    rotation, shift = other_from_picture[:3, :3], other_from_picture[:3, 3]
    x, y, z = (_normalised(points_px, camera) @ rotation.T + inverse_depth * shift).T
    ahead = np.where(z > TINY, z, 1.0)
    there = np.column_stack((camera.fx_px * x / ahead + camera.cx_px, camera.fy_px * y / ahead + camera.cy_px))
    return np.where((z > TINY)[:, None], there, points_px).astype(np.float32)


def _equations(rays: np.ndarray, view: View, camera: Intrinsics) -> tuple[np.ndarray, np.ndarray]:
    """a and c of the module's text, (n, 2) each."""
    turned, shift = rays @ view.other_from_picture[:3, :3].T, view.other_from_picture[:3, 3]
    seen = _normalised(view.points_px, camera)[:, :2]
    return turned[:, :2] - seen * turned[:, 2:], seen * shift[2] - shift[:2]


def _off_line(a: np.ndarray, c: np.ndarray, followed: np.ndarray, focal_px: float) -> np.ndarray:
    """Pixels (n,) from where points are seen to their epipolar lines; infinite for none, and at the epipole."""
    length = np.linalg.norm(c, axis=1)
    across = np.abs(a[:, 0] * c[:, 1] - a[:, 1] * c[:, 0]) / np.maximum(length, TINY)
    return np.where(followed & (length > TINY), focal_px * across, np.inf)


def _on_line(off_px: np.ndarray, followed: np.ndarray) -> np.ndarray:
    """Points (n,) of a view that can be believed."""
    ok = off_px < OFF_LINE_PX
    return ok if ok.sum() >= LEAST_SHARE * followed.sum() else np.zeros_like(ok)


def _solved(
    equations: Sequence[tuple[np.ndarray, np.ndarray]], used: Sequence[np.ndarray], count: int
) -> tuple[np.ndarray, np.ndarray]:
    """w (n,), and sum(c c), 0 = nobody sees the point."""
    along, strength = np.zeros(count), np.zeros(count)
    for (a, c), ok in zip(equations, used, strict=True):
        along += ok * (a * c).sum(axis=1)
        strength += ok * (c * c).sum(axis=1)
    return np.divide(along, strength, out=np.zeros(count), where=strength > 0), strength

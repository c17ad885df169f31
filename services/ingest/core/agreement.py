"""How well depth images agree under their poses (pure).

Points of one depth image are moved into another that sees the same place. Where the poses are right, the depth there is
the point's own. A point behind what the other image sees may be hidden, so that it says nothing; a point well in front
of it stands in space that was seen to be free, and contradicts.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.geometry import inverse, rotation_angle_rad, transform

POINTS = 1500  # of each image, on a regular grid
TOLERANCE_M, TOLERANCE_SHARE = 0.04, 0.025  # of depth: noise of sensors and of the nearest pixel on slanted ground
HIDDEN = 8.0  # tolerances behind the other image's surface from which a point counts as hidden
LEAST_OVERLAP = 0.08  # share of an image's points that the other must see
LEAST_POINTS = 30  # in one pair


@dataclass(frozen=True)
class DepthView:
    """One depth image and where it was taken."""

    depth_m: np.ndarray  # (h, w), along the optical axis, 0 = no measurement
    intrinsics: Intrinsics  # of that image
    world_from_camera: np.ndarray  # 4 x 4


@dataclass(frozen=True)
class Agreement:
    """What the pairs of a sequence say together; NaN when no pair overlaps."""

    share: float  # of compared points whose depth is the other image's, within tolerance
    median_error_m: float  # of compared points, absolute
    overlap: float  # share of points that fall on a measurement of the other image, over all pairs
    pairs: int  # that overlap
    points: int  # compared


NOTHING = Agreement(float("nan"), float("nan"), 0.0, 0, 0)


def agreement(views: Sequence[DepthView], pairs: Sequence[tuple[int, int]] | None = None) -> Agreement:
    """How well views agree, in both directions of each pair of indices; pairs default to neighbours.

    Pairs that do not overlap are left out of `share` and `median_error_m`, and lower `overlap`.
    """
    chosen = [(i, i + 1) for i in range(len(views) - 1)] if pairs is None else list(pairs)
    points_m = {i: grid_points(views[i]) for i in {index for pair in chosen for index in pair}}
    errors: list[np.ndarray] = []
    tolerances: list[np.ndarray] = []
    seen = total = overlapping = 0
    for i, j in chosen:
        found = [_compared(points_m[a], views[a], views[b]) for a, b in ((i, j), (j, i))]
        seen += sum(len(error_m) for error_m, _ in found)
        total += len(points_m[i]) + len(points_m[j])
        useful = [
            pair
            for pair, index in zip(found, (i, j), strict=True)
            if len(pair[0]) >= max(LEAST_POINTS, LEAST_OVERLAP * len(points_m[index]))
        ]
        overlapping += bool(useful)
        errors += [error_m for error_m, _ in useful]
        tolerances += [tolerance_m for _, tolerance_m in useful]
    if not errors:
        return replace(NOTHING, overlap=seen / total if total else 0.0)
    error_m, tolerance_m = np.concatenate(errors), np.concatenate(tolerances)
    told = error_m < HIDDEN * tolerance_m
    if not told.any():
        return replace(NOTHING, overlap=seen / total)
    distance_m = np.abs(error_m[told])
    share = float((distance_m <= tolerance_m[told]).mean())
    return Agreement(share, float(np.median(distance_m)), seen / total, overlapping, int(told.sum()))


def with_poses(views: Sequence[DepthView], world_from_camera: Sequence[np.ndarray]) -> list[DepthView]:
    """The same images under other poses."""
    return [replace(view, world_from_camera=pose) for view, pose in zip(views, world_from_camera, strict=True)]


def moving_pairs(
    world_from_camera: Sequence[np.ndarray], least_m: float = 0.1, least_rad: float = 0.07, reach: int = 8
) -> list[tuple[int, int]]:
    """For each pose the first of the next `reach` by which the camera has moved or turned enough to tell poses apart.

    The angle between two poses stays the same when all are inverted or their quaternions are read in another order.
    """
    return list(_moving(world_from_camera, least_m, least_rad, reach))


def _moving(poses: Sequence[np.ndarray], least_m: float, least_rad: float, reach: int) -> Iterator[tuple[int, int]]:
    for i, pose in enumerate(poses):
        for j in range(i + 1, min(i + 1 + reach, len(poses))):
            moved = inverse(pose) @ poses[j]
            if np.linalg.norm(moved[:3, 3]) >= least_m or rotation_angle_rad(moved) >= least_rad:
                yield i, j
                break


def grid_points(view: DepthView) -> np.ndarray:
    """Camera points (n, 3) of about POINTS pixels on a regular grid, those with a measurement."""
    height_px, width_px = view.depth_m.shape
    step = max(1, round((height_px * width_px / POINTS) ** 0.5))
    depth_m = view.depth_m[step // 2 :: step, step // 2 :: step]
    rows, columns = np.nonzero(depth_m > 0)
    z = depth_m[rows, columns].astype(np.float64)
    camera = view.intrinsics
    x = (columns * step + step // 2 - camera.cx_px) / camera.fx_px * z
    y = (rows * step + step // 2 - camera.cy_px) / camera.fy_px * z
    return np.stack((x, y, z), axis=1)


def _compared(points_m: np.ndarray, one: DepthView, other: DepthView) -> tuple[np.ndarray, np.ndarray]:
    """By how much each of the points that `other` measures lies behind its surface, and the tolerance there, metres."""
    x, y, z = transform(inverse(other.world_from_camera) @ one.world_from_camera, points_m).T
    camera = other.intrinsics
    height_px, width_px = other.depth_m.shape
    ahead = z > TOLERANCE_M
    safe = np.where(ahead, z, 1.0)
    column, row = np.rint(camera.fx_px * x / safe + camera.cx_px), np.rint(camera.fy_px * y / safe + camera.cy_px)
    inside = ahead & (column >= 0) & (column < width_px) & (row >= 0) & (row < height_px)
    measured_m = other.depth_m[row[inside].astype(int), column[inside].astype(int)]
    valid = measured_m > 0
    depth_m = z[inside][valid]
    tolerance_m = TOLERANCE_M + TOLERANCE_SHARE * np.minimum(depth_m, measured_m[valid])
    return depth_m - measured_m[valid], tolerance_m

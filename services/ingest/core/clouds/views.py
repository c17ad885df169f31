"""Cameras that a lidar without one is given, so that its points become depth images like any others (pure)."""

from collections.abc import Sequence

import numpy as np

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.geometry import inverse, project, rotation_angle_rad, transform
from prior_sg.services.ingest.core.poses import FROM_CAMERA

SIZE_PX = (192, 144)
SHARE = 0.02  # of the pixels of a view that points must fall into, else nothing is there to be seen
MOVED_M, TURNED_DEG, WAITED_NS = 0.25, 20.0, 2_000_000_000  # after which a sweep is looked at again
VIEW = Intrinsics(
    width_px=SIZE_PX[0],
    height_px=SIZE_PX[1],
    fx_px=SIZE_PX[0] / 2,  # 90 degrees wide
    fy_px=SIZE_PX[0] / 2,
    cx_px=(SIZE_PX[0] - 1) / 2,
    cy_px=(SIZE_PX[1] - 1) / 2,
)


def lidar_from_views() -> list[np.ndarray]:
    """Four views (4, 4) around the z axis of a lidar with x forward, y left and z up: ahead, left, behind, right."""
    views = []
    for cosine, sine in ((1, 0), (0, 1), (-1, 0), (0, -1)):
        turn = np.array(((cosine, -sine, 0, 0), (sine, cosine, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1)), np.float64)
        views.append(turn @ FROM_CAMERA["ros"])
    return views


def seen(points_lidar: np.ndarray, lidar_from_view: np.ndarray) -> bool:
    """Whether enough of a lidar's points (n, 3) fall into a view for a depth image."""
    pixels, depths_m = project(transform(inverse(lidar_from_view), points_lidar), VIEW)
    inside = (depths_m > 0) & (pixels >= 0).all(axis=1) & (pixels < SIZE_PX).all(axis=1)
    return len(np.unique(np.rint(pixels[inside]).astype(int), axis=0)) >= SHARE * SIZE_PX[0] * SIZE_PX[1]


def looked_at(stamps_ns: Sequence[int], world_from_lidar: Sequence[np.ndarray | None]) -> list[int]:
    """Positions of the sweeps between which the sensor moved, turned or waited enough; those without pose are none."""
    chosen: list[int] = []
    for i, pose in enumerate(world_from_lidar):
        if pose is None:
            continue
        last = world_from_lidar[chosen[-1]] if chosen else None
        if last is not None and stamps_ns[i] - stamps_ns[chosen[-1]] < WAITED_NS:
            moved = inverse(last) @ pose
            if np.linalg.norm(moved[:3, 3]) < MOVED_M and np.degrees(rotation_angle_rad(moved)) < TURNED_DEG:
                continue
        chosen.append(i)
    return chosen

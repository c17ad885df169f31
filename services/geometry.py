"""Poses, cameras and polygons (pure). World: metres, z up. Camera: x right, y down, z forward."""

import numpy as np

from prior_sg.schemas.frames import Intrinsics


def pose_from_quaternion(position_m: np.ndarray, quaternion_xyzw: np.ndarray) -> np.ndarray:
    """4 x 4 rigid motion from a position and a quaternion, which is normalised first."""
    x, y, z, w = np.asarray(quaternion_xyzw, float) / np.linalg.norm(quaternion_xyzw)
    pose = np.eye(4)
    pose[:3, :3] = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    pose[:3, 3] = position_m
    return pose


def quaternion_of(motion: np.ndarray) -> np.ndarray:
    """x y z w of a rigid motion's rotation, w not negative."""
    r = motion[:3, :3]
    squares = np.array(  # four times the products of the components, row by row
        (
            (1 + r[0, 0] - r[1, 1] - r[2, 2], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0], r[2, 1] - r[1, 2]),
            (r[0, 1] + r[1, 0], 1 - r[0, 0] + r[1, 1] - r[2, 2], r[1, 2] + r[2, 1], r[0, 2] - r[2, 0]),
            (r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], 1 - r[0, 0] - r[1, 1] + r[2, 2], r[1, 0] - r[0, 1]),
            (r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], 1 + np.trace(r)),
        )
    )
    row = squares[int(np.argmax(np.diag(squares)))]
    return np.asarray(row / np.copysign(np.linalg.norm(row), row[3]))


def inverse(pose: np.ndarray) -> np.ndarray:
    """Inverse of a 4 x 4 rigid motion."""
    result = np.eye(4)
    result[:3, :3] = pose[:3, :3].T
    result[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return result


def transform(b_from_a: np.ndarray, points_a: np.ndarray) -> np.ndarray:
    """Points (n, 3) from frame a to frame b."""
    points_b: np.ndarray = points_a @ b_from_a[:3, :3].T + b_from_a[:3, 3]
    return points_b


def rotation_angle_rad(b_from_a: np.ndarray) -> float:
    """Angle of the rotation part of a rigid motion."""
    return float(np.arccos(np.clip((np.trace(b_from_a[:3, :3]) - 1) / 2, -1.0, 1.0)))


def rows_before(world_from_sheet: np.ndarray, points_world: np.ndarray) -> np.ndarray:
    """Rows (n,) of the points (point, 3) in front of a sheet (4, 4), out of which its z axis points; all where there
    are none. Nobody sees it from behind, and what is nearest may lie behind the wall that it hangs on."""
    before = (points_world - world_from_sheet[:3, 3]) @ world_from_sheet[:3, 2] > 0
    return np.flatnonzero(before) if before.any() else np.arange(len(points_world))


def project(points_camera: np.ndarray, camera: Intrinsics) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (n, 2) and depths (n,) of points (n, 3); pixels of points with depth <= 0 are not meaningful."""
    depths_m = points_camera[:, 2]
    safe = np.where(depths_m > 1e-6, depths_m, 1.0)
    u = camera.fx_px * points_camera[:, 0] / safe + camera.cx_px
    v = camera.fy_px * points_camera[:, 1] / safe + camera.cy_px
    return np.stack((u, v), axis=1), depths_m


def back_project(depth_m: np.ndarray, camera: Intrinsics) -> np.ndarray:
    """Camera points (h, w, 3) of a depth image (h, w); depth 0 gives the origin."""
    v, u = np.indices(depth_m.shape)
    x = (u - camera.cx_px) / camera.fx_px * depth_m
    y = (v - camera.cy_px) / camera.fy_px * depth_m
    return np.stack((x, y, depth_m), axis=-1)


def inside_polygon(points: np.ndarray, polygon: np.ndarray) -> np.ndarray:
    """Whether each point (n, 2) lies inside a simple polygon (m, 2), by crossing number."""
    x, y = points[:, 0:1], points[:, 1:2]
    ax, ay = polygon[:, 0], polygon[:, 1]
    bx, by = np.roll(ax, -1), np.roll(ay, -1)
    spans = (ay > y) != (by > y)
    slope = np.divide(bx - ax, by - ay, out=np.zeros_like(ax, dtype=float), where=by != ay)
    inside: np.ndarray = (spans & (x < ax + (y - ay) * slope)).sum(axis=1) % 2 == 1
    return inside

"""Frames that differ by a heading and a translation, gravity being known to all (pure)."""

import numpy as np


def level(yaw_rad: float, translation_m: np.ndarray) -> np.ndarray:
    """The rigid motion (4, 4) that turns about the vertical, then moves."""
    pose = np.eye(4)
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    pose[:2, :2] = (cos, -sin), (sin, cos)
    pose[:3, 3] = translation_m
    return pose


def yaw_of(pose: np.ndarray) -> float:
    """The heading of a rigid motion, radians."""
    return float(np.arctan2(pose[1, 0] - pose[0, 1], pose[0, 0] + pose[1, 1]))


def fitted(points_a: np.ndarray, points_b: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """The level motion b_from_a (4, 4) that brings points (n, 3) nearest to their counterparts: in closed form."""
    weights = np.ones(len(points_a)) if weights is None else weights
    shares = weights / weights.sum()
    middle_a, middle_b = shares @ points_a, shares @ points_b
    a, b = points_a - middle_a, points_b - middle_b
    cross = shares @ (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    dot = shares @ (a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1])
    pose = level(float(np.arctan2(cross, dot)), np.zeros(3))
    pose[:3, 3] = middle_b - pose[:3, :3] @ middle_a
    return pose


def wrapped(angle_rad: np.ndarray | float) -> np.ndarray:
    """Angles in (-pi, pi]."""
    return np.asarray((np.asarray(angle_rad) + np.pi) % (2 * np.pi) - np.pi)


def apart(one: np.ndarray, other: np.ndarray, around_m: np.ndarray) -> tuple[float, float]:
    """How far two motions (4, 4) are from each other: metres at a point (3,) of the frame they start from, radians."""
    gap_m = (one[:3, :3] - other[:3, :3]) @ around_m + one[:3, 3] - other[:3, 3]
    return float(np.linalg.norm(gap_m)), abs(float(wrapped(yaw_of(one) - yaw_of(other))))

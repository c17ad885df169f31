"""Fitting one map's surface to another's: point to plane, in heading and translation (pure).

The surface is that of the places' balls, whose radii point out of it. Frontiers are surface, too, in one map only; the
directions there do not agree, and far residuals are left out.
"""

import numpy as np
from scipy.spatial import cKDTree

from prior_sg.deploy.fleet.core.finding.frames import level
from prior_sg.deploy.fleet.core.finding.shape import Shape
from prior_sg.services.geometry import transform

Surface = tuple[np.ndarray, np.ndarray]  # points (n, 3), directions (n, 3) out of it
ROUNDS = 10
REACH_M = (0.6, 0.3)  # in the first rounds, in the last
FACING = 0.8  # least cosine between two directions that are of one wall
LEAST_POINTS = 30
MOST_POINTS = 800
STILL_M, STILL_RAD = 1e-3, 1e-4


def refined(b_from_a: np.ndarray, a: Shape, b: Shape) -> np.ndarray:
    """The motion (4, 4) after fitting; the same where too little lies together."""
    points_a, normals_a = a.surface
    points_b, normals_b = b.surface
    if min(len(points_a), len(points_b)) < LEAST_POINTS:
        return b_from_a
    step = max(1, len(points_a) // MOST_POINTS)
    points_a, normals_a = points_a[::step], normals_a[::step]
    pose = b_from_a
    for number in range(ROUNDS):
        reach_m = REACH_M[0] + (REACH_M[1] - REACH_M[0]) * min(1.0, number / (ROUNDS / 2))
        moved, turn = _step(pose, (points_a, normals_a), (points_b, normals_b), b.surface_tree, reach_m)
        if moved is None:
            return b_from_a
        pose = moved
        if turn < STILL_RAD and number > ROUNDS / 2:
            break
    return pose


def _step(pose: np.ndarray, a: Surface, b: Surface, tree: cKDTree, reach_m: float) -> tuple[np.ndarray | None, float]:
    """One step of Gauss-Newton with Huber's weights; None with too few points. Returns its size, too."""
    (points_a, normals_a), (points_b, normals_b) = a, b
    moved_m = transform(pose, points_a)
    distances_m, rows = tree.query(moved_m, distance_upper_bound=reach_m)
    near = np.isfinite(distances_m)
    facing = np.zeros(len(near), bool)
    facing[near] = ((normals_a[near] @ pose[:3, :3].T) * normals_b[rows[near]]).sum(axis=1) > FACING
    at = np.flatnonzero(facing)
    if len(at) < LEAST_POINTS:
        return None, 0.0
    middle_m = moved_m[at].mean(axis=0)
    out, here_m = normals_b[rows[at]], moved_m[at] - middle_m
    off_m = ((points_b[rows[at]] - moved_m[at]) * out).sum(axis=1)
    lever = out[:, 1] * here_m[:, 0] - out[:, 0] * here_m[:, 1]
    slopes = np.column_stack((lever, out))
    weights = np.minimum(1.0, 0.1 / np.maximum(np.abs(off_m), 1e-9))
    normal = (slopes * weights[:, None]).T @ slopes + 1e-3 * len(at) * np.eye(4)
    turn, *shift = np.linalg.solve(normal, (slopes * weights[:, None]).T @ off_m).tolist()
    change = level(turn, np.zeros(3))
    change[:3, 3] = middle_m + np.array(shift) - change[:3, :3] @ middle_m
    return change @ pose, abs(turn) + float(np.linalg.norm(shift))

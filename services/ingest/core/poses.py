"""Written poses as rigid motions: rounding mended, conventions turned into ours (pure)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from prior_sg.services.geometry import inverse, pose_from_quaternion
from prior_sg.services.ingest.core.options import ReadOptions

EXACT = 1e-6  # rotations this close to orthonormal pass unchanged to the last bit
MAX_STRETCH = 0.05  # what rounding to one or two decimals may do to an axis; more is not a rotation
FROM_CAMERA = {  # camera axes as written, from ours: x right, y down, z forward
    "opencv": np.eye(4),
    "opengl": np.diag((1.0, -1.0, -1.0, 1.0)),
    "ros": np.array(((0.0, 0, 1, 0), (-1, 0, 0, 0), (0, -1, 0, 0), (0, 0, 0, 1))),
    "ned": np.array(((0.0, 0, 1, 0), (1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 0, 1))),
}


class PoseError(ValueError):
    """A written pose is none; the text is the reason."""


def stretch(matrix: np.ndarray) -> float:
    """Largest share by which the rotation part (of 4 x 4) lengthens or shortens anything; infinite when it mirrors."""
    rotation = matrix[:3, :3]
    if not np.isfinite(matrix).all() or np.linalg.det(rotation) <= 0:
        return float("inf")
    return float(np.abs(np.linalg.svd(rotation, compute_uv=False) - 1).max())


def rigid(matrix: np.ndarray) -> np.ndarray:
    """The 4 x 4 rigid motion nearest to a written one, which few decimals made inexact. Raises PoseError."""
    matrix = np.asarray(matrix, np.float64)
    if not np.isfinite(matrix).all():
        raise PoseError("its pose is not finite")
    if not np.allclose(matrix[3], (0, 0, 0, 1), atol=EXACT):
        raise PoseError("its pose is not a motion: the last row is not 0 0 0 1")
    rotation = matrix[:3, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() <= EXACT and np.linalg.det(rotation) > 0:
        return matrix
    off = stretch(matrix)
    if off > MAX_STRETCH:
        said = "it mirrors" if np.isinf(off) else f"its axes are off by {off:.0%}"
        raise PoseError(f"its pose has no rotation: {said}")
    u, _, vt = np.linalg.svd(rotation)
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = u @ vt, matrix[:3, 3]
    return result


def matrix_of(text: str | bytes) -> np.ndarray:
    """The 4 x 4 matrix of sixteen numbers row by row, or of twelve without the last row. Raises PoseError."""
    words = text.decode(errors="replace") if isinstance(text, bytes) else text
    try:
        numbers = np.array(words.replace(",", " ").replace(";", " ").split(), float)
        matrix = np.vstack((numbers.reshape(3, 4), (0, 0, 0, 1))) if numbers.size == 12 else numbers.reshape(4, 4)
    except ValueError as error:
        raise PoseError(f"its pose is not sixteen numbers: {error}") from error
    if not np.isfinite(matrix).all():
        raise PoseError("its pose is not finite")
    return matrix


def quaternion_of(words: Sequence[str], order: str) -> np.ndarray:
    """The 4 x 4 matrix of tx ty tz and a quaternion in the order xyzw or wxyz. Raises PoseError."""
    try:
        numbers = np.array(words[:7], float)
    except ValueError as error:
        raise PoseError(f"its pose is not seven numbers: {error}") from error
    if numbers.shape != (7,):
        raise PoseError(f"its pose is not seven numbers but {numbers.size}")
    quaternion_xyzw = np.roll(numbers[3:], -1) if order == "wxyz" else numbers[3:]
    if not np.isfinite(numbers).all() or not np.linalg.norm(quaternion_xyzw) > 0:
        raise PoseError("its pose is not finite")
    return pose_from_quaternion(numbers[:3], quaternion_xyzw)


@dataclass(frozen=True)
class Convention:
    """What the written poses mean."""

    poses: str = "world_from_camera"
    axes: str = "opencv"
    quaternion: str = "xyzw"
    position_scale_m: float = 1.0  # metres per unit of written positions

    def changed(self, options: ReadOptions) -> "Convention":
        """The same with what the user says instead."""
        return Convention(
            options.poses or self.poses,
            options.camera_axes or self.axes,
            options.quaternion or self.quaternion,
            options.position_scale_m * self.position_scale_m,
        )

    def of_matrix(self, matrix: np.ndarray) -> np.ndarray:
        """source_from_camera, camera x right, y down, z forward, of a written matrix (4, 4). Raises PoseError."""
        if self.position_scale_m != 1.0:
            matrix = np.array(matrix, np.float64)
            matrix[:3, 3] *= self.position_scale_m
        if self.poses == "world_from_camera" and self.axes == "opencv":
            return matrix
        motion = rigid(matrix)
        return (inverse(motion) if self.poses == "camera_from_world" else motion) @ FROM_CAMERA[self.axes]

    def of_text(self, text: str | bytes) -> np.ndarray:
        """The same, of sixteen or twelve numbers. Raises PoseError."""
        return self.of_matrix(matrix_of(text))

    def of_words(self, words: Sequence[str]) -> np.ndarray:
        """The same, of tx ty tz and a quaternion. Raises PoseError."""
        return self.of_matrix(quaternion_of(words, self.quaternion))

    def said(self) -> str:
        """One phrase."""
        return f"poses {self.poses} with {self.axes} camera axes"

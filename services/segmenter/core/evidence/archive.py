"""All pyramids, without their images, and places integrated over all of them (pure).

New or moved places, a corrected pose or another query radius are so integrated over every frame as if they had been
there from the start.
"""

from collections.abc import Set

import numpy as np

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.geometry import inverse
from prior_sg.services.segmenter.core.evidence.kernel import Evidence, Frame, KernelConfig, Targets, integrate

PAIRS_PER_BLOCK = 1 << 19  # frame-place pairs tested at once; bounds the memory of the visibility test


class FrameArchive:
    """All frames, in the order of arrival, with a frustum test of many places against all of them at once."""

    def __init__(self) -> None:
        self.frames: list[Frame] = []
        self._index: dict[int, int] = {}  # by frame id

    def get(self, frame_id: int) -> Frame:
        """The frame of this number. Raises KeyError."""
        return self.frames[self._index[frame_id]]

    def add(self, frame_id: int, frame: Frame) -> bool:
        """Keep a frame; False when this id is already here."""
        if frame_id in self._index:
            return False
        self._index[frame_id] = len(self.frames)
        self.frames.append(frame)
        return True

    def move(self, frame_id: int, world_from_camera: np.ndarray) -> tuple[Frame, Frame] | None:
        """Give a frame another pose; returns it before and after, None where it is unknown or stands there already."""
        index = self._index.get(frame_id)
        if index is None:
            return None
        before, camera_from_world = self.frames[index], inverse(world_from_camera)
        if np.array_equal(before.camera_from_world, camera_from_world):
            return None
        self.frames[index] = before._replace(camera_from_world=camera_from_world)
        return before, self.frames[index]

    @property
    def frame_ids(self) -> Set[int]:
        """Numbers of the frames that are here."""
        return self._index.keys()

    def __len__(self) -> int:
        return len(self.frames)

    def candidates(self, positions_m: np.ndarray, cfg: KernelConfig) -> np.ndarray:
        """Frames (indices, ascending) whose frustum may hold any of the positions; never leaves out one that does."""
        if not self.frames or not len(positions_m):
            return np.zeros(0, dtype=np.int64)
        poses = np.stack([frame.camera_from_world for frame in self.frames])
        limits = np.array([_frustum_tangents(frame.intrinsics) for frame in self.frames])
        block = max(PAIRS_PER_BLOCK // len(positions_m), 1)
        found = []
        for start in range(0, len(poses), block):
            pose, limit = poses[start : start + block], limits[start : start + block, :, None]
            x, y, z = np.moveaxis(pose[:, :3, :3] @ positions_m.T + pose[:, :3, 3:], 1, 0)
            inside = (z >= cfg.min_depth_m) & (z <= cfg.max_depth_m)
            inside &= (x >= limit[:, 0] * z) & (x <= limit[:, 1] * z) & (y >= limit[:, 2] * z) & (y <= limit[:, 3] * z)
            found.append(np.flatnonzero(inside.any(axis=1)) + start)
        return np.concatenate(found)


def integrate_all(
    evidence: Evidence, archive: FrameArchive, targets: Targets, query_radius_m: float, cfg: KernelConfig
) -> None:
    """Add every stored frame to targets that have none yet."""
    for index in archive.candidates(targets.positions_m, cfg):
        integrate(evidence, archive.frames[index], targets, query_radius_m, cfg)


def _frustum_tangents(camera: Intrinsics) -> tuple[float, float, float, float]:
    """Bounds of x / z and y / z inside the image, and one pixel more so that rounding leaves nothing out."""
    return (
        (-1.5 - camera.cx_px) / camera.fx_px,
        (camera.width_px + 0.5 - camera.cx_px) / camera.fx_px,
        (-1.5 - camera.cy_px) / camera.fy_px,
        (camera.height_px + 0.5 - camera.cy_px) / camera.fy_px,
    )

"""The pyramids kept, without their images, and places integrated over all of them (pure).

New or moved places, a corrected pose or another query radius are so integrated over every frame as if they had been
there from the start. Beyond a limit, of the frames that look from one spot in one direction, where most were kept, the
oldest goes: a robot that works for days in one building keeps what its whole map was seen from. What a place has of a
frame that goes stays with it.
"""

from collections.abc import Set
from operator import itemgetter
from typing import NamedTuple

import numpy as np

from prior_sg.services.geometry import inverse
from prior_sg.services.segmenter.core.evidence.kernel import (
    Evidence,
    Frame,
    KernelConfig,
    Targets,
    frustum_tangents,
    frustums_with_any,
    integrate,
)

SPOT_M = 0.5  # side of a spot that frames look from
DIRECTIONS = 2  # steps from the middle of an axis to its end: directions are told apart by about 30 degrees
View = tuple[int, ...]  # a spot and a direction


class Frustums(NamedTuple):
    """Where frames look."""

    cameras_from_world: np.ndarray  # (frame, 4, 4)
    tangents: np.ndarray  # (frame, 4) bounds of the image


def frustums_of(frames: list[Frame]) -> Frustums:
    """Those of at least one frame."""
    tangents = [frustum_tangents(frame.intrinsics) for frame in frames]
    return Frustums(np.stack([frame.camera_from_world for frame in frames]), np.stack(tangents))


class FrameArchive:
    """Frames in the order of arrival, with a frustum test of many places against all of them at once."""

    def __init__(self) -> None:
        self.size_bytes = 0
        self._kept: dict[int, Frame] = {}  # by frame id
        self._views: dict[View, dict[int, None]] = {}  # ids of the frames that are kept
        self._heard: set[int] = set()  # ids of all frames, kept or not
        self._frustums: Frustums | None = None  # of the frames that are kept, None = to be laid out

    def get(self, frame_id: int) -> Frame:
        """A frame that is kept. Raises KeyError."""
        return self._kept[frame_id]

    def add(self, frame_id: int, frame: Frame, limit_bytes: float) -> bool:
        """Keep a frame, and let others go beyond the limit; False when this id has been here already."""
        if frame_id in self._heard:
            return False
        self._heard.add(frame_id)
        self._put(frame_id, frame)
        while self.size_bytes > limit_bytes and len(self._kept) > 1:
            fullest = max(self._views.values(), key=len)
            self._take(next(iter(fullest)))
        return True

    def move(self, frame_id: int, world_from_camera: np.ndarray) -> tuple[Frame, Frame] | None:
        """Give a frame another pose; returns it before and after, None where it is not kept or stands there already."""
        before, camera_from_world = self._kept.get(frame_id), inverse(world_from_camera)
        if before is None or np.array_equal(before.camera_from_world, camera_from_world):
            return None
        after = before._replace(camera_from_world=camera_from_world)
        self._leave(frame_id, before)
        self._kept[frame_id] = after  # in its former place
        self._frustums = None
        self._views.setdefault(view_of(after), {})[frame_id] = None
        return before, after

    @property
    def frames(self) -> list[Frame]:
        """All that are kept, in the order of arrival."""
        return list(self._kept.values())

    @property
    def by_number(self) -> dict[int, Frame]:
        """All that are kept, in the order of their ids, however they arrived."""
        return dict(sorted(self._kept.items(), key=itemgetter(0)))

    @property
    def kept_ids(self) -> Set[int]:
        """Numbers of the frames that are kept."""
        return self._kept.keys()

    @property
    def frame_ids(self) -> Set[int]:
        """Numbers of all frames that have been here: none of them is needed again."""
        return self._heard

    def __len__(self) -> int:
        return len(self._heard)

    def _put(self, frame_id: int, frame: Frame) -> None:
        self._kept[frame_id] = frame
        if self._frustums is not None:
            news = frustums_of([frame])
            self._frustums = Frustums(*(np.concatenate(pair) for pair in zip(self._frustums, news, strict=True)))
        self._views.setdefault(view_of(frame), {})[frame_id] = None
        self.size_bytes += size_bytes(frame)

    def _take(self, frame_id: int) -> None:
        frame = self._kept.pop(frame_id)
        self._frustums = None
        self._leave(frame_id, frame)
        self.size_bytes -= size_bytes(frame)

    def _leave(self, frame_id: int, frame: Frame) -> None:
        view = view_of(frame)
        del self._views[view][frame_id]
        if not self._views[view]:
            del self._views[view]

    def candidates(self, positions_m: np.ndarray, cfg: KernelConfig) -> np.ndarray:
        """Frames whose frustum may hold any of the positions, as indices into `frames`, ascending; never leaves out one
        that does."""
        if not self._kept or not len(positions_m):
            return np.zeros(0, dtype=np.int64)
        if self._frustums is None:
            self._frustums = frustums_of(self.frames)
        return frustums_with_any(*self._frustums, positions_m, cfg.min_depth_m, cfg.max_depth_m)


def integrate_all(
    evidence: Evidence, archive: FrameArchive, targets: Targets, query_radius_m: float, cfg: KernelConfig
) -> None:
    """Add every frame that is kept to targets that have none yet."""
    frames = archive.frames
    for index in archive.candidates(targets.positions_m, cfg):
        integrate(evidence, frames[index], targets, query_radius_m, cfg)


def view_of(frame: Frame) -> View:
    """From which spot, and in which direction, a frame looks."""
    rotation, shift = frame.camera_from_world[:3, :3], frame.camera_from_world[:3, 3]
    spot = np.floor(-(shift @ rotation) / SPOT_M)
    return (*spot.astype(np.int64).tolist(), *np.rint(rotation[2] * DIRECTIONS).astype(np.int64).tolist())


def size_bytes(frame: Frame) -> int:
    """Memory that a frame takes, but for a few hundred bytes."""
    return frame.embeddings.nbytes + frame.centers_px.nbytes + frame.sigmas_px.nbytes + frame.surface_m.nbytes

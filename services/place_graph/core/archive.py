"""Keyframes as the map needs them again when their poses are corrected: compressed depth, bounded (pure)."""

from collections.abc import Iterator
from dataclasses import dataclass, field

import msgspec
import numpy as np

from prior_sg.schemas.codec import copied
from prior_sg.schemas.frames import Keyframe


@dataclass(frozen=True)
class Kept:
    """One keyframe without its colour; `fused` tells whether the map holds it."""

    keyframe: Keyframe
    fused: bool

    @property
    def size_bytes(self) -> int:
        """Memory it takes, but for a few hundred bytes."""
        return len(self.keyframe.depth) + len(self.keyframe.mask)


@dataclass
class DepthArchive:
    """The newest keyframes by frame id, in order of arrival, at most `limit_bytes` of them."""

    limit_bytes: float
    size_bytes: int = 0
    _kept: dict[int, Kept] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self._kept)

    def get(self, frame_id: int) -> Kept | None:
        """A keyframe, if it is still there."""
        return self._kept.get(frame_id)

    def put(self, keyframe: Keyframe, fused: bool) -> None:
        """Keep a keyframe, or replace what is kept of it."""
        kept = Kept(_without_color(keyframe), fused)
        known = self._kept.get(keyframe.frame_id)
        self.size_bytes += kept.size_bytes - (known.size_bytes if known else 0)
        self._kept[keyframe.frame_id] = kept
        while self.size_bytes > self.limit_bytes and self._kept:
            self.size_bytes -= self._kept.pop(next(iter(self._kept))).size_bytes

    def unfused(self) -> Iterator[Keyframe]:
        """Keyframes that the map does not hold, oldest first."""
        return (kept.keyframe for kept in self._kept.values() if not kept.fused)


def moved(keyframe: Keyframe, world_from_camera: np.ndarray) -> Keyframe:
    """The same keyframe taken from elsewhere."""
    return msgspec.structs.replace(keyframe, world_from_camera=np.array(world_from_camera))


def _without_color(keyframe: Keyframe) -> Keyframe:
    return copied(msgspec.structs.replace(keyframe, color=b""))

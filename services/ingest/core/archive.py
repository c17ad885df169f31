"""Keyframes as late readers may ask for them again: compressed, bounded, oldest dropped first (pure)."""

from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import msgspec
import numpy as np

from prior_sg.schemas.features import Backfill
from prior_sg.schemas.frames import Keyframe

ON_THE_WAY = 16  # keyframes whose pyramids may overtake each other


@dataclass
class KeyframeArchive:
    """The newest keyframes with their images, in order of arrival."""

    size_bytes: int = 0
    _kept: deque[Keyframe] = field(default_factory=deque)

    def __iter__(self) -> Iterator[Keyframe]:
        return iter(self._kept)

    @property
    def oldest_frame_id(self) -> int:
        """Number of the oldest keyframe that is still there, -1 if there is none."""
        return self._kept[0].frame_id if self._kept else -1

    def put(self, keyframe: Keyframe, limit_bytes: float) -> None:
        """Keep a keyframe, and drop the oldest ones beyond the limit."""
        self._kept.append(keyframe)
        self.size_bytes += _size_bytes(keyframe)
        while self.size_bytes > limit_bytes:
            self.size_bytes -= _size_bytes(self._kept.popleft())

    def correct(self, poses: Mapping[int, np.ndarray]) -> None:
        """Give keyframes their corrected poses, by frame id, so that late readers map them where they are."""
        for position, keyframe in enumerate(self._kept):
            if keyframe.frame_id in poses:
                pose = np.array(poses[keyframe.frame_id])
                self._kept[position] = msgspec.structs.replace(keyframe, world_from_camera=pose)

    def between(self, first_frame_id: int, end_frame_id: int) -> Iterator[Keyframe]:
        """Keyframes of a half-open range of numbers, oldest first."""
        return (keyframe for keyframe in self._kept if first_frame_id <= keyframe.frame_id < end_frame_id)

    def lacked(self, wish: Backfill) -> Iterator[Keyframe]:
        """Keyframes that the asking reader lacks, oldest first.

        Unless the reader has settled, the newest ones are left out: their pyramids may be on the way to it. Those older
        than all it knows are not: they were there before it, or before the workers of that space.
        """
        known = set(wish.frame_ids.tolist())
        oldest, newest = min(known, default=0), max(known, default=-1)
        later = [keyframe.frame_id for keyframe in self.between(oldest, newest + 1)]
        unwanted = known if wish.settled else known.union(later[-ON_THE_WAY:])
        for keyframe in self._kept:
            wanted = wish.settled or keyframe.frame_id <= newest
            if wanted and keyframe.frame_id not in unwanted:
                yield keyframe


def _size_bytes(keyframe: Keyframe) -> int:
    return len(keyframe.color) + len(keyframe.depth) + len(keyframe.mask)

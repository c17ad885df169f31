"""The transforms and poses of the last seconds, as they come in from a robot (pure)."""

from bisect import bisect_left, insort
from collections.abc import Sequence
from dataclasses import dataclass, field

from prior_sg.services.ingest.core.ros.transforms import Stamped, Track, TransformTree

KEPT_NS = 10_000_000_000  # beyond, behind the newest, a stamp is forgotten
MOST_FRAMES = 1024
NOT_MOTION, TOO_MANY = "its numbers are no rigid motion", "tf has more than 1024 frames"
WENT_BACK = "its clock went back"


@dataclass
class Recent:
    """One transform, or one topic's poses, by stamp."""

    samples: list[Stamped] = field(default_factory=list)
    always: bool = False  # of /tf_static: it holds at all times, the last one said counts

    @property
    def newest_ns(self) -> int:
        """The newest stamp."""
        return self.samples[-1].stamp_ns

    def add(self, sample: Stamped) -> str:
        """Remember a sample; why the former ones were forgotten, empty = they were not."""
        fault = ""
        if self.samples and sample.stamp_ns < self.newest_ns - KEPT_NS:
            self.samples.clear()
            fault = WENT_BACK
        insort(self.samples, sample, key=_stamp)
        if self.samples[0].stamp_ns < self.newest_ns - 2 * KEPT_NS:
            del self.samples[: bisect_left(self.samples, self.newest_ns - KEPT_NS, key=_stamp)]
        return fault

    def track(self, stamp_ns: int) -> Track:
        """What is needed of it to tell the transform at a stamp."""
        if self.always:
            return Track(self.samples[-1:], fixed=True)
        right = bisect_left(self.samples, stamp_ns, key=_stamp)
        return Track(self.samples[max(0, right - 1) : right + 1], moves=True)


class RecentTransforms:
    """The tree of a robot's frames over the last seconds."""

    def __init__(self) -> None:
        self._edges: dict[str, dict[str, Recent]] = {}  # by child and parent

    @property
    def frames(self) -> list[str]:
        """All that have a parent."""
        return list(self._edges)

    def add(self, sample: Stamped, always: bool) -> str:
        """Remember a transform; what is wrong with it, or empty. /tf_static wins over /tf."""
        if not sample.is_motion():
            return NOT_MOTION
        parents = self._edges.get(sample.child)
        if parents is None:
            if len(self._edges) >= MOST_FRAMES:
                return TOO_MANY
            parents = self._edges[sample.child] = {}
        if always and not all(edge.always for edge in parents.values()):
            parents.clear()
        if not always and any(edge.always for edge in parents.values()):
            return ""
        edge = parents.setdefault(sample.parent, Recent(always=always))
        if edge.always:
            edge.samples = [sample]
            return ""
        return edge.add(sample)

    def tree(self, stamp_ns: int, frames: Sequence[str]) -> TransformTree:
        """The part of the tree above some frames, as it was at a stamp."""
        tracks: dict[str, dict[str, Track]] = {}
        waiting = [frame for frame in frames if frame]
        while waiting:
            child = waiting.pop()
            if child not in tracks and child in self._edges:
                tracks[child] = {parent: edge.track(stamp_ns) for parent, edge in self._edges[child].items()}
                waiting += tracks[child]
        return TransformTree.of_tracks(tracks)

    def known_until_ns(self, frames: Sequence[str], top: str) -> int | None:
        """The stamp up to which all that moves between some frames and `top` is known; None where nothing does."""
        newest: list[int] = []
        seen: set[str] = set()
        waiting = [frame for frame in frames if frame]
        while waiting:
            child = waiting.pop()
            if child not in seen and child != top:
                seen.add(child)
                edges = self._edges.get(child, {})
                newest += [edge.newest_ns for edge in edges.values() if not edge.always]
                waiting += edges
        return min(newest, default=None)


def _stamp(sample: Stamped) -> int:
    return sample.stamp_ns

"""How long keyframes take until the regions say what they show, from the passages of processes (pure)."""

from bisect import bisect_left
from collections.abc import Iterable
from dataclasses import dataclass, field

from prior_sg.schemas.status import Passage
from prior_sg.schemas.topics import KEYFRAME, PYRAMID, REGION_DELTA

BOUNDS_S = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0)
MOST_OPEN = 1024  # keyframes under way
MOST_ROBOTS = 64


@dataclass
class Histogram:
    """Durations counted by `bounds_s`, and those that are longer than all."""

    bounds_s: tuple[float, ...] = BOUNDS_S
    counts: list[int] = field(default_factory=list)
    sum_s: float = 0.0

    def __post_init__(self) -> None:
        self.counts = self.counts or [0] * (len(self.bounds_s) + 1)

    def add(self, seconds: float) -> None:
        """Count one."""
        self.counts[bisect_left(self.bounds_s, seconds)] += 1
        self.sum_s += seconds


@dataclass
class Latencies:
    """From the publication of a keyframe to the first regions told after its pyramid was taken in, by robot. Times of
    two hosts are compared: their clocks must agree, which `prior-sg doctor` looks at.
    """

    by_robot: dict[str, Histogram] = field(default_factory=dict)
    _sent_ns: dict[tuple[str, int], int] = field(default_factory=dict)
    _taken: dict[tuple[str, int], None] = field(default_factory=dict)  # pyramids no regions were told after

    def follow(self, passages: Iterable[Passage]) -> None:
        """Passages that have not been followed yet, of all processes."""
        for one in sorted(passages, key=lambda one: one.ended_ns):
            keyframe = (one.robot, one.frame_id)
            if KEYFRAME.name in one.published:
                self._sent_ns[keyframe] = one.ended_ns
            if one.topic == PYRAMID.name and keyframe in self._sent_ns:
                self._taken[keyframe] = None
            if REGION_DELTA.name in one.published:
                self._told(one)
            for known in (self._sent_ns, self._taken):
                while len(known) > MOST_OPEN:
                    del known[next(iter(known))]  # type: ignore[attr-defined]

    def _told(self, regions: Passage) -> None:
        for robot, frame_id in [keyframe for keyframe in self._taken if keyframe[0] == regions.robot]:
            del self._taken[robot, frame_id]
            sent_ns = self._sent_ns.pop((robot, frame_id), None)
            if sent_ns is not None and (robot in self.by_robot or len(self.by_robot) < MOST_ROBOTS):
                took_s = max(regions.ended_ns - sent_ns, 0) / 1e9
                self.by_robot.setdefault(robot, Histogram()).add(took_s)

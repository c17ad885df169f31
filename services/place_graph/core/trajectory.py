"""Whether a keyframe's pose can follow those before it (pure).

A camera moves at bounded speed; each of a robot's cameras is followed by itself. A keyframe that lies farther away than
that is refused: the tracker has jumped. If the
following ones move on smoothly from there, the tracker may have found its place again; they are believed once a few of
them in a row have done so and they do not contradict the map.
"""

from bisect import bisect_left, insort
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from prior_sg.schemas.frames import Keyframe


class Point(NamedTuple):
    """When and where a keyframe was taken."""

    stamp_ns: int
    center_m: tuple[float, float, float]
    frame_id: int


@dataclass(frozen=True)
class Bounds:
    """How far a camera gets: `slack_m` at once, and `max_speed_m_s`; 0 = anywhere."""

    max_speed_m_s: float
    slack_m: float

    def reachable_m(self, seconds: float) -> float:
        """The greatest distance after so much time."""
        return self.slack_m + self.max_speed_m_s * abs(seconds)


@dataclass
class Way:
    """Stamps and centres of one camera believed so far, and those of a jump that goes on."""

    believed: list[Point] = field(default_factory=list)  # by stamp
    astray: list[Point] = field(default_factory=list)
    contradictions: list[float] = field(default_factory=list)  # of these with the map, as shares of their depth

    def forget(self) -> None:
        """The jump is over."""
        self.astray.clear()
        self.contradictions.clear()


@dataclass
class Trajectory:
    """The ways of a robot's cameras."""

    ways: dict[str, Way] = field(default_factory=dict)  # by the camera's name

    @property
    def newest_ns(self) -> int:
        """The newest stamp believed."""
        return max((way.believed[-1].stamp_ns for way in self.ways.values() if way.believed), default=-(2**63))

    def jump_m(self, keyframe: Keyframe, bounds: Bounds) -> float:
        """How far a keyframe lies from its camera's neighbour in time, if that cannot be true; else 0."""
        return _leap_m(self.way_of(keyframe).believed, keyframe, bounds)

    def astray_ids(self, keyframe: Keyframe) -> list[int]:
        """The keyframes of the jump that goes on, of its camera."""
        return [point.frame_id for point in self.way_of(keyframe).astray]

    def believe(self, keyframe: Keyframe) -> None:
        """The keyframe is where it says."""
        way = self.way_of(keyframe)
        insort(way.believed, _point(keyframe))
        way.forget()

    def doubt(self, keyframe: Keyframe, bounds: Bounds, contradiction: float) -> None:
        """The keyframe may not be where it says."""
        way = self.way_of(keyframe)
        if not way.astray or _leap_m(way.astray[-1:], keyframe, bounds):
            way.forget()
        way.astray.append(_point(keyframe))
        way.contradictions.append(contradiction)

    def correct(self, keyframe: Keyframe) -> None:
        """The keyframe is here, wherever it was believed to be before."""
        way = self.way_of(keyframe)
        way.believed = [point for point in way.believed if point.frame_id != keyframe.frame_id]
        insort(way.believed, _point(keyframe))

    def way_of(self, keyframe: Keyframe) -> Way:
        """That of its camera."""
        return self.ways.setdefault(keyframe.camera, Way())


def _point(keyframe: Keyframe) -> Point:
    x, y, z = keyframe.world_from_camera[:3, 3].tolist()
    return Point(keyframe.stamp_ns, (x, y, z), keyframe.frame_id)


def _leap_m(track: list[Point], keyframe: Keyframe, bounds: Bounds) -> float:
    """Distance to the nearest in time, if it is too great; a keyframe that fits any of its neighbours fits."""
    if not track or bounds.max_speed_m_s <= 0:
        return 0.0
    after = bisect_left(track, keyframe.stamp_ns, key=lambda point: point.stamp_ns)
    nearest = {point.stamp_ns for point in track[max(0, after - 1) : after + 1]}
    leaps_m = []
    for stamp_ns, center_m, _ in track[max(0, after - 2) : after + 2]:
        if stamp_ns not in nearest:
            continue
        distance_m = float(np.linalg.norm(keyframe.world_from_camera[:3, 3] - center_m))
        if distance_m <= bounds.reachable_m((keyframe.stamp_ns - stamp_ns) / 1e9):
            return 0.0
        leaps_m.append(distance_m)
    return min(leaps_m)

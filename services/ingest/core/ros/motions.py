"""Where a robot's frames are, as its transforms and poses come in, and how its SLAM makes the world jump (pure)."""

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from prior_sg.services.geometry import inverse, rotation_angle_rad
from prior_sg.services.ingest.core.ros.posing import Way
from prior_sg.services.ingest.core.ros.recent import NOT_MOTION, Recent, RecentTransforms
from prior_sg.services.ingest.core.ros.topics import FIXED_TRANSFORMS, TF_TYPES, Topic
from prior_sg.services.ingest.core.ros.transforms import Stamped

JUMP_M, JUMP_DEG = 0.05, 1.0  # more than this at once is no drift that is followed
MOST_JUMPS = 64  # that wait for a frame after them; the oldest are forgotten


@dataclass(frozen=True)
class Fault:
    """Something that cannot be used: of what, in whose words, and of what kind (empty = as it says)."""

    what: str
    text: str
    kind: str = ""


@dataclass(frozen=True)
class Jump:
    """The world was moved under the robot, as its SLAM does when it closes a loop."""

    stamp_ns: int
    after_from_before: np.ndarray  # (4, 4), in the world


@dataclass
class Motions:
    """Of one robot, for all its cameras."""

    transforms: RecentTransforms = field(default_factory=RecentTransforms)
    _poses: dict[str, Recent] = field(default_factory=dict)  # by topic
    _drifts: dict[tuple[str, str], Stamped | None] = field(default_factory=dict)  # the newest that a SLAM corrects
    _jumps: deque[Jump] = field(default_factory=lambda: deque(maxlen=MOST_JUMPS))
    _faults: list[Fault] = field(default_factory=list)

    def follow(self, way: Way) -> None:
        """Take in what is needed for a way from a camera to the world."""
        if way.topic:
            self._poses.setdefault(way.topic, Recent())
        if way.drifting:
            self._drifts.setdefault((way.fixed, way.drifting), None)

    def take(self, topic: Topic, samples: Sequence[Stamped]) -> None:
        """Take the transforms or poses of a message."""
        for sample in samples:
            if topic.type in TF_TYPES:
                self._see_jump(sample)
                fault = self.transforms.add(sample, topic.taken_for == FIXED_TRANSFORMS)
            elif topic.name not in self._poses:
                return
            else:
                fault = self._poses[topic.name].add(sample) if sample.is_motion() else NOT_MOTION
            if fault:
                self._faults.append(Fault(f"messages of {topic.name}", fault))

    def faults(self) -> list[Fault]:
        """What could not be used since the last time."""
        faults, self._faults = self._faults, []
        return faults

    def jumps_until(self, stamp_ns: int) -> Iterator[Jump]:
        """Jumps up to a stamp, each once."""
        while self._jumps and self._jumps[0].stamp_ns <= stamp_ns:
            yield self._jumps.popleft()

    def known(self, way: Way, stamp_ns: int) -> bool:
        """Whether nothing can come any more that changes a pose at a stamp."""
        if way.topic:
            poses = self._poses[way.topic]
            if not (poses.samples and poses.newest_ns >= stamp_ns):
                return False
        until_ns = self.transforms.known_until_ns((way.camera, way.body), way.fixed)
        return not way.fixed if until_ns is None else until_ns >= stamp_ns

    def at(self, way: Way, stamp_ns: int, within_ns: int) -> np.ndarray:
        """world_from_camera (4, 4) at a stamp. Raises PoseError."""
        tree = self.transforms.tree(stamp_ns, (way.camera, way.fixed, way.body))
        return way.at(tree, self._poses.get(way.topic, Recent()).track(stamp_ns), stamp_ns, within_ns)

    def _see_jump(self, sample: Stamped) -> None:
        """See whether a transform that a SLAM corrects has jumped."""
        edge = sample.parent, sample.child
        if edge not in self._drifts or not sample.is_motion():
            return
        before, self._drifts[edge] = self._drifts[edge], sample
        if before is None or sample.stamp_ns <= before.stamp_ns:
            return
        moved = sample.matrix() @ inverse(before.matrix())
        shift_m = np.linalg.norm(np.subtract(sample.position_m, before.position_m))
        if shift_m > JUMP_M or np.degrees(rotation_angle_rad(moved)) > JUMP_DEG:
            self._jumps.append(Jump(sample.stamp_ns, moved))

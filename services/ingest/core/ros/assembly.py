"""Messages of a robot, as they come in, to posed frames: what `pairing` and `posing` do of a recording (pure).

A colour image waits until no depth image can come that is closer, and a pair until the transforms reach its stamp, but
not longer than PATIENCE_NS.
"""

from bisect import insort
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from prior_sg.services.geometry import inverse, rotation_angle_rad
from prior_sg.services.ingest.core.pairing import associate
from prior_sg.services.ingest.core.poses import PoseError
from prior_sg.services.ingest.core.ros.posing import Way
from prior_sg.services.ingest.core.ros.recent import NOT_MOTION, Recent, RecentTransforms
from prior_sg.services.ingest.core.ros.topics import FIXED_TRANSFORMS, TF_TYPES, Topic
from prior_sg.services.ingest.core.ros.transforms import Stamped

PATIENCE_NS = 1_200_000_000  # of a pair for its pose, by the time of arrival; longer than is interpolated over
WAITING = 64  # images of a stream that wait for a partner, pairs that wait for a pose
NEVER_NS = -(1 << 62)
BACK_NS = 1_000_000_000  # a stream whose stamp is farther back has begun anew
JUMP_M, JUMP_DEG = 0.05, 1.0  # more than this at once is no drift that is followed
CLOCK_BACK = "the clock of its topic went back"
NO_POSE, NO_DEPTH, NO_COLOR, TWICE = "no pose", "no depth image", "no colour image", "two images of one stamp"


@dataclass(frozen=True, order=True)
class Shot:
    """An image message, not yet decoded."""

    stamp_ns: int
    received_ns: int
    data: bytes = field(compare=False, repr=False)


@dataclass(frozen=True)
class Posed:
    """Two images that belong together, and where the camera was."""

    color: Shot
    depth: Shot
    source_from_camera: np.ndarray


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


class Assembly:
    """Of one camera."""

    def __init__(self, way: Way, within_ns: int) -> None:
        self.way, self.within_ns = way, within_ns
        self.transforms, self.poses = RecentTransforms(), Recent()
        self._colors: list[Shot] = []
        self._depths: list[Shot] = []
        self._newest_ns = [NEVER_NS, NEVER_NS]  # stamps of colour and depth
        self._pairs: deque[tuple[Shot, Shot]] = deque()
        self._faults: list[Fault] = []
        self._drift: Stamped | None = None  # the newest transform that a SLAM corrects
        self._jumps: deque[Jump] = deque()

    def color(self, shot: Shot) -> None:
        """Take a colour image."""
        self._image(0, self._colors, shot, NO_DEPTH)

    def depth(self, shot: Shot) -> None:
        """Take a depth image."""
        self._image(1, self._depths, shot, NO_COLOR)

    def motion(self, topic: Topic, samples: list[Stamped]) -> None:
        """Take the transforms or poses of a message."""
        if topic.type not in TF_TYPES and topic.name != self.way.topic:
            return
        for sample in samples:
            if topic.type in TF_TYPES:
                self._follow(sample)
                fault = self.transforms.add(sample, topic.taken_for == FIXED_TRANSFORMS)
            elif sample.is_motion():
                fault = self.poses.add(sample)
            else:
                fault = NOT_MOTION
            if fault:
                self._faults.append(Fault(f"messages of {topic.name}", fault))

    def faults(self) -> list[Fault]:
        """What could not be used since the last time."""
        faults, self._faults = self._faults, []
        return faults

    def ready(self, now_ns: int, ended: bool = False) -> Iterator[Posed | Jump]:
        """Frames that are complete, oldest first, each jump before the first frame after it; of a stream that has ended
        all that can be."""
        self._pair(ended)
        while self._pairs:
            color, depth = self._pairs[0]
            waited_ns = now_ns - max(color.received_ns, depth.received_ns)
            if not (ended or waited_ns > PATIENCE_NS or self._known(color.stamp_ns)):
                return
            self._pairs.popleft()
            frames = (self.way.camera, self.way.fixed, self.way.body)
            try:
                tree = self.transforms.tree(color.stamp_ns, frames)
                pose = self.way.at(tree, self.poses.track(color.stamp_ns), color.stamp_ns, self.within_ns)
            except PoseError as error:
                self._faults.append(Fault("frames", str(error), NO_POSE))
                continue
            while self._jumps and self._jumps[0].stamp_ns <= color.stamp_ns:
                yield self._jumps.popleft()
            yield Posed(color, depth, pose)

    def _follow(self, sample: Stamped) -> None:
        """See whether the transform that a SLAM corrects has jumped."""
        if (sample.parent, sample.child) != (self.way.fixed, self.way.drifting) or not sample.is_motion():
            return
        before, self._drift = self._drift, sample
        if before is None or sample.stamp_ns <= before.stamp_ns:
            return
        moved = sample.matrix() @ inverse(before.matrix())
        shift_m = np.linalg.norm(np.subtract(sample.position_m, before.position_m))
        if shift_m > JUMP_M or np.degrees(rotation_angle_rad(moved)) > JUMP_DEG:
            self._jumps.append(Jump(sample.stamp_ns, moved))

    def _known(self, stamp_ns: int) -> bool:
        """Whether nothing can come any more that changes the pose at a stamp."""
        if not self.way.fixed and not (self.poses.samples and self.poses.newest_ns >= stamp_ns):
            return False
        until_ns = self.transforms.known_until_ns((self.way.camera, self.way.body), self.way.fixed)
        return not self.way.fixed if until_ns is None else until_ns >= stamp_ns

    def _image(self, stream: int, waiting: list[Shot], shot: Shot, lacks: str) -> None:
        what = ("colour images", "depth images")[stream]
        if shot.stamp_ns < self._newest_ns[stream] - BACK_NS:
            said = f"{CLOCK_BACK} by {(self._newest_ns[stream] - shot.stamp_ns) / 1e9:.3f} s"
            self._faults.append(Fault(what, said, CLOCK_BACK))
            self._begin_anew()
        elif any(shot.stamp_ns == other.stamp_ns for other in waiting):
            self._faults.append(Fault(what, TWICE))
            return
        self._newest_ns[stream] = max(self._newest_ns[stream], shot.stamp_ns)
        insort(waiting, shot)
        while len(waiting) > WAITING:
            del waiting[0]
            self._faults.append(Fault(what, self._lacking(lacks), lacks))

    def _begin_anew(self) -> None:
        """Forget images of another time; frames whose pose is awaited stay."""
        self._colors.clear()
        self._depths.clear()
        self._newest_ns[:] = NEVER_NS, NEVER_NS

    def _pair(self, ended: bool) -> None:
        """Move colour images that have got the closest depth image, oldest first, and let go of those without."""
        newest_color_ns, newest_depth_ns = self._newest_ns
        stamps = [shot.stamp_ns for shot in self._colors], [shot.stamp_ns for shot in self._depths]
        partners = associate(*stamps, self.within_ns)
        used = 0
        for position, color in enumerate(self._colors):
            partner = partners.get(position)
            if partner is None:
                if not (ended or newest_depth_ns >= color.stamp_ns + self.within_ns):
                    break
                self._faults.append(Fault("colour images", self._lacking(NO_DEPTH), NO_DEPTH))
            else:
                depth = self._depths[partner]
                later_ns = max(color.stamp_ns, depth.stamp_ns) + self.within_ns
                closest = color.stamp_ns == depth.stamp_ns or min(newest_color_ns, newest_depth_ns) >= later_ns
                if not (ended or closest):
                    break
                self._queue(color, depth)
            used = position + 1
        self._let_go(used, {partners[position] for position in range(used) if position in partners}, ended)

    def _queue(self, color: Shot, depth: Shot) -> None:
        self._pairs.append((color, depth))
        if len(self._pairs) > WAITING:
            self._pairs.popleft()
            self._faults.append(Fault("frames", "transforms do not come in time", NO_POSE))

    def _let_go(self, colors: int, taken: set[int], ended: bool) -> None:
        """Of the first colour images, of depth images that are taken, and of those too old for any colour image."""
        del self._colors[:colors]
        oldest_ns = self._colors[0].stamp_ns if self._colors else self._newest_ns[0]
        kept = []
        for position, depth in enumerate(self._depths):
            if position in taken:
                continue
            if ended or depth.stamp_ns + self.within_ns <= oldest_ns:
                self._faults.append(Fault("depth images", self._lacking(NO_COLOR), NO_COLOR))
            else:
                kept.append(depth)
        self._depths[:] = kept

    def _lacking(self, lacks: str) -> str:
        return f"{lacks} lies within {self.within_ns / 1e6:g} ms of it"

"""Messages of a robot, as they come in, to posed frames: what `pairing` and `posing` do of a recording (pure).

A colour image waits until no depth image can come that is closer, and a pair until the transforms reach its stamp, but
not longer than PATIENCE_NS. Frames of several cameras wait as long for earlier ones of each other.
"""

from bisect import insort
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from prior_sg.services.ingest.core.pairing import associate
from prior_sg.services.ingest.core.poses import PoseError
from prior_sg.services.ingest.core.ros.motions import Fault, Jump, Motions
from prior_sg.services.ingest.core.ros.posing import Way

PATIENCE_NS = 1_200_000_000  # of a pair for its pose, by the time of arrival; longer than is interpolated over
WAITING = 64  # images of a stream that wait for a partner, pairs that wait for a pose
NEVER_NS = -(1 << 62)
BACK_NS = 1_000_000_000  # a stream whose stamp is farther back has begun anew
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
class Rules:
    """How images of one camera find each other and their pose."""

    way: Way
    within_ns: int  # between two images that belong together
    pose_within_ns: int  # between a pose and a stamp before the first or after the last
    cloud_way: Way | None = None  # of the lidar that gives depth; None = a camera's depth image
    sweep_ns: int = 0  # after the stamp of its cloud, until which it measures

    @staticmethod
    def of_images(way: Way, within_ns: int) -> "Rules":
        """Of an RGB-D camera."""
        return Rules(way, within_ns, within_ns)


class Assembly:
    """Of one camera."""

    def __init__(self, rules: Rules, motions: Motions) -> None:
        self.rules, self.motions, self.within_ns = rules, motions, rules.within_ns
        for way in filter(None, (rules.way, rules.cloud_way)):
            motions.follow(way)
        self._colors: list[Shot] = []
        self._depths: list[Shot] = []
        self._newest_ns = [NEVER_NS, NEVER_NS]  # stamps of colour and depth
        self._heard_ns: int | None = None  # when the newest image came
        self._pairs: deque[tuple[Shot, Shot]] = deque()
        self._faults: list[Fault] = []

    def color(self, shot: Shot) -> None:
        """Take a colour image."""
        self._image(0, self._colors, shot, NO_DEPTH)

    def depth(self, shot: Shot) -> None:
        """Take a depth image."""
        self._image(1, self._depths, shot, NO_COLOR)

    def cloud(self, shot: Shot) -> None:
        """Take a cloud of a lidar that has no camera."""
        if shot.stamp_ns < self._newest_ns[0] - BACK_NS:
            said = f"{CLOCK_BACK} by {(self._newest_ns[0] - shot.stamp_ns) / 1e9:.3f} s"
            self._faults.append(Fault("clouds", said, CLOCK_BACK))
            self._begin_anew()
        self._newest_ns[0] = max(self._newest_ns[0], shot.stamp_ns)
        self._heard_ns = shot.received_ns
        self._queue(shot, shot)

    def faults(self) -> list[Fault]:
        """What could not be used since the last time."""
        faults, self._faults = self._faults, []
        return faults

    def ready(self, now_ns: int, ended: bool = False) -> Iterator[Posed]:
        """Frames that are complete, oldest first; of a stream that has ended all that can be."""
        self._pair(ended)
        while self._pairs:
            color, depth = self._pairs[0]
            waited_ns = now_ns - max(color.received_ns, depth.received_ns)
            if not (ended or waited_ns > PATIENCE_NS or self._known(color, depth)):
                return
            self._pairs.popleft()
            try:
                pose = self.motions.at(self.rules.way, color.stamp_ns, self.rules.pose_within_ns)
            except PoseError as error:
                self._faults.append(Fault("frames", str(error), NO_POSE))
                continue
            yield Posed(color, depth, pose)

    def may_have_before(self, stamp_ns: int, now_ns: int, begun_ns: int) -> bool:
        """Whether a frame before a stamp can still come of it; of a camera that has fallen silent none does."""
        if now_ns - (begun_ns if self._heard_ns is None else self._heard_ns) > PATIENCE_NS:
            return False
        waiting = [color.stamp_ns for color, _ in self._pairs]
        waiting += [shot.stamp_ns for shot in self._colors]
        return min(waiting, default=self._newest_ns[0] + 1) < stamp_ns

    def _known(self, color: Shot, depth: Shot) -> bool:
        """Whether nothing can come any more that changes where the sensors were."""
        cloud_way, until_ns = self.rules.cloud_way, color.stamp_ns
        if cloud_way is None:
            return self.motions.known(self.rules.way, until_ns)
        until_ns = max(until_ns, depth.stamp_ns + self.rules.sweep_ns)
        return all(self.motions.known(way, until_ns) for way in (self.rules.way, cloud_way))

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
        self._heard_ns = shot.received_ns
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


class Together:
    """Frames of a robot's cameras, in the order of their stamps, and the jumps between them."""

    def __init__(self, motions: Motions) -> None:
        self.motions = motions
        self.cameras: list[Assembly] = []
        self._complete: list[deque[Posed]] = []
        self._begun_ns: int | None = None

    def add(self, rules: Rules) -> None:
        """A further camera."""
        self.cameras.append(Assembly(rules, self.motions))
        self._complete.append(deque())

    def faults(self) -> list[Fault]:
        """What could not be used since the last time."""
        return [*self.motions.faults(), *(fault for camera in self.cameras for fault in camera.faults())]

    def ready(self, now_ns: int, ended: bool = False) -> Iterator[tuple[int, Posed] | Jump]:
        """Frames with the position of their camera; each jump comes before the first frame after it."""
        self._begun_ns = now_ns if self._begun_ns is None else self._begun_ns
        for camera, complete in zip(self.cameras, self._complete, strict=True):
            complete.extend(camera.ready(now_ns, ended))
        while any(self._complete):
            heads = [(complete[0].color.stamp_ns, i) for i, complete in enumerate(self._complete) if complete]
            stamp_ns, first = min(heads)
            if not ended and self._is_early(first, stamp_ns, now_ns, self._begun_ns):
                return
            yield from self.motions.jumps_until(stamp_ns)
            yield first, self._complete[first].popleft()

    def _is_early(self, position: int, stamp_ns: int, now_ns: int, begun_ns: int) -> bool:
        """Whether another camera may still have a frame that goes first, and is worth waiting for."""
        complete = self._complete[position]
        if len(complete) > WAITING or now_ns - complete[0].color.received_ns > 2 * PATIENCE_NS:
            return False
        others = ((i, camera) for i, camera in enumerate(self.cameras) if i != position and not self._complete[i])
        return any(camera.may_have_before(stamp_ns + (i < position), now_ns, begun_ns) for i, camera in others)

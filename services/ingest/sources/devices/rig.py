"""An open camera and who says where it is: pictures wait until the poses reach their stamp, which are interpolated."""

import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from prior_sg.services.ingest.core.options import ReadOptions
from prior_sg.services.ingest.core.poses import PoseError
from prior_sg.services.ingest.core.ros.assembly import NO_POSE, PATIENCE_NS, Fault
from prior_sg.services.ingest.core.ros.recent import NOT_MOTION, Recent
from prior_sg.services.ingest.sources.base import SourceError
from prior_sg.services.ingest.sources.devices import oak, realsense
from prior_sg.services.ingest.sources.devices.device import Capture, Device
from prior_sg.services.ingest.sources.devices.feed import BEHIND, CAPTURES, MOMENT_S, CameraFeed
from prior_sg.services.ingest.sources.devices.poses import Poses, open_poses
from prior_sg.services.ingest.sources.ros.feed import Tally

OPENERS: dict[str, Callable[[str], Device]] = {realsense.SCHEME: realsense.open_camera, oak.SCHEME: oak.open_camera}
WAITING = 64  # pictures that wait for their pose


@dataclass(frozen=True)
class Posed:
    """A picture, and the pose that was said for its stamp."""

    capture: Capture
    source_from_body: np.ndarray  # (4, 4), as it is written


class Rig:
    """Both, open."""

    def __init__(self, source: str, options: ReadOptions) -> None:
        """Raises SourceError and ExtraMissing."""
        scheme = next(scheme for scheme in OPENERS if source.startswith(scheme))
        name = source.removeprefix(scheme)
        self.feed = CameraFeed(lambda: OPENERS[scheme](name))
        try:
            self.poses: Poses = open_poses(options)
        except BaseException:
            self.feed.close()
            raise
        self.tally, self.ended = Tally(), False
        self._recorded = scheme == realsense.SCHEME and name.endswith(realsense.RECORDINGS)
        self._offset_ns = round((options.stamp_offset_s or 0.0) * 1e9)
        self._within_ns = round(options.sync_tolerance_s * 1e9)
        self._recent, self._waiting = Recent(), deque[Capture]()
        self._back: list[Posed] = []

    def ready(self) -> Iterator[Posed]:
        """Frames that are complete, after a moment's waiting, oldest first."""
        back, self._back = self._back, []
        yield from back
        captures, faults, ended = self.feed.take(MOMENT_S)
        for fault, count in faults.items():
            self.tally.add(fault, count)
        self._waiting.extend(captures)
        while len(self._waiting) > WAITING:
            self._waiting.popleft()
            self.tally.add(Fault(CAPTURES, BEHIND))
        self._listen()
        while self._waiting and (ended or self._settled(self._waiting[0])):
            capture = self._waiting.popleft()
            try:
                pose = self._recent.track(capture.stamp_ns).at(capture.stamp_ns, self._within_ns)
            except PoseError as error:
                self.tally.add(Fault("frames", str(error), NO_POSE))
                continue
            yield Posed(capture, pose)
        self.ended = ended

    def give_back(self, posed: list[Posed]) -> None:
        """Frames that come once more, also where nothing else does any more."""
        self._back, self.ended = posed, False

    def close(self) -> None:
        """Let go of both."""
        self.feed.close()
        self.poses.close()

    def _listen(self) -> None:
        """Take in poses; of a recording, whose poses may all be there already, no more than are needed."""
        until_ns = None
        if self._recorded:
            if not self._waiting or self._known(self._waiting[-1]):
                return
            until_ns = self._waiting[-1].stamp_ns - self._offset_ns
        for one in self.poses.read(until_ns):
            if isinstance(one, Fault):
                self.tally.add(one)
            elif not one.is_motion():
                self.tally.add(Fault("poses", NOT_MOTION))
            elif fault := self._recent.add(replace(one, stamp_ns=one.stamp_ns + self._offset_ns)):
                self.tally.add(Fault("poses", fault))

    def _known(self, capture: Capture) -> bool:
        return bool(self._recent.samples) and self._recent.newest_ns >= capture.stamp_ns

    def _settled(self, capture: Capture) -> bool:
        """Whether nothing can come any more that changes its pose, or it has waited long enough."""
        return self._known(capture) or time.time_ns() - capture.received_ns > PATIENCE_NS


def words(rig: Rig) -> str:
    """What could not be used so far, in one phrase."""
    return "; ".join(f"{word.what}: {word.example}" for word in rig.tally.words(ended=True))


def first(rig: Rig, source: str, wanted: int, seconds: float) -> list[Posed]:
    """The first frames that are complete, which come again. Raises SourceError when there are none in time."""
    end_s, found = time.monotonic() + seconds, list[Posed]()
    while len(found) < wanted and not rig.ended and time.monotonic() < end_s:
        found += rig.ready()
    if not found:
        said = words(rig) or "it gives no pictures"
        raise SourceError(
            f"{source}: no picture has got a pose within {seconds:g} s ({rig.poses.said}; {said}); poses need stamps "
            "of the pictures' clock, --stamp-offset moves them"
        )
    rig.give_back(found)
    return found[:wanted]

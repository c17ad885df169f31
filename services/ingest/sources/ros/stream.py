"""What a running robot sends from now on, as frames."""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import msgspec
import numpy as np

from prior_sg.services.ingest.core.frames import BadFrame, Closure, Correction, RawFrame, View
from prior_sg.services.ingest.core.pairing import risen
from prior_sg.services.ingest.core.poses import PoseError
from prior_sg.services.ingest.core.ros.assembly import Posed, Together
from prior_sg.services.ingest.core.ros.motions import Fault, Jump, Motions
from prior_sg.services.ingest.core.ros.topics import CAMERA_INFO, COMPRESSED, IMAGE
from prior_sg.services.ingest.core.ros.transforms import transforms_of
from prior_sg.services.ingest.sources.base import Event, Images, SourceError
from prior_sg.services.ingest.sources.clouds.live import Shower, Shown
from prior_sg.services.ingest.sources.normaliser import UNUSABLE
from prior_sg.services.ingest.sources.ros.eyes import Eye, Robot
from prior_sg.services.ingest.sources.ros.feed import Feed, Tally
from prior_sg.services.ingest.sources.ros.look import MOMENT_S
from prior_sg.services.ingest.sources.ros.reader import Reader, robot_types
from prior_sg.services.runtime.ros.session import Received, RosSession
from prior_sg.services.runtime.ros.wire import PUBLISHER, Entity, WireError

log = logging.getLogger(__name__)
NEARLY = 0.01  # metres, and about half a degree: less is no correction
NO_IMAGES = Images(b"", b"")
MOST_FRAMES = 65536  # that a graph of optimised poses can correct: 3.6 hours at least
TRAIL_NS = 200_000_000  # between two of them, but for those that may become keyframes
CAMERA_TYPES = (IMAGE, COMPRESSED, CAMERA_INFO)
CLOSE_S = 2.0
LOOK_AGAIN_S, LOOK_MOST_S = 10.0, 300.0  # between two looks at topics that are announced and silent


@dataclass(frozen=True)
class Placed:
    """A frame by the pose of the robot's body, and how its own follows from that of its camera."""

    view: View
    eye: Eye
    placed: Callable[[np.ndarray], np.ndarray]


class Stream:
    """The frames of a robot, once, until it falls silent or the source is closed."""

    def __init__(  # noqa: PLR0917
        self,
        robot: Robot,
        wanted: Callable[[View], bool],
        stop: threading.Event,
        clock_ns: Callable[[], int] = time.time_ns,
        open_session: Callable[[], RosSession] | None = None,
        again: Callable[[], Robot] | None = None,
    ) -> None:
        """`again` looks at the robot anew, for cameras that have come since."""
        self._robot, self._wanted, self._stop, self._clock_ns = robot, wanted, stop, clock_ns
        self._open_session, self._again = open_session, again
        self._types, self._tally, self._frames = robot_types(), Tally(), 0
        self._newest_ns: int | None = None  # stamp of a frame, where there are several cameras
        self._trail: deque[Placed] = deque(maxlen=MOST_FRAMES)
        self._told: tuple[np.ndarray, np.ndarray] | None = None  # numbers and poses of the last correction
        self._reader = Reader(self._types, robot.options, {topic.name: topic for topic in robot.topics})
        self._motions = Motions()
        self._together = Together(self._motions)
        self._eyes: list[Eye] = []
        self._showers: list[Shower] = []
        for eye in robot.eyes:
            self._add(eye)

    def events(self) -> Iterator[Event]:
        """Until nothing has come for a while, or the source is closed. Raises BusError."""
        assert self._open_session is not None
        feed, quiet_s = Feed(), self._robot.options.end_after_s
        with self._open_session() as session:
            for topic in self._robot.topics:
                feed.open(session, topic, self._types)
            newcomers = Newcomers(self._robot, session, self._again) if self._robot.options.cameras else None
            heard_s = time.monotonic()
            while not self._stop.is_set() and not 0 < quiet_s < time.monotonic() - heard_s:
                frames = self._frames
                yield from self.take(*feed.take(MOMENT_S))
                heard_s = time.monotonic() if self._frames > frames else heard_s
                if newcomers is not None and (found := newcomers.found()) is not None:
                    self._welcome(found, session, feed)
            yield from self.rest()
            if newcomers is not None:
                newcomers.close()

    def take(self, messages: list[Received], faults: list[Fault]) -> Iterator[Event]:
        """What comes of messages, and words on what could not be used."""
        graph = self._robot.graph
        for message in messages:
            if graph is not None and message.topic == graph.name:
                yield from self._optimised(message)
                continue
            fault = self._reader.move(message, self._motions)
            faults += [fault] if fault is not None else []
            for eye, assembly in zip(self._eyes, self._together.cameras, strict=True):
                fault = self._reader.hand_over(message, eye.choice, assembly)
                faults += [fault] if fault is not None else []
        for fault in faults:
            self._tally.add(fault)
        yield from self._complete(ended=False)

    def rest(self) -> Iterator[Event]:
        """What can still be made of what waits."""
        yield from self._complete(ended=True)

    def _add(self, eye: Eye) -> None:
        self._eyes.append(eye)
        self._together.add(eye.rules)
        self._showers.append(eye.begin(self._motions))

    def _welcome(self, robot: Robot, session: RosSession, feed: Feed) -> None:
        """Read the cameras that have come."""
        known = {eye.name for eye in self._eyes}
        for eye in robot.eyes:
            if eye.name not in known:
                log.info("a camera has come", extra={"camera": eye.name, "notes": list(eye.notes)})
                self._add(eye)
        for topic in robot.topics:
            if topic.name not in self._reader.topics:
                self._reader.topics[topic.name] = topic
                feed.open(session, topic, self._types)

    def _complete(self, ended: bool) -> Iterator[Event]:
        """Frames and jumps that are complete, then words on what was of no use."""
        for one in self._together.ready(self._clock_ns(), ended):
            if isinstance(one, Jump):
                if self._robot.graph is None:
                    yield self._closure(one)
                continue
            position, posed = one
            yield from self._shown(self._eyes[position], self._showers[position], posed)
        for fault in self._together.faults():
            self._tally.add(fault)
        yield from self._tally.words(ended)

    def _shown(self, eye: Eye, shower: Shower, posed: Posed) -> Iterator[RawFrame | BadFrame]:
        try:
            shown = list(shower(posed))
        except UNUSABLE as error:
            yield BadFrame(frame_id=self._frames, reason=str(error), index=self._frames, total=0)
            self._frames += 1
            return
        for one in shown:
            yield self._frame(eye, one)

    def _frame(self, eye: Eye, shown: Shown) -> RawFrame | BadFrame:
        """A frame, its images only where it may become a keyframe."""
        number, stamp_ns = self._frames, shown.stamp_ns
        if len(self._eyes) > 1:
            stamp_ns = self._newest_ns = risen(stamp_ns, self._newest_ns)
        self._frames += 1
        try:
            pose = shown.placed(shown.source_from_sensor)
            wanted = self._wanted(View(number, stamp_ns, eye.normaliser.pose(pose), eye.name))
            self._remember(eye, shown, number, wanted)
            if wanted:
                return eye.normaliser.frame(number, 0, number, stamp_ns, pose, shown.images())
            bare = eye.normaliser.bare(number, 0, number, stamp_ns, pose, NO_IMAGES)
            return msgspec.structs.replace(bare, pose_only=True)
        except UNUSABLE as error:
            return BadFrame(frame_id=number, reason=str(error), index=number, total=0)

    def _remember(self, eye: Eye, shown: Shown, number: int, wanted: bool) -> None:
        """Keep where a frame was, for the graph that corrects it."""
        if self._robot.graph is None:
            return
        if wanted or not self._trail or shown.stamp_ns - self._trail[-1].view.stamp_ns >= TRAIL_NS:
            body = shown.source_from_sensor @ np.linalg.inv(eye.body_from_camera)
            self._trail.append(Placed(View(number, shown.stamp_ns, body, eye.name), eye, shown.placed))

    def _optimised(self, message: Received) -> Iterator[Correction]:
        """What a graph of optimised poses says of the frames so far, unless that is what was said before."""
        from prior_sg.services.ingest.core.ros.graph import corrected  # takes SciPy: few robots publish such a graph

        graph, trail = self._robot.graph, list(self._trail)
        assert graph is not None
        try:
            path = self._types.decode(message.payload, graph.type)
            nodes = [replace(node, child="") for pose in path.poses for node in transforms_of(pose)]
            within_ns = round(self._robot.options.sync_tolerance_s * 1e9)
            bodies = corrected([one.view for one in trail], nodes, within_ns)
            poses = np.stack([one.placed(b @ one.eye.body_from_camera) for one, b in zip(trail, bodies, strict=True)])
        except (WireError, PoseError) as error:
            self._tally.add(Fault(f"messages of {graph.name}", str(error)))
            return
        ids = np.array([one.view.frame_id for one in trail], np.int64)
        if self._told is not None and _same_poses(*self._told, ids, poses):
            return
        self._told = ids, poses
        world_from_camera = self._robot.normaliser.pose(poses)
        yield Correction(stamp_ns=trail[-1].view.stamp_ns, frame_ids=ids, world_from_camera=world_from_camera)

    def _closure(self, jump: Jump) -> Closure:
        """A jump in the world of the frames rather than of the robot."""
        world = self._robot.normaliser.world_from_source
        moved = jump.after_from_before if world is None else world @ jump.after_from_before @ np.linalg.inv(world)
        return Closure(stamp_ns=jump.stamp_ns, after_from_before=moved)


def _same_poses(ids: np.ndarray, poses: np.ndarray, new_ids: np.ndarray, new_poses: np.ndarray) -> bool:
    """Whether the frames of both have the same poses; each side's numbers (n,) rise."""
    _, before, after = np.intersect1d(ids, new_ids, assume_unique=True, return_indices=True)
    return bool(np.allclose(poses[before], new_poses[after], atol=NEARLY))


class Newcomers:
    """Cameras that come after the start: when topics of a camera publish that did not, the robot is looked at again."""

    def __init__(self, robot: Robot, session: RosSession, again: Callable[[], Robot] | None) -> None:
        self._known, self._again = set(robot.heard), again
        self._lock = threading.Lock()
        self._there: set[str] = set()
        self._looked_at: set[str] = set()  # new names, when the robot was last looked at
        self._pause_s = LOOK_AGAIN_S
        self._found: list[Robot] = []
        self._search: threading.Thread | None = None
        self._searched_s = -LOOK_AGAIN_S
        session.watch(self._seen)

    def found(self) -> Robot | None:
        """The robot with what has come, once it was looked at; looks where there is something new."""
        if self._search is None:
            if self._again is not None and self._is_time(time.monotonic()):
                self._search = threading.Thread(target=self._look, args=(self._again,), daemon=True)
                self._search.start()
            return None
        if self._search.is_alive():
            return None
        self._search = None
        robot = self._found.pop() if self._found else None
        if robot is not None:
            self._known |= robot.heard
        return robot

    def _is_time(self, now_s: float) -> bool:
        """Whether there is something new; what stays silent is looked at less and less often."""
        with self._lock:
            new = self._there - self._known
        if not new or now_s - self._searched_s < (self._pause_s if new == self._looked_at else LOOK_AGAIN_S):
            return False
        self._pause_s = min(2 * self._pause_s, LOOK_MOST_S) if new == self._looked_at else LOOK_AGAIN_S
        self._looked_at, self._searched_s = new, now_s
        return True

    def close(self) -> None:
        """Wait for the look that goes on; the source that was closed has ended it."""
        if self._search is not None:
            self._search.join(CLOSE_S)

    def _seen(self, entity: Entity, alive: bool) -> None:
        channel = entity.channel
        if alive and entity.kind == PUBLISHER and channel is not None and channel.type in CAMERA_TYPES:
            with self._lock:
                self._there.add(channel.name)

    def _look(self, again: Callable[[], Robot]) -> None:
        try:
            self._found.append(again())
        except SourceError as error:
            log.info("what has come is no camera yet", extra={"why": str(error)})

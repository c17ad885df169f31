"""A running robot: ROS 2 over rmw_zenoh, heard through its Zenoh router, without ROS.

ros2:/                    the router on this host (tcp/127.0.0.1:7447, where rmw_zenohd listens)
ros2:/tcp/HOST:PORT       another one; --domain is the ROS_DOMAIN_ID

Topics, cameras, pairs and poses are those of recordings (ros.py). What comes late waits for the rest of its frame up to
a second; what cannot be used is counted by reason. Images are decoded only of frames that may become keyframes. A jump
of the frame below the world (`odom` in `map`) moves the keyframes before it. The source ends --end-after seconds after
its last frame.
"""

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np

from prior_sg.services.ingest.core.config import Config
from prior_sg.services.ingest.core.due import Due
from prior_sg.services.ingest.core.frames import BadFrame, Closure, Correction, RawFrame, View
from prior_sg.services.ingest.core.options import ROBOT, ReadOptions
from prior_sg.services.ingest.core.poses import Convention, PoseError
from prior_sg.services.ingest.core.ros.assembly import Assembly, Fault, Jump, Posed
from prior_sg.services.ingest.core.ros.graph import corrected
from prior_sg.services.ingest.core.ros.posing import Way, way_of
from prior_sg.services.ingest.core.ros.recent import RecentTransforms
from prior_sg.services.ingest.core.ros.topics import (
    FIXED_TRANSFORMS,
    NAMED,
    TF_TYPES,
    Chosen,
    Topic,
    chosen,
    graph_topic,
    pose_topics,
)
from prior_sg.services.ingest.core.ros.transforms import Stamped, transforms_of
from prior_sg.services.ingest.sources.base import MILLIMETRE, Event, Found, FrameError, Images, Source, SourceError
from prior_sg.services.ingest.sources.normalise import UNUSABLE, Normaliser, prepare
from prior_sg.services.ingest.sources.ros.feed import Feed, Tally
from prior_sg.services.ingest.sources.ros.look import Look
from prior_sg.services.ingest.sources.ros.pictures import Pictures, Rig, pictures
from prior_sg.services.ingest.sources.ros.reader import Reader
from prior_sg.services.runtime.bus import BusError
from prior_sg.services.runtime.ros.session import ENDPOINT, Received, RosSession
from prior_sg.services.runtime.ros.types import Types, shared_types
from prior_sg.services.runtime.ros.wire import WireError

NAME = "ros2"
NODE = "prior_sg_ingest"
LOOK_S, MOMENT_S = 8.0, 0.1
SAMPLES = 3
NEARLY = 0.01  # metres, and about half a degree: less is no correction
NO_IMAGES = Images(b"", b"")


@dataclass(frozen=True)
class Robot:
    """What is read of a running robot, and how."""

    endpoint: str
    domain: int
    options: ReadOptions
    choice: Chosen
    way: Way
    topics: tuple[Topic, ...]  # all that is listened to
    pictures: Pictures
    normaliser: Normaliser
    convention: Convention
    notes: tuple[str, ...]
    graph: Topic | None  # of optimised poses
    body_from_camera: np.ndarray  # of the frame whose poses these are

    def open(self) -> RosSession:
        """A node. Raises BusError."""
        return RosSession(self.endpoint, NODE, self.domain)


def endpoint_of(source: str) -> str:
    """The router that an address such as ros2:/tcp/HOST:PORT names."""
    return source.removeprefix(ROBOT).strip("/") or ENDPOINT


def load(path: Path, options: ReadOptions) -> Source:
    """A running robot as a source. Raises SourceError, and ExtraMissing where rosbags is not installed."""
    if options.quaternion:
        raise SourceError("messages of ROS name the parts of a quaternion: leave out --quaternion")
    if options.rate_hz:
        raise SourceError("a running robot has stamps: leave out --rate")
    robot = _found(path, options)
    stop = threading.Event()

    def stream(wanted: Callable[[View], bool]) -> "Stream":
        return Stream(robot, wanted, stop)

    def frames() -> Iterator[RawFrame | BadFrame]:
        events = stream(lambda view: True).events()
        return (event for event in events if isinstance(event, RawFrame | BadFrame))

    return Source(
        layout=NAME,
        path=path,
        intrinsics=robot.normaliser.intrinsics,
        total=0,
        frames=frames,
        live=lambda: stream(Due(options) if isinstance(options, Config) else lambda view: True).events(),
        close=stop.set,
        why=(f"a robot is heard on {robot.endpoint}, domain {robot.domain}",),
        notes=robot.notes,
        origin_m=robot.normaliser.origin_m,
        convention=robot.convention,
        depth_unit_m=robot.normaliser.depth.unit_m,
        world_from_source=robot.normaliser.world_from_source,
    )


def heard(source: str, domain: int, seconds: float) -> list[Topic]:
    """Topics of a running robot that could serve, by name. Raises SourceError."""
    try:
        with RosSession(endpoint_of(source), NODE, domain) as session:
            look = Look(session, shared_types())
            end_s = time.monotonic() + seconds
            while (left_s := end_s - time.monotonic()) > 0:
                look.listen(min(left_s, MOMENT_S))
            return look.topics()
    except (BusError, WireError) as error:
        raise SourceError(f"{source}: {error}") from error


def _found(path: Path, options: ReadOptions) -> Robot:
    """The robot, once enough was heard of it. Raises SourceError."""
    endpoint, types = endpoint_of(str(path)), shared_types()
    try:
        with RosSession(endpoint, NODE, options.ros_domain) as session:
            look = Look(session, types)
            end_s = time.monotonic() + LOOK_S
            while True:
                look.listen(MOMENT_S)
                late = time.monotonic() > end_s
                if look.settled or late:
                    try:
                        return robot_of(look, types, path, options)
                    except (SourceError, WireError, *UNUSABLE) as error:
                        if late:
                            raise SourceError(_what_is_there(path, look, options, str(error))) from error
    except (BusError, WireError) as error:
        raise SourceError(f"{path}: {error}") from error


def _what_is_there(path: Path, look: Look, options: ReadOptions, said: str) -> str:
    """Why a robot cannot be read, with what is known of it."""
    said = said.removeprefix(f"{path}: ")
    names = [topic.name for topic in look.topics()]
    there = f"heard are {', '.join(names[:NAMED])}" if names else f"nobody publishes on domain {options.ros_domain}"
    faults = "".join(f"; {word.what}: {word.example}" for word in look.tally.words(ended=True))
    return f"{path}: {said} ({there}{faults})"


def robot_of(look: Look, types: Types, path: Path, options: ReadOptions) -> Robot:
    """What is to be read, of what was heard. Raises SourceError, WireError and UNUSABLE, each with one sentence."""
    topics = look.topics()
    try:
        choice, posing, graph = chosen(topics, options), pose_topics(topics, options), graph_topic(topics, options)
    except ValueError as error:
        raise SourceError(f"{path}: {error}") from error
    by_name = {topic.name: topic for topic in topics}
    reader = Reader(types, options, by_name)
    within_ns = round(options.sync_tolerance_s * 1e9)
    messages = look.messages()
    colors = [reader.shot(message) for message in messages if message.topic == choice.color.name]
    if not any(shot.stamp_ns for shot in colors):
        raise SourceError(f"the headers of {choice.color.name} have no stamps; give --clock received")
    stamp_ns = colors[len(colors) // 2].stamp_ns
    transforms, poses = _motions(messages, reader, by_name)
    tree = transforms.tree(stamp_ns, transforms.frames)
    way = way_of(choice.color.frame, tree, options, posing, poses)
    camera_frame = choice.color.frame
    camera, images, how = pictures(Rig(path, choice, options, look.infos(), tree, stamp_ns, within_ns))
    listened = (*_listened(topics, choice, way), *([graph] if graph else []))
    convention = Convention().changed(options)
    assembly = Assembly(way, within_ns)
    for message in messages:
        reader.hand_over(message, choice, assembly)
    posed = [one for one in assembly.ready(0, ended=True) if isinstance(one, Posed)][-SAMPLES:]
    if not posed:
        reasons = dict.fromkeys(fault.text for fault in assembly.faults()) or ["none came"]
        raise SourceError(f"no frame is complete: {'; '.join(list(reasons)[:2])}")
    samples = [(convention.of_matrix(one.source_from_camera), reader.images(one, choice, images)) for one in posed]
    found = Found(NAME, path, camera, MILLIMETRE, (), convention=convention)
    normaliser, notes = prepare(found, options, samples)
    others = f"further images are not read: {', '.join(choice.others[:NAMED])}" if choice.others else ""
    notes = tuple(filter(None, (f"{choice.said()}, {way.said}", others, how, *notes)))
    body = options.pose_frame or camera_frame
    body_from_camera = tree.at(body, camera_frame, stamp_ns, within_ns) if graph else np.eye(4)
    return Robot(
        endpoint=endpoint_of(str(path)),
        domain=options.ros_domain,
        options=options,
        choice=choice,
        way=way,
        topics=listened,
        pictures=images,
        normaliser=normaliser,
        convention=convention,
        notes=notes,
        graph=graph,
        body_from_camera=body_from_camera,
    )


def _motions(
    messages: list[Received], reader: "Reader", topics: dict[str, Topic]
) -> tuple[RecentTransforms, dict[str, list[Stamped]]]:
    """Transforms, and poses by topic, of what was heard; what cannot be read is told when it comes again."""
    transforms, poses = RecentTransforms(), dict[str, list[Stamped]]()
    for message in messages:
        topic = topics[message.topic]
        if not reader.moves(topic):
            continue
        try:
            samples = reader.motions(message)
        except (WireError, FrameError):
            continue
        for sample in samples:
            if topic.type in TF_TYPES:
                transforms.add(sample, topic.taken_for == FIXED_TRANSFORMS)
            else:
                poses.setdefault(topic.name, []).append(sample)
    return transforms, poses


def _listened(topics: list[Topic], choice: Chosen, way: Way) -> tuple[Topic, ...]:
    """Those that the frames need."""
    names = {choice.color.name, choice.depth.name, way.topic}
    return tuple(topic for topic in topics if topic.name in names or topic.type in TF_TYPES)


class Stream:
    """What a robot sends from now on."""

    def __init__(
        self,
        robot: Robot,
        wanted: Callable[[View], bool],
        stop: threading.Event,
        clock_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self._robot, self._wanted, self._stop, self._clock_ns = robot, wanted, stop, clock_ns
        self._types, self._tally, self._frames = shared_types(), Tally(), 0
        self._trail: list[View] = []  # all frames, as they were posed
        self._told: np.ndarray | None = None  # the poses of the last correction
        by_name = {topic.name: topic for topic in robot.topics}
        self._reader = Reader(self._types, robot.options, by_name)
        self._camera_from_body = np.linalg.inv(robot.body_from_camera)
        self._assembly = Assembly(robot.way, round(robot.options.sync_tolerance_s * 1e9))

    def events(self) -> Iterator[Event]:
        """Until nothing has come for a while, or the source is closed. Raises BusError."""
        feed, quiet_s = Feed(), self._robot.options.end_after_s
        with self._robot.open() as session:
            for topic in self._robot.topics:
                feed.open(session, topic, self._types)
            heard_s = time.monotonic()
            while not self._stop.is_set() and not 0 < quiet_s < time.monotonic() - heard_s:
                frames = self._frames
                yield from self.take(*feed.take(MOMENT_S))
                heard_s = time.monotonic() if self._frames > frames else heard_s
            yield from self.rest()

    def take(self, messages: list[Received], faults: list[Fault]) -> Iterator[Event]:
        """What comes of messages, and words on what could not be used."""
        for message in messages:
            if self._robot.graph is not None and message.topic == self._robot.graph.name:
                yield from self._optimised(message)
                continue
            fault = self._reader.hand_over(message, self._robot.choice, self._assembly)
            faults += [fault] if fault is not None else []
        for fault in faults:
            self._tally.add(fault)
        yield from self._complete(ended=False)

    def rest(self) -> Iterator[Event]:
        """What can still be made of what waits."""
        yield from self._complete(ended=True)

    def _complete(self, ended: bool) -> Iterator[Event]:
        """Frames and jumps that are complete, then words on what was of no use."""
        for one in self._assembly.ready(self._clock_ns(), ended):
            if isinstance(one, Posed):
                yield self._frame(one)
            elif self._robot.graph is None:
                yield self._closure(one)
        for fault in self._assembly.faults():
            self._tally.add(fault)
        yield from self._tally.words(ended)

    def _frame(self, posed: Posed) -> RawFrame | BadFrame:
        """A frame, its images only where it may become a keyframe."""
        robot, number = self._robot, self._frames
        self._frames += 1
        try:
            pose = robot.convention.of_matrix(posed.source_from_camera)
            stamp_ns = posed.color.stamp_ns
            if robot.graph is not None:
                self._trail.append(View(number, stamp_ns, posed.source_from_camera))
            if not self._wanted(View(number, stamp_ns, robot.normaliser.pose(pose))):
                bare = robot.normaliser.bare(number, 0, number, stamp_ns, pose, NO_IMAGES)
                return msgspec.structs.replace(bare, pose_only=True)
            images = self._reader.images(posed, robot.choice, robot.pictures)
            return robot.normaliser.frame(number, 0, number, stamp_ns, pose, images)
        except UNUSABLE as error:
            return BadFrame(frame_id=number, reason=str(error), index=number, total=0)

    def _optimised(self, message: Received) -> Iterator[Correction]:
        """What a graph of optimised poses says of the frames so far, unless that is what was said before."""
        robot, trail = self._robot, self._trail
        assert robot.graph is not None
        try:
            path = self._types.decode(message.payload, robot.graph.type)
            nodes = [replace(node, child="") for pose in path.poses for node in transforms_of(pose)]
            within_ns = round(robot.options.sync_tolerance_s * 1e9)
            body_trail = [replace(v, world_from_camera=v.world_from_camera @ self._camera_from_body) for v in trail]
            bodies = corrected(body_trail, nodes, within_ns)
        except (WireError, PoseError) as error:
            self._tally.add(Fault(f"messages of {robot.graph.name}", str(error)))
            return
        poses = np.stack([robot.convention.of_matrix(body @ robot.body_from_camera) for body in bodies])
        if self._told is not None and np.allclose(poses[: len(self._told)], self._told, atol=NEARLY):
            return
        self._told = poses
        ids = np.array([view.frame_id for view in trail], np.int64)
        yield Correction(stamp_ns=trail[-1].stamp_ns, frame_ids=ids, world_from_camera=robot.normaliser.pose(poses))

    def _closure(self, jump: Jump) -> Closure:
        """A jump in the world of the frames rather than of the robot."""
        world = self._robot.normaliser.world_from_source
        moved = jump.after_from_before if world is None else world @ jump.after_from_before @ np.linalg.inv(world)
        return Closure(stamp_ns=jump.stamp_ns, after_from_before=moved)

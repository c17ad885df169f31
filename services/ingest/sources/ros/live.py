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
from pathlib import Path

from prior_sg.services.ingest.core.config import Config
from prior_sg.services.ingest.core.due import Due
from prior_sg.services.ingest.core.frames import BadFrame, RawFrame, View
from prior_sg.services.ingest.core.options import ROBOT, ReadOptions
from prior_sg.services.ingest.core.ros.topics import NAMED, Topic
from prior_sg.services.ingest.sources.base import Source, SourceError
from prior_sg.services.ingest.sources.normaliser import UNUSABLE, Normaliser
from prior_sg.services.ingest.sources.ros.eyes import NAME, Robot, robot_of
from prior_sg.services.ingest.sources.ros.look import MOMENT_S, Look
from prior_sg.services.ingest.sources.ros.reader import robot_types
from prior_sg.services.ingest.sources.ros.stream import Stream
from prior_sg.services.ingest.sources.tables import LastingError
from prior_sg.services.runtime.bus import BusError
from prior_sg.services.runtime.endpoints import check_endpoint, secured
from prior_sg.services.runtime.keys import bundle_in_force
from prior_sg.services.runtime.ros.session import ENDPOINT, RosSession
from prior_sg.services.runtime.ros.wire import WireError, check_domain

NODE = "prior_sg_ingest"
LOOK_S = 8.0


def endpoint_of(source: str) -> str:
    """The router that an address such as ros2:/tcp/HOST:PORT names."""
    return source.removeprefix(ROBOT).strip("/") or ENDPOINT


def load(path: Path, options: ReadOptions) -> Source:
    """A running robot as a source. Raises SourceError, and ExtraMissing where rosbags is not installed."""
    _check(path, options)
    robot = _found(path, options, threading.Event())
    stop = threading.Event()

    def stream(wanted: Callable[[View], bool]) -> Stream:
        return Stream(robot, wanted, stop, open_session=lambda: _open(path, options), again=again)

    def again() -> Robot:
        return _found(path, options, stop, robot.normaliser)

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
        why=(f"a robot is heard on {endpoint_of(str(path))}, domain {options.ros_domain}",),
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
            look = Look(session, robot_types())
            end_s = time.monotonic() + seconds
            while (left_s := end_s - time.monotonic()) > 0:
                look.listen(min(left_s, MOMENT_S))
            return look.topics()
    except (BusError, WireError) as error:
        raise SourceError(f"{source}: {error}") from error


def _check(path: Path, options: ReadOptions) -> None:
    """That what was told can be meant, whatever robot there is. Raises LastingError."""
    if options.quaternion:
        raise LastingError("messages of ROS name the parts of a quaternion: leave out --quaternion")
    if options.rate_hz:
        raise LastingError("a running robot has stamps: leave out --rate")
    endpoint = endpoint_of(str(path))
    try:
        check_domain(options.ros_domain)
        check_endpoint(endpoint)
        if secured(endpoint):
            bundle_in_force()
    except (BusError, WireError) as error:
        raise LastingError(f"{path}: {error}") from error


def _open(path: Path, options: ReadOptions) -> RosSession:
    """A node. Raises BusError."""
    return RosSession(endpoint_of(str(path)), NODE, options.ros_domain)


def _found(path: Path, options: ReadOptions, stop: threading.Event, first: Normaliser | None = None) -> Robot:
    """The robot, once enough was heard of it. Raises SourceError."""
    types = robot_types()
    try:
        with _open(path, options) as session:
            look = Look(session, types)
            end_s = time.monotonic() + LOOK_S
            while not stop.is_set():
                look.listen(MOMENT_S)
                late = time.monotonic() > end_s
                if look.settled or late:
                    try:
                        return robot_of(look, types, path, options, first)
                    except (SourceError, WireError, *UNUSABLE) as error:
                        if late:
                            kind = LastingError if isinstance(error, LastingError) else SourceError
                            raise kind(_what_is_there(path, look, options, str(error))) from error
    except (BusError, WireError) as error:
        raise SourceError(f"{path}: {error}") from error
    raise SourceError(f"{path} is no longer looked for")


def _what_is_there(path: Path, look: Look, options: ReadOptions, said: str) -> str:
    """Why a robot cannot be read, with what is known of it."""
    said = said.removeprefix(f"{path}: ")
    names = [topic.name for topic in look.topics()]
    there = f"heard are {', '.join(names[:NAMED])}" if names else f"nobody publishes on domain {options.ros_domain}"
    faults = "".join(f"; {word.what}: {word.example}" for word in look.tally.words(ended=True))
    return f"{path}: {said} ({there}{faults})"

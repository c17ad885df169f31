"""Where a camera is, said by somebody else: lines appended to a file or written into a FIFO, or a topic of ROS."""

import os
import stat
import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Protocol

from prior_sg.services.ingest.core.options import ReadOptions, is_robot
from prior_sg.services.ingest.core.pose_rows import row_of
from prior_sg.services.ingest.core.ros.assembly import Fault
from prior_sg.services.ingest.core.ros.topics import NAMED, POSES, Topic, pose_topics
from prior_sg.services.ingest.core.ros.transforms import Stamped, transforms_of
from prior_sg.services.ingest.sources.base import SourceError
from prior_sg.services.ingest.sources.ros.feed import Feed
from prior_sg.services.ingest.sources.ros.live import endpoint_of
from prior_sg.services.runtime.bus import BusError
from prior_sg.services.runtime.ros import wire
from prior_sg.services.runtime.ros.session import RosSession
from prior_sg.services.runtime.ros.types import Types, shared_types
from prior_sg.services.runtime.ros.wire import WireError

NODE = "prior_sg_poses"
CHUNK, LONGEST = 1 << 16, 1 << 12  # bytes that are read at once, and of a line
SEARCH_S, AGAIN_S = 8.0, 0.3
LINES = "lines of poses"


class Poses(Protocol):
    """Poses as they come."""

    said: str  # one phrase

    def read(self, until_ns: int | None) -> Iterator[Stamped | Fault]:
        """What has come since the last time; of a file no more than up to a stamp, None = all."""
        ...

    def close(self) -> None:
        """Listen no longer."""
        ...


def open_poses(options: ReadOptions) -> Poses:
    """What `pose_source` names. Raises SourceError."""
    if is_robot(options.pose_source):
        return Topics(options)
    return Lines(Path(options.pose_source), options)


def is_fifo(options: ReadOptions) -> bool:
    """Whether poses come through a FIFO, which who writes it writes for one reader."""
    try:
        return bool(options.pose_source) and stat.S_ISFIFO(Path(options.pose_source).stat().st_mode)
    except OSError:
        return False


class Lines:
    """A file that grows, or a FIFO."""

    def __init__(self, path: Path, options: ReadOptions) -> None:
        """Raises SourceError."""
        try:
            self._file = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        except OSError as error:
            raise SourceError(
                f"poses cannot be read from {path}: {error.strerror}; whoever writes them creates it"
            ) from error
        self.said = f"poses are the lines of {path.name}"
        self._unit, self._order = options.stamp_unit, options.quaternion or "xyzw"
        self._rest, self._lines = b"", deque[bytes]()

    def read(self, until_ns: int | None) -> Iterator[Stamped | Fault]:
        """See Poses."""
        while self._lines or self._more():
            try:
                row = row_of(self._lines.popleft().decode(errors="replace"), self._unit, self._order)
            except ValueError as error:
                yield Fault(LINES, str(error))
                continue
            if row is not None:
                yield row
                if until_ns is not None and row.stamp_ns >= until_ns:
                    return

    def close(self) -> None:
        """See Poses."""
        os.close(self._file)

    def _more(self) -> bool:
        """Take in more of the file; whether there is a whole line."""
        while not self._lines:
            try:
                data = os.read(self._file, CHUNK)
            except BlockingIOError:  # a FIFO into which nothing is written now
                return False
            if not data:
                return False
            *lines, self._rest = (self._rest + data).split(b"\n")
            self._rest = self._rest[-LONGEST:]
            self._lines.extend(lines)
        return True


class Topics:
    """A topic of odometry, poses or transforms of a running robot."""

    def __init__(self, options: ReadOptions) -> None:
        """Raises SourceError, and ExtraMissing where rosbags is not installed."""
        self._types: Types = shared_types()
        self._received = options.clock == "received"
        endpoint = endpoint_of(options.pose_source)
        try:
            self._session = RosSession(endpoint, NODE, options.ros_domain)
        except (BusError, WireError) as error:
            raise SourceError(f"{options.pose_source}: {error}") from error
        try:
            self._topic = _found(self._session, self._types, options)
            self._feed = Feed()
            self._feed.open(self._session, self._topic, self._types)
        except (SourceError, WireError) as error:
            self._session.close()
            raise SourceError(f"{options.pose_source}: {error}") from error
        self.said = f"poses are those of {self._topic.name} ({self._topic.type.rpartition('/')[2]}) on {endpoint}"

    def read(self, until_ns: int | None) -> Iterator[Stamped | Fault]:
        """See Poses."""
        messages, faults = self._feed.take(0.0)
        yield from faults
        for message in messages:
            try:
                samples = list(transforms_of(self._types.decode(message.payload, self._topic.type)))
            except WireError as error:
                yield Fault(f"messages of {self._topic.name}", str(error))
                continue
            for one in samples:
                stamp_ns = message.received_ns if self._received else one.stamp_ns
                yield Stamped(stamp_ns, "", "", one.position_m, one.quaternion_xyzw)

    def close(self) -> None:
        """See Poses."""
        self._session.close()


def _found(session: RosSession, types: Types, options: ReadOptions) -> Topic:
    """The topic that is told, else the only one of poses. Raises SourceError."""
    end_s = time.monotonic() + SEARCH_S
    while True:
        channels = {e.channel.name: e.channel for e in session.entities() if e.kind == wire.PUBLISHER and e.channel}
        topics = [Topic(name, of.type, 1, 0.0) for name, of in sorted(channels.items()) if types.knows(of.type)]
        poses = [topic for topic in topics if topic.taken_for == POSES]
        try:
            found = [topic for topic in pose_topics(poses, options)]
            said = f"several topics have poses: give --pose-topic {' or '.join(t.name for t in found[:NAMED])}"
            if len(found) == 1:
                return found[0]
        except ValueError as error:
            found, said = [], str(error)
        if time.monotonic() > end_s:
            raise SourceError(said if found or options.pose_topic else "nobody publishes poses there (--domain?)")
        time.sleep(AGAIN_S)

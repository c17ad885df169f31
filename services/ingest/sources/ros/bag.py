"""Recordings of ROS, opened with rosbags: what they hold, and single messages of them."""

import weakref
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from heapq import merge
from itertools import islice
from operator import itemgetter
from pathlib import Path
from typing import Any, Protocol

from prior_sg.services.ingest.core.ros import topics as ros_topics
from prior_sg.services.ingest.core.ros.clouds import LIVOX_DEFINITIONS
from prior_sg.services.ingest.core.ros.images import encoding_of, shown_by
from prior_sg.services.ingest.core.ros.topics import Topic
from prior_sg.services.ingest.core.ros.transforms import frame_name, written_stamp_ns
from prior_sg.services.ingest.sources.base import FrameError
from prior_sg.services.ingest.sources.tables import SourceError
from prior_sg.services.runtime import extras
from prior_sg.services.runtime.record import LogError, holds_messages, holds_ros

BAG, STORAGES, METADATA = ".bag", (".db3", ".mcap"), "metadata.yaml"
MENDING = {BAG: "rosbag reindex", ".mcap": "mcap recover"}  # by ending; else a folder's
BAGFILE = b"rosbag2_bagfile_information"
TRANSFORMS = "geometry_msgs/TransformStamped[] transforms"  # rosbags brings no such message for ROS 1


def is_recording(path: Path) -> bool:
    """Whether a path is a ROS 1 bag, a folder of such, one of rosbag2, or one of its files; logs of ours are not."""
    if path.is_dir():
        if (path / METADATA).is_file():
            return BAGFILE in (path / METADATA).read_bytes()[:4096]
        return bool(_split(path))
    if path.suffix == ".mcap":
        try:
            return holds_ros(path) or holds_messages(path)
        except LogError:
            return False
    return path.suffix in (BAG, *STORAGES)


def _split(folder: Path) -> list[Path]:
    """The files of ROS 1 in a folder."""
    return sorted(file for file in folder.glob(f"*{BAG}") if file.is_file() and not file.name.startswith("."))


@contextmanager
def readable(path: Path) -> Iterator[None]:
    """What any parser says of a damaged recording, as one sentence. Raises SourceError."""
    try:
        yield
    except (SourceError, extras.ExtraMissing):
        raise
    except Exception as error:  # rosbags, its parsers and decompressors raise nearly everything
        mend = MENDING.get(path.suffix, "ros2 bag reindex")
        raise SourceError(
            f"{path} cannot be read as a recording of ROS: {said(error)}; `{mend}` may mend one that was cut off"
        ) from error


def said(error: Exception) -> str:
    """What a library's error says, short and on one line."""
    return " ".join(str(error).split())[:200].rstrip(".") or type(error).__name__


@dataclass
class Index:
    """Where the messages of one topic lie, in the order of their stamps."""

    stamps_ns: list[int] = field(default_factory=list)  # as the clock that was asked for has them
    received_ns: list[int] = field(default_factory=list)
    headers_ns: list[int] = field(default_factory=list)


class Files1:
    """The files into which a recording of ROS 1 was split, as rosbags' reader of one; raises what that does."""

    def __init__(self, files: Sequence[Path]) -> None:
        from rosbags.rosbag1 import Reader

        self._readers = [Reader(file) for file in files]
        self._of: dict[int, Any] = {}  # reader of a connection, by identity

    def open(self) -> None:
        for reader in self._readers:
            reader.open()
            self._of |= {id(connection): reader for connection in reader.connections}

    def close(self) -> None:
        for reader in self._readers:
            reader.close()

    @property
    def connections(self) -> list[Any]:
        return [connection for reader in self._readers for connection in reader.connections]

    @property
    def duration(self) -> int:
        held = [reader for reader in self._readers if reader.message_count]
        return max(r.end_time for r in held) - min(r.start_time for r in held) if held else 0

    def messages(self, connections: Sequence[Any], **span: int) -> Iterator[tuple[Any, int, bytes]]:
        wanted = [(r, [c for c in connections if self._of[id(c)] is r]) for r in self._readers]
        return merge(*(r.messages(connections=own, **span) for r, own in wanted if own), key=itemgetter(1))


class Bag:
    """A recording that stays open as long as somebody holds it."""

    def __init__(self, path: Path) -> None:
        """Raises SourceError, and ExtraMissing where rosbags is not installed."""
        extras.require("ros", f"{path}, a recording of ROS,")
        from rosbags.rosbag2 import Reader as Reader2
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        files = _split(path) if path.is_dir() and not (path / METADATA).is_file() else [path]
        self.path, self.is_ros1 = path, all(file.suffix == BAG for file in files)
        self._store = get_typestore(Stores.ROS1_NOETIC if self.is_ros1 else Stores.ROS2_JAZZY)
        if self.is_ros1:
            for name in ros_topics.TF_TYPES:
                self._store.register(get_types_from_msg(TRANSFORMS, name))
        for name, text in LIVOX_DEFINITIONS.items():
            self._store.register(get_types_from_msg(text, name))
        with readable(path):
            self._reader: Any = Files1(files) if self.is_ros1 else Reader2(path)
            self._reader.open()
            self._close = weakref.finalize(self, self._reader.close)
            self._connections: dict[str, list[Any]] = {}
            for connection in self._reader.connections:
                self._connections.setdefault(connection.topic, []).append(connection)

    @property
    def why(self) -> str:
        """How it was recognised."""
        return f"it is a recording of ROS {1 if self.is_ros1 else 2}"

    def topics(self) -> list[Topic]:
        """All topics by name; of images and cameras with what their first message says. Raises SourceError."""
        return [self._topic(name) for name in sorted(self._connections)]

    def messages(self, names: Sequence[str]) -> Iterator[tuple[str, int, bytes]]:
        """Topic, time of arrival (ns) and data of all messages of some topics, by arrival. Raises SourceError."""
        wanted = [connection for name in names for connection in self._connections[name]]
        with readable(self.path):
            for connection, received_ns, data in self._reader.messages(connections=wanted) if wanted else ():
                yield connection.topic, received_ns, data

    def decode(self, name: str, data: bytes) -> Any:
        """A message of a topic. Raises FrameError."""
        decode = self._store.deserialize_ros1 if self.is_ros1 else self._store.deserialize_cdr
        try:
            return decode(data, self._connections[name][0].msgtype)
        except Exception as error:  # rosbags says nothing of what it raises for damaged data
            raise FrameError(f"a message of {name} cannot be read: {said(error)}") from error

    def message(self, name: str, index: Index, position: int) -> Any:
        """The message of a topic at a place of its index. Raises FrameError."""
        received_ns, header_ns = index.received_ns[position], index.headers_ns[position]
        span = {"connections": self._connections[name], "start": received_ns, "stop": received_ns + 1}
        try:
            found = [data for _, _, data in self._reader.messages(**span)]
        except Exception as error:
            raise FrameError(f"a message of {name} cannot be read: {said(error)}") from error
        data = next((data for data in found if self.stamp_ns(name, data) == header_ns), None)
        if data is None:
            raise FrameError(f"a message of {name} lies in a damaged part of the recording")
        return self.decode(name, data)

    def stamp_ns(self, name: str, data: bytes) -> int:
        """The stamp of a topic's message that begins with a header. Raises FrameError."""
        try:
            return written_stamp_ns(data, self.is_ros1)
        except ValueError as error:
            raise FrameError(str(error)) from error

    def _topic(self, name: str) -> Topic:
        connections = self._connections[name]
        count = sum(connection.msgcount for connection in connections)
        kind, duration_s = connections[0].msgtype, self._reader.duration / 1e9
        topic = Topic(name, kind, count, count / duration_s if count > 1 and duration_s > 0 else 0.0)
        return looked_at(self, topic)


class Messages(Protocol):
    """What is asked of a recording for its topics."""

    def messages(self, names: Sequence[str]) -> Iterator[tuple[str, int, bytes]]:
        """As in Bag."""

    def decode(self, name: str, data: bytes) -> Any:
        """As in Bag."""


def looked_at(bag: Messages, topic: Topic) -> Topic:
    """A topic of images, cameras or clouds with what its first message says that can be read. Raises SourceError."""
    kinds = (ros_topics.IMAGE, ros_topics.COMPRESSED, ros_topics.CAMERA_INFO, *ros_topics.CLOUDS)
    if topic.type not in kinds or not topic.count:
        return topic
    for _, _, data in islice(bag.messages([topic.name]), 3):
        try:
            message = bag.decode(topic.name, data)
        except FrameError:
            continue
        frame = frame_name(message.header.frame_id)
        if topic.type in (ros_topics.CAMERA_INFO, *ros_topics.CLOUDS):
            return replace(topic, frame=frame)
        return replace(topic, encoding=encoding_of(message), frame=frame, shows=shown_by(message))
    return topic

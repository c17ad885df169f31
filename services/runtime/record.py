"""Logs: one MCAP file per recording, written crash-safe and readable by any MCAP tool.

One channel per key and writer; the channel's metadata names our topic and the writer, its schema is the message type.
An MCAP message carries the writer's sequence number and two times: `publish_time` is when the writer sent it,
`log_time` when we received it. Messages lie in the file, and are read back, in the order in which they were added.

Messages of an older version are read as ours; those of a newer one, or of another program, are refused.

A log whose process was killed has no index at its end. It is read up to its last complete chunk. Chunks that are
damaged are told of and passed over, with an index or without.
"""

import json
import logging
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

import msgspec
import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, Message, Schema
from mcap.stream_reader import breakup_chunk
from mcap.writer import MCAP0_MAGIC, Writer

from prior_sg.schemas.codec import DecodeError, decode, schema_name
from prior_sg.schemas.migrations import current
from prior_sg.schemas.topics import TOPICS, Topic
from prior_sg.services.errors import PriorSgError
from prior_sg.services.runtime.chunks import (
    DAMAGE,
    appended,
    bounded,
    index_of,
    indexed_chunks,
    is_ended,
    records,
    unread,
)

CHUNK_BYTES = 1 << 20
FLUSH_NS = 1_000_000_000  # of received time: what a killed process can lose
SEQUENCE_MASK = 0xFFFFFFFF  # MCAP sequences are 32 bit
ROS_PROFILE = b"ros2"

logger = logging.getLogger(__name__)


class LogError(PriorSgError):
    """A log cannot be written or read; the text is one sentence for the user."""


@dataclass(frozen=True, slots=True)
class Logged:
    """One message of a log, still encoded."""

    topic: Topic
    key: str
    writer: str
    sequence: int
    sent_ns: int
    received_ns: int
    payload: bytes

    def message(self) -> Any:
        """What was encoded. Raises LogError."""
        try:
            return decode(self.topic.type, self.payload)
        except DecodeError as error:
            raise LogError(f"the log is damaged: a message on {self.key} is none ({error})") from error


@dataclass(frozen=True, slots=True)
class Content:
    """How many messages one writer left on one key. `topic` is a name, which this version may not know."""

    topic: str
    key: str
    writer: str
    messages: int


class LogWriter:
    """Writes one log; use it from one thread. An existing file is replaced. Raises LogError."""

    def __init__(self, path: str | Path) -> None:
        self._path = path
        with self._disk_errors():
            self._file: BinaryIO = Path(path).open("wb")  # noqa: SIM115
            self._writer = Writer(self._file, chunk_size=CHUNK_BYTES)
            self._writer.start(profile="", library="prior-sg")
        self._schemas: dict[str, int] = {}
        self._channels: dict[tuple[str, str, str], int] = {}
        self._end = self._file.tell()
        self._flushed_ns: int | None = None
        self.flush()

    def add(  # noqa: PLR0917
        self, topic: Topic, key: str, payload: bytes, writer: str, sequence: int, sent_ns: int, received_ns: int
    ) -> None:
        """Append one encoded message; times are wall times in nanoseconds, `received_ns` is given by the caller."""
        with self._disk_errors():
            self._writer.add_message(
                channel_id=self._channel(topic, key, writer),
                log_time=received_ns,
                data=payload,
                publish_time=max(sent_ns, 0),  # MCAP times are unsigned; a damaged header must not end the log
                sequence=sequence & SEQUENCE_MASK,
            )
            chunk_written = self._file.tell() != self._end
        if self._flushed_ns is None:
            self._flushed_ns = received_ns
        if chunk_written or received_ns - self._flushed_ns >= FLUSH_NS:
            self._flushed_ns = received_ns
            self.flush()

    def attach(self, name: str, media_type: str, data: bytes) -> None:
        """Append a file, such as ground truth."""
        with self._disk_errors():
            self._writer.add_attachment(create_time=0, log_time=0, name=name, media_type=media_type, data=data)
        self.flush()

    def metadata(self, name: str, fields: dict[str, str]) -> None:
        """Append named text fields, such as where the data came from."""
        with self._disk_errors():
            self._writer.add_metadata(name, fields)
        self.flush()

    def flush(self) -> None:
        """Hand all messages so far to the operating system: they survive the end of this process."""
        with self._disk_errors():
            self._writer.flush()  # type: ignore[no-untyped-call]
            self._end = self._file.tell()

    @property
    def size_bytes(self) -> int:
        """What is in the file so far; what waits for a chunk to fill is not."""
        return self._end

    def close(self) -> None:
        """Write the index and close the file; closing twice does nothing."""
        if not self._file.closed:
            with self._disk_errors(), self._file:
                self._writer.finish()  # type: ignore[no-untyped-call]

    def __enter__(self) -> "LogWriter":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @contextmanager
    def _disk_errors(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise LogError(f"the log {self._path} cannot be written: {error.strerror}") from error

    def _channel(self, topic: Topic, key: str, writer: str) -> int:
        identity = (topic.name, key, writer)
        if identity not in self._channels:
            self._channels[identity] = self._writer.register_channel(
                topic=key,
                message_encoding="msgpack",
                schema_id=self._schema(topic),
                metadata={"topic": topic.name, "writer": writer},
            )
        return self._channels[identity]

    def _schema(self, topic: Topic) -> int:
        name = schema_name(topic.type)
        if name not in self._schemas:
            described = json.dumps(msgspec.json.schema(topic.type, schema_hook=_array_schema)).encode()
            self._schemas[name] = self._writer.register_schema(name, "jsonschema", described)
        return self._schemas[name]


def _array_schema(kind: type) -> dict[str, Any]:
    if kind is np.ndarray:
        return {"description": "MessagePack extension type 1: an array, see schemas/codec.py"}
    raise NotImplementedError


def read_log(
    path: str | Path, topics: Collection[Topic] | None = None, damaged: Callable[[LogError], None] | None = None
) -> Iterator[Logged]:
    """Messages of a log in the order they were added, of all topics or the given ones. Raises LogError.

    A part that is damaged ends it with an error, unless `damaged` takes the error; then what lies behind is read.
    """
    wanted = {topic.name: topic for topic in (TOPICS if topics is None else topics)}
    with _opened(path) as file:
        for channel, schema, message in _messages(file, path, set(wanted), damaged):
            topic = wanted[channel.metadata["topic"]]
            yield Logged(
                topic=topic,
                key=channel.topic,
                writer=channel.metadata.get("writer", ""),
                sequence=message.sequence,
                sent_ns=message.publish_time,
                received_ns=message.log_time,
                payload=_current(path, topic, message.data, schema),
            )


def _current(path: str | Path, topic: Topic, payload: bytes, schema: str) -> bytes:
    try:
        return current(topic.type, payload, schema)
    except DecodeError as error:
        raise LogError(f"the log {path} cannot be read: {error}") from error


def contents(path: str | Path) -> list[Content]:
    """What a log holds, by key and writer in order of first appearance. Raises LogError."""
    ours = [(channel, count) for channel, count in _channels(path) if "topic" in channel.metadata]
    return [Content(c.metadata["topic"], c.topic, c.metadata.get("writer", ""), count) for c, count in ours]


def foreign_topics(path: str | Path) -> list[str]:
    """Topics that other programs wrote into an MCAP file. Raises LogError."""
    return sorted({channel.topic for channel, _ in _channels(path) if "topic" not in channel.metadata})


def holds_ros(path: str | Path) -> bool:
    """Whether an MCAP file says of itself that ROS 2 wrote it. Raises LogError."""
    with _opened(path) as file:
        head = file.read(1 + 8 + 4 + len(ROS_PROFILE))  # opcode, length of the record, length of the profile
    return head[:1] == bytes([Opcode.HEADER]) and head[9:] == len(ROS_PROFILE).to_bytes(4, "little") + ROS_PROFILE


def holds_messages(path: str | Path) -> bool:
    """Whether an MCAP file of another program has schemas of ROS 2 or Foxglove. Raises LogError."""
    with _opened(path) as file:
        index = index_of(file)
    if index is None or any("topic" in channel.metadata for channel in index.channels.values()):
        return False
    return any(
        schema.name.startswith("foxglove.") or (schema.encoding == "ros2msg" and "/msg/" in schema.name)
        for schema in index.schemas.values()
    )


def is_whole(path: str | Path) -> bool:
    """Whether a log was closed, and not cut off. Raises LogError."""
    with _opened(path) as file:
        return index_of(file) is not None


def loss(path: str | Path) -> str:
    """What of a log without a sound index is not read, as a clause; empty = it is whole. Raises LogError."""
    with _opened(path) as file:
        if index_of(file) is not None:
            return ""
        faults: list[LogError] = []
        for _ in _messages(file, path, set(), faults.append):
            pass
        said = _unread(file)
        return f"{said}; damaged parts left out: {len(faults)}" if faults else said


def _unread(file: BinaryIO) -> str:
    """What is wrong with a log that has no sound index, as a clause."""
    rest = unread(file)
    if rest.another is not None:
        behind = file.seek(0, 2) - rest.another
        mend = f"`tail -c +{rest.another + 1}` makes it a file of its own"
        return f"another log begins at byte {rest.another}, whose {behind} bytes are not read; {mend}"
    if rest.ended and rest.size_bytes:
        return f"the {rest.size_bytes} bytes behind its end are none of it, and not read"
    fault = "its index is damaged" if rest.ended or is_ended(file) else "it was cut off"
    return f"{fault}; its last {rest.size_bytes} bytes are not read" if rest.size_bytes else fault


def _channels(path: str | Path) -> list[tuple[Channel, int]]:
    """Channels of an MCAP file of any program and how many messages each has."""
    with _opened(path) as file:
        index = index_of(file)
        if index is not None and index.statistics is not None:
            channels, counts = index.channels, Counter(index.statistics.channel_message_counts)
        else:
            channels, counts = {}, Counter()
            for channel, _, _ in _messages(file, path, None, lambda fault: logger.warning("%s", fault)):
                channels[channel.id] = channel
                counts[channel.id] += 1
    return [(channels[i], counts[i]) for i in sorted(channels)]


def summary(path: str | Path) -> dict[str, int]:
    """Number of messages per topic name. Raises LogError."""
    counts: dict[str, int] = {}
    for content in contents(path):
        counts[content.topic] = counts.get(content.topic, 0) + content.messages
    return counts


def attachments(path: str | Path) -> dict[str, bytes]:
    """Attached files by name. Raises LogError."""
    with _opened(path) as file:
        return {record.name: record.data for record in _appended(file, path, Opcode.ATTACHMENT)}


def metadata(path: str | Path) -> dict[str, dict[str, str]]:
    """Named text fields. Raises LogError."""
    with _opened(path) as file:
        return {record.name: record.metadata for record in _appended(file, path, Opcode.METADATA)}


@contextmanager
def _opened(path: str | Path) -> Iterator[BinaryIO]:
    try:
        with Path(path).open("rb") as file:
            if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
                raise LogError(f"{path} is not a log: it does not begin as an MCAP file")
            yield file
    except OSError as error:
        raise LogError(f"the log {path} cannot be read: {error.strerror}") from error


def _messages(
    file: BinaryIO, path: str | Path, wanted: set[str] | None, damaged: Callable[[LogError], None] | None = None
) -> Iterator[tuple[Channel, str, Message]]:
    """Messages with their channels and schema names, in file order; `wanted` names topics, None = all messages of any
    program."""
    index = index_of(file)
    channels: dict[int, Channel] = {} if index is None else dict(index.channels)
    schemas: dict[int, str] = {} if index is None else {i: schema.name for i, schema in index.schemas.items()}
    if index is None:
        _say_cut_off(str(path), _unread(file))
    torn: LogError | None = None
    for read in records(file, Opcode.CHUNK) if index is None else indexed_chunks(file, index, wanted):
        if torn is not None:
            _tell(torn, damaged)
            torn = None
        try:
            found = breakup_chunk(bounded(read()), validate_crc=True)
        except DAMAGE as error:
            torn = LogError(f"the log {path} is damaged: a chunk cannot be read ({error})")
            continue
        for record in found:
            if isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Schema):
                schemas[record.id] = record.name
            elif isinstance(record, Message):
                channel = channels.get(record.channel_id)
                if channel is None:
                    _tell(
                        LogError(f"the log {path} is damaged: it does not describe the channel of a message"), damaged
                    )
                    break
                if wanted is None or channel.metadata.get("topic") in wanted:
                    yield channel, schemas.get(channel.schema_id, ""), record
    if torn is not None and is_ended(file):  # the last chunk of a log that was cut off is expected to be torn
        _tell(torn, damaged)


@cache
def _say_cut_off(path: str, why: str) -> None:
    """Once, however often the log is read."""
    logger.warning("the log %s is read without its index: %s", path, why)


def _tell(fault: LogError, damaged: Callable[[LogError], None] | None) -> None:
    if damaged is None:
        raise fault
    damaged(fault)


def _appended(file: BinaryIO, path: str | Path, wanted: Opcode) -> list[Any]:
    """All attachments or metadata records. Raises LogError."""
    try:
        return [read() for read in appended(file, index_of(file), wanted)]
    except DAMAGE as error:
        raise LogError(f"the log {path} is damaged: its {wanted.name.lower()} cannot be read ({error})") from error

"""MCAP files of other programs: ROS 2's messages without its profile; Foxglove's (protobuf, JSON) as those of ROS.

foxglove.RawImage, CompressedImage     sensor_msgs/Image, CompressedImage
foxglove.CameraCalibration             sensor_msgs/CameraInfo
foxglove.FrameTransform, …Transforms   tf2_msgs/TFMessage
foxglove.PoseInFrame, PosesInFrame     geometry_msgs/PoseStamped; of several none is read
foxglove.PointCloud                    sensor_msgs/PointCloud2, where its points lie in its frame as they are
https://docs.foxglove.dev/docs/sdk/schemas; flatbuffers and OMG IDL are not read.
"""

import base64
import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from mcap.reader import make_reader
from mcap.records import Channel, Schema

from prior_sg.services.headers import ImageError
from prior_sg.services.ingest.core.pixels import measured
from prior_sg.services.ingest.core.ros import topics as ros_topics
from prior_sg.services.ingest.core.ros.topics import Topic
from prior_sg.services.ingest.core.ros.transforms import stamp_ns_of
from prior_sg.services.ingest.sources.base import FrameError, SourceError
from prior_sg.services.ingest.sources.ros.bag import Bag, Index, looked_at, readable, said
from prior_sg.services.runtime import extras
from prior_sg.services.runtime.record import holds_ros

POINT_KINDS = {1: 2, 2: 1, 3: 4, 4: 3, 5: 6, 6: 5, 7: 7, 8: 8}  # Foxglove's numbers of types to those of PointField
TYPES = {
    "RawImage": ros_topics.IMAGE,
    "CompressedImage": ros_topics.COMPRESSED,
    "CameraCalibration": ros_topics.CAMERA_INFO,
    "FrameTransform": ros_topics.TF_TYPES[0],
    "FrameTransforms": ros_topics.TF_TYPES[0],
    "PoseInFrame": "geometry_msgs/msg/PoseStamped",
    "PointCloud": ros_topics.POINT_CLOUD,
}
WHOLE = SimpleNamespace(x_offset=0, y_offset=0, width=0, height=0)  # the region of a whole image
UNTURNED = (0.0, 0.0, 0.0, 1.0)


def open_bag(path: Path) -> "Bag | ForeignBag":
    """A recording, by what wrote it. Raises SourceError, and ExtraMissing where rosbags is not installed."""
    return ForeignBag(path) if path.is_file() and path.suffix == ".mcap" and not holds_ros(path) else Bag(path)


class ForeignBag:
    """An MCAP file that says nothing of ROS, as a recording of ROS; each message is read when it is asked for."""

    why = "it is an MCAP file with messages of ROS 2 or Foxglove"

    def __init__(self, path: Path) -> None:
        """Raises SourceError, and ExtraMissing where rosbags is not installed."""
        extras.require("ros", f"{path}, a recording of another program,")
        self.path = path
        self._channels: dict[str, tuple[Channel, Schema]] = {}
        self._counts: dict[str, int] = {}
        with readable(path), path.open("rb") as file:
            summary = make_reader(file).get_summary()
            if summary is None or summary.statistics is None:
                raise ValueError("it has no index")
            for channel in summary.channels.values():
                schema = summary.schemas.get(channel.schema_id)
                if schema is not None and type_of(schema):
                    self._channels[channel.topic] = channel, schema
                    count = summary.statistics.channel_message_counts.get(channel.id, 0)
                    self._counts[channel.topic] = self._counts.get(channel.topic, 0) + count
            self._duration_s = (summary.statistics.message_end_time - summary.statistics.message_start_time) / 1e9
        self._decoders: dict[str, Callable[[bytes], Any]] = {}

    def topics(self) -> list[Topic]:
        """All topics by name; of images and cameras with what their first message says. Raises SourceError."""
        return [self._topic(name) for name in sorted(self._channels)]

    def messages(self, names: Sequence[str], **span: Any) -> Iterator[tuple[str, int, bytes]]:
        """Topic, time of arrival (ns) and data of all messages of some topics, by arrival. Raises SourceError."""
        if not names:
            return
        with readable(self.path), self.path.open("rb") as file:
            for _, channel, message in make_reader(file).iter_messages(topics=list(names), **span):
                yield channel.topic, message.log_time, message.data

    def decode(self, name: str, data: bytes) -> Any:
        """A message of a topic, with the fields of its counterpart in ROS. Raises FrameError."""
        try:
            if name not in self._decoders:
                self._decoders[name] = _decoder(*self._channels[name])
            return self._decoders[name](data)
        except Exception as error:  # parsers of protobuf, JSON and CDR say nothing of what they raise
            raise FrameError(f"a message of {name} cannot be read: {said(error)}") from error

    def message(self, name: str, index: Index, position: int) -> Any:
        """The message of a topic at a place of its index. Raises FrameError."""
        received_ns, header_ns = index.received_ns[position], index.headers_ns[position]
        try:
            found = [data for _, _, data in self.messages([name], starting_at=received_ns, ending_at=received_ns)]
        except SourceError as error:
            raise FrameError(f"a message of {name} cannot be read: {said(error)}") from error
        for data in found:
            if self.stamp_ns(name, data) == header_ns:
                return self.decode(name, data)
        raise FrameError(f"a message of {name} lies in a damaged part of the recording")

    def stamp_ns(self, name: str, data: bytes) -> int:
        """The stamp of an image or a cloud. Raises FrameError."""
        return stamp_ns_of(self.decode(name, data).header)

    def _topic(self, name: str) -> Topic:
        count, kind = self._counts[name], type_of(self._channels[name][1])
        topic = Topic(name, kind, count, count / self._duration_s if count > 1 and self._duration_s > 0 else 0.0)
        return looked_at(self, topic)


def type_of(schema: Schema) -> str:
    """The type of ROS that a schema is read as; empty = none."""
    if schema.encoding == "ros2msg":
        return schema.name
    package, _, name = schema.name.rpartition(".")
    known = package == "foxglove" and schema.encoding in ("protobuf", "jsonschema")
    return TYPES.get(name, "") if known else ""


def _decoder(channel: Channel, schema: Schema) -> Callable[[bytes], Any]:
    if schema.encoding == "ros2msg":
        from rosbags.typesys import Stores, get_typestore

        store = get_typestore(Stores.ROS2_JAZZY)
        return lambda data: store.deserialize_cdr(data, schema.name)
    convert = CONVERTERS[schema.name.rpartition(".")[2]]
    if schema.encoding == "protobuf":
        from mcap_protobuf.decoder import DecoderFactory

        parse = DecoderFactory().decoder_for(channel.message_encoding, schema)
        if parse is None:
            raise FrameError(f"its messages are written as {channel.message_encoding}, not as protobuf")
        return lambda data: convert(parse(data))
    return lambda data: convert(_named(json.loads(data)))


def _named(value: Any, name: str = "") -> Any:
    """JSON with its objects' members as attributes; data is base64."""
    if isinstance(value, dict):
        return SimpleNamespace(**{key: _named(held, key) for key, held in value.items()})
    if isinstance(value, list):
        return [_named(held) for held in value]
    return base64.b64decode(value, validate=True) if name == "data" else value


def _header(message: Any, frame: str) -> SimpleNamespace:
    stamp = message.timestamp
    seconds, rest = (stamp.seconds, stamp.nanos) if hasattr(stamp, "nanos") else (stamp.sec, stamp.nsec)
    return SimpleNamespace(stamp=SimpleNamespace(sec=int(seconds), nanosec=int(rest)), frame_id=frame)


def _raw(message: Any) -> SimpleNamespace:
    fields = {name: getattr(message, name) for name in ("width", "height", "encoding", "step", "data")}
    return SimpleNamespace(header=_header(message, message.frame_id), is_bigendian=False, **fields)


def _compressed(message: Any) -> SimpleNamespace:
    """Depth is a PNG of 16 bits, which its format does not say."""
    try:
        deep = measured(message.data)[2] == 16
    except ImageError:
        deep = False
    form = f"16UC1; {message.format}" if deep else message.format
    return SimpleNamespace(header=_header(message, message.frame_id), format=form, data=message.data)


def _camera(message: Any) -> SimpleNamespace:
    matrices = {name.lower(): np.array(getattr(message, name), np.float64) for name in "DKP"}
    return SimpleNamespace(
        header=_header(message, message.frame_id),
        width=message.width,
        height=message.height,
        distortion_model=getattr(message, "distortion_model", ""),
        binning_x=0,
        binning_y=0,
        roi=WHOLE,
        **matrices,
    )


def _transform(message: Any) -> SimpleNamespace:
    moved = SimpleNamespace(translation=message.translation, rotation=message.rotation)
    header = _header(message, message.parent_frame_id)
    return SimpleNamespace(header=header, child_frame_id=message.child_frame_id, transform=moved)


def _cloud(message: Any) -> SimpleNamespace:
    turn = message.pose.orientation
    moved = [getattr(message.pose.position, axis) for axis in "xyz"]
    if any(moved) or (turn.x, turn.y, turn.z, turn.w) not in (UNTURNED, (0.0,) * 4):
        raise ValueError("its points lie in another frame than it says")
    fields = [
        SimpleNamespace(name=field.name, offset=field.offset, datatype=POINT_KINDS[field.type], count=1)
        for field in message.fields
        if field.type in POINT_KINDS
    ]
    stride = message.point_stride
    return SimpleNamespace(
        header=_header(message, message.frame_id),
        width=len(message.data) // max(stride, 1),
        height=1,
        point_step=stride,
        row_step=len(message.data),
        is_bigendian=False,
        fields=fields,
        data=message.data,
    )


CONVERTERS: dict[str, Callable[[Any], Any]] = {
    "RawImage": _raw,
    "CompressedImage": _compressed,
    "CameraCalibration": _camera,
    "FrameTransform": lambda message: SimpleNamespace(transforms=[_transform(message)]),
    "FrameTransforms": lambda message: SimpleNamespace(transforms=[_transform(one) for one in message.transforms]),
    "PoseInFrame": lambda message: SimpleNamespace(header=_header(message, message.frame_id), pose=message.pose),
    "PointCloud": _cloud,
}

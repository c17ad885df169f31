"""Recordings of ROS, written with rosbags' own writers: a camera's messages on a tree of transforms."""

import struct
from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

COLOR, DEPTH, INFO = "/camera/color/image_raw", "/camera/depth/image_raw", "/camera/color/camera_info"
OPTICAL = "camera_color_optical_frame"
KINDS = ("sqlite3", "mcap", "message", "file", "bag")  # storages, compressions of rosbag2, and ROS 1


def store_of(kind):
    """Types of messages for a kind of recording."""
    if kind != "bag":
        return get_typestore(Stores.ROS2_HUMBLE)
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
    return store


@dataclass
class Maker:
    """Makes messages of one kind of recording."""

    kind: str
    messages: list = field(default_factory=list)  # topic, time of arrival, message

    def __post_init__(self):
        self.store = store_of(self.kind)
        self.types = self.store.types

    def add(self, topic, stamp_ns, message, late_ns=0):
        self.messages.append((topic, stamp_ns + late_ns, message))

    def header(self, stamp_ns, frame):
        stamp = self.types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9))
        first = (0,) if self.kind == "bag" else ()
        return self.types["std_msgs/msg/Header"](*first, stamp, frame)

    def image(self, stamp_ns, pixels, encoding, frame=OPTICAL, pad=0):
        rows = np.ascontiguousarray(pixels).reshape(len(pixels), -1).view(np.uint8)
        padded = np.pad(rows, ((0, 0), (0, pad)))
        height, width = pixels.shape[:2]
        header = self.header(stamp_ns, frame)
        return self.types["sensor_msgs/msg/Image"](
            header, height, width, encoding, 0, padded.shape[1], padded.reshape(-1)
        )

    def compressed(self, stamp_ns, file, said, frame=OPTICAL):
        return self.types["sensor_msgs/msg/CompressedImage"](
            self.header(stamp_ns, frame), said, np.frombuffer(file, np.uint8)
        )

    def info(self, stamp_ns, camera, frame=OPTICAL, model="plumb_bob", distortion=(0.0,) * 5):
        fx, fy, cx, cy = camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px
        k = np.array((fx, 0, cx, 0, fy, cy, 0, 0, 1), np.float64)
        p = np.array((fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0), np.float64)
        roi = self.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
        return self.types["sensor_msgs/msg/CameraInfo"](
            self.header(stamp_ns, frame),
            camera.height_px,
            camera.width_px,
            model,
            np.array(distortion, np.float64),
            k,
            np.eye(3).reshape(-1),
            p,
            0,
            0,
            roi,
        )

    def transform(self, stamp_ns, parent, child, parent_from_child):
        """A TransformStamped."""
        vector, turn = self._parts(parent_from_child)
        motion = self.types["geometry_msgs/msg/Transform"](self.types["geometry_msgs/msg/Vector3"](*vector), turn)
        return self.types["geometry_msgs/msg/TransformStamped"](self.header(stamp_ns, parent), child, motion)

    def tf(self, *transforms):
        return self.types["tf2_msgs/msg/TFMessage"](list(transforms))

    def pose(self, stamp_ns, parent, parent_from_body):
        return self.types["geometry_msgs/msg/PoseStamped"](self.header(stamp_ns, parent), self._pose(parent_from_body))

    def odometry(self, stamp_ns, parent, child, parent_from_child):
        zero = self.types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
        twist = self.types["geometry_msgs/msg/Twist"](zero, zero)
        return self.types["nav_msgs/msg/Odometry"](
            self.header(stamp_ns, parent),
            child,
            self.types["geometry_msgs/msg/PoseWithCovariance"](self._pose(parent_from_child), np.zeros(36)),
            self.types["geometry_msgs/msg/TwistWithCovariance"](twist, np.zeros(36)),
        )

    def _pose(self, matrix):
        vector, turn = self._parts(matrix)
        return self.types["geometry_msgs/msg/Pose"](self.types["geometry_msgs/msg/Point"](*vector), turn)

    def _parts(self, matrix):
        x, y, z, w = Rotation.from_matrix(matrix[:3, :3]).as_quat().tolist()
        return matrix[:3, 3].tolist(), self.types["geometry_msgs/msg/Quaternion"](x, y, z, w)

    def write(self, folder):
        """The recording; its path."""
        folder.mkdir(parents=True, exist_ok=True)
        return self._write1(folder / "walk.bag") if self.kind == "bag" else self._write2(folder / "walk")

    def _write1(self, path):
        with rosbag1.Writer(path) as writer:
            connections = {}
            for topic, received_ns, message in sorted(self.messages, key=lambda entry: entry[1]):
                name = message.__msgtype__
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, name, typestore=self.store)
                writer.write(connections[topic], received_ns, self.store.serialize_ros1(message, name))
        return path

    def _write2(self, path):
        plugin = rosbag2.StoragePlugin.MCAP if self.kind == "mcap" else rosbag2.StoragePlugin.SQLITE3
        writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
        if self.kind in ("message", "file"):
            mode = rosbag2.CompressionMode[self.kind.upper()]
            writer.set_compression(mode, rosbag2.CompressionFormat.ZSTD)
        with writer:
            connections = {}
            for topic, received_ns, message in sorted(self.messages, key=lambda entry: entry[1]):
                name = message.__msgtype__
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, name, typestore=self.store)
                writer.write(connections[topic], received_ns, self.store.serialize_cdr(message, name))
        return path


def compressed_depth(png, a=0.0, b=0.0):
    """What image_transport's compressedDepth puts before a PNG: a format and two numbers of its quantisation."""
    return struct.pack("<iff", 0, a, b) + png


def as_message(**fields):
    """A message of no library."""
    return SimpleNamespace(**fields)

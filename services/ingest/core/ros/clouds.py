"""Clouds in messages of ROS as named numbers of their points: sensor_msgs/PointCloud2, and Livox' own (pure)."""

from typing import Any

import numpy as np

from prior_sg.services.ingest.core.clouds.sweep import MOST_POINTS, CloudError

LIVOX_PACKAGES = ("livox_ros_driver2", "livox_ros_driver")
LIVOX_TYPES = tuple(f"{package}/msg/CustomMsg" for package in LIVOX_PACKAGES)
LIVOX_TEXTS = {  # of both drivers, by the message's name in its package
    "CustomPoint": "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line\n",
    "CustomMsg": "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\n"
    "CustomPoint[] points\n",
}
LIVOX_DEFINITIONS = {f"{package}/msg/{name}": LIVOX_TEXTS[name] for package in LIVOX_PACKAGES for name in LIVOX_TEXTS}
KINDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}  # of PointField


def columns_of_message(message: Any) -> dict[str, np.ndarray]:
    """Each field of one number per point, (n,) in the machine's order of bytes. Raises CloudError."""
    if hasattr(message, "timebase"):
        return _livox(message)
    width, height = int(message.width), int(message.height)
    point_bytes, row_bytes = int(message.point_step), int(message.row_step)
    data = np.frombuffer(message.data, np.uint8)
    if not (0 < width * height <= MOST_POINTS and point_bytes > 0):
        raise CloudError(f"it has {width} x {height} points of {point_bytes} bytes")
    if height == 1:
        row_bytes = width * point_bytes  # drivers leave it out
    if row_bytes < width * point_bytes or len(data) < row_bytes * (height - 1) + width * point_bytes:
        raise CloudError(f"its {len(data)} bytes are too few for {width} x {height} points of {point_bytes} bytes")
    order = ">" if message.is_bigendian else "<"
    named = {
        str(field.name): (np.dtype(order + KINDS[int(field.datatype)]), int(field.offset))
        for field in message.fields
        if int(field.datatype) in KINDS and int(field.count) in (0, 1)
    }
    if any(offset < 0 or offset + kind.itemsize > point_bytes for kind, offset in named.values()):
        raise CloudError("a field of its points lies beyond them")
    row = np.dtype(
        {
            "names": list(named),
            "formats": [kind for kind, _ in named.values()],
            "offsets": [offset for _, offset in named.values()],
            "itemsize": point_bytes,
        }
    )
    points = np.ndarray((height, width), row, data, strides=(row_bytes, point_bytes))
    return {name: np.ravel(points[name]).astype(points[name].dtype.newbyteorder("=")) for name in named}


def _livox(message: Any) -> dict[str, np.ndarray]:
    """Points of Livox' CustomMsg; their times are nanoseconds after its stamp. Raises CloudError."""
    points = message.points
    if not 0 < len(points) <= MOST_POINTS:
        raise CloudError(f"it has {len(points)} points")
    rows = np.array([(point.x, point.y, point.z) for point in points], np.float64)
    offsets = np.array([point.offset_time for point in points], np.uint32)
    return {"x": rows[:, 0], "y": rows[:, 1], "z": rows[:, 2], "offset_time": offsets}

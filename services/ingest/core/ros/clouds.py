"""sensor_msgs/PointCloud2 as named numbers of its points (pure)."""

from typing import Any

import numpy as np

from prior_sg.services.ingest.core.clouds.sweep import MOST_POINTS, CloudError

KINDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}  # of PointField


def columns_of_message(message: Any) -> dict[str, np.ndarray]:
    """Each field of one number per point, (n,) in the machine's order of bytes. Raises CloudError."""
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

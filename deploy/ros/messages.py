"""Small parts that messages of ROS share (pure): made of message classes that are handed in, by name."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

Classes = Mapping[str, Any]  # of messages, by name such as std_msgs/msg/Header
NS_PER_S = 1_000_000_000
LATEST = 0  # as a stamp: wherever the frame is now, and RViz asks for no transform of the past


def stamp(classes: Classes, stamp_ns: int) -> Any:
    """A time."""
    seconds, rest = divmod(stamp_ns, NS_PER_S)
    return classes["builtin_interfaces/msg/Time"](seconds, rest)


def header(classes: Classes, frame: str, stamp_ns: int = LATEST) -> Any:
    """In which frame, and of when."""
    return classes["std_msgs/msg/Header"](stamp(classes, stamp_ns), frame)


def points(classes: Classes, points_m: np.ndarray) -> list[Any]:
    """Points (…, 3) in their order."""
    point = classes["geometry_msgs/msg/Point"]
    return [point(x, y, z) for x, y, z in points_m.reshape(-1, 3).astype(float).tolist()]


def color(classes: Classes, red_green_blue: Sequence[int], opacity: float = 1.0) -> Any:
    """A colour of bytes."""
    red, green, blue = (int(part) / 255 for part in red_green_blue)
    return classes["std_msgs/msg/ColorRGBA"](red, green, blue, opacity)


def colors(classes: Classes, rows: np.ndarray) -> list[Any]:
    """Opaque colours (…, 3) of bytes in their order; equal ones are one object."""
    made: dict[tuple[int, ...], Any] = {}
    found = []
    for row in map(tuple, rows.reshape(-1, 3).tolist()):
        if row not in made:
            made[row] = color(classes, row)
        found.append(made[row])
    return found


def pose(classes: Classes, position_m: Iterable[float] = (0.0, 0.0, 0.0)) -> Any:
    """At a point, not turned."""
    unturned = classes["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    return classes["geometry_msgs/msg/Pose"](classes["geometry_msgs/msg/Point"](*map(float, position_m)), unturned)


def text(classes: Classes, said: str) -> Any:
    """A std_msgs/String."""
    return classes["std_msgs/msg/String"](said)

"""Hashes of types and bytes of messages against ROS 2's own packages, where they are installed."""

import importlib
import json
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rosbags")
pytest.importorskip("rclpy")

from rclpy.serialization import deserialize_message, serialize_message

from prior_sg.services.runtime.ros.types import Types

SHARE = Path(sys.prefix) / "share"
MESSAGES = (
    "sensor_msgs/msg/Image",
    "sensor_msgs/msg/CompressedImage",
    "sensor_msgs/msg/CameraInfo",
    "nav_msgs/msg/Odometry",
    "nav_msgs/msg/OccupancyGrid",
    "nav_msgs/msg/Path",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
    "std_msgs/msg/String",
    "visualization_msgs/msg/MarkerArray",
)
TYPES = Types()


def described(name):
    """What the package that defines a type says of it."""
    package, kind, short = name.split("/")
    return json.loads((SHARE / package / kind / f"{short}.json").read_text())


def of_ros(name):
    package, kind, short = name.split("/")
    return getattr(importlib.import_module(f"{package}.{kind}"), short)


def filled(name, rng, depth=0):
    """A message of ROS's own library, every field of which has a value of its own."""
    message = of_ros(name)()
    for field, kind in message.get_fields_and_field_types().items():
        setattr(message, field, value(kind, rng, depth))
    return message


def value(kind, rng, depth):
    if kind.startswith("sequence<"):
        kind, count = kind[len("sequence<") : -1].split(",")[0], int(rng.integers(1, 4))
    elif kind.endswith("]"):
        kind, _, count = kind[:-1].partition("[")
        count = int(count)
    else:
        count = None
    numbers = {"float": "f4", "double": "f8", "octet": "u1", "byte": "u1", "boolean": "?"}
    numbers |= {f"{sign}int{bits}": f"{sign or 'i'}{bits // 8}" for sign in ("", "u") for bits in (8, 16, 32, 64)}
    if kind in numbers:
        dtype = np.dtype(numbers[kind])
        many = rng.integers(0, 2 if dtype.kind == "b" else 100, count or 1).astype(dtype)
        if count is None:
            return many[0].item()
        return many.tolist() if dtype.kind == "b" else many
    if kind.startswith("string"):
        texts = ["".join(rng.choice(list("abcé/ ☃"), rng.integers(0, 9))) for _ in range(count or 1)]
    else:
        texts = [filled(kind.replace("/", "/msg/"), rng, depth + 1) for _ in range(count or 1)]
    return texts if count is not None else texts[0]


@pytest.mark.parametrize("name", MESSAGES)
def test_hashes_are_those_of_the_packages(name):
    (said,) = (entry for entry in described(name)["type_hashes"] if entry["type_name"] == name)
    assert TYPES.hash(name) == said["hash_string"]


@pytest.mark.parametrize("name", ["nav_msgs/srv/LoadMap", "rcl_interfaces/srv/SetParameters"])
def test_hashes_of_services_are_those_of_the_packages(name):
    package, kind, short = name.split("/")
    request, _, reply = (SHARE / package / kind / f"{short}.srv").read_text().partition("---")
    types = Types()
    types.add_service(name, request, reply)
    (said,) = (entry for entry in described(name)["type_hashes"] if entry["type_name"] == name)
    assert types.hash(name) == said["hash_string"]


@pytest.mark.parametrize("name", MESSAGES)
def test_bytes_are_the_same_both_ways(name, rng):
    """But for those that align what follows: Fast CDR leaves in them what was there."""
    for _ in range(5):
        theirs = filled(name, rng)
        data = bytes(serialize_message(theirs))
        ours = TYPES.encode(TYPES.decode(data, name))
        assert len(ours) == len(data)
        aligning = [place for place, (one, other) in enumerate(zip(ours, data, strict=True)) if one != other]
        changed = bytearray(ours)
        for place in aligning:
            changed[place] = 0xA5
        assert TYPES.encode(TYPES.decode(bytes(changed), name)) == ours  # nothing is read from there
        assert not any(ours[place] for place in aligning)
        assert deserialize_message(ours, of_ros(name)) == theirs

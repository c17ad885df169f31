"""The live page's shapes as primitives of Foxglove: the same colours, the same places."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from foxglove.messages import (
    ArrowPrimitive,
    Color,
    LinePrimitive,
    LinePrimitiveLineType,
    PackedElementField,
    PackedElementFieldNumericType,
    Point3,
    PointCloud,
    Pose,
    Quaternion,
    SceneEntity,
    TextPrimitive,
    Timestamp,
    TriangleListPrimitive,
    Vector3,
)
from scipy.spatial.transform import Rotation

from prior_sg.deploy.showing.colors import Color as Rgb
from prior_sg.deploy.viewing.shapes import Arrows, Lines, Mesh, Name, Points, Shape

WORLD, CAMERA = "world", "camera"  # frames: metres with z up; x right, y down, z forward
TEXT_PX = 14.0  # of a name of scale 1
HEAD_M, HEAD_WIDTH = 0.12, 2.5  # of an arrow: its length, and its width in shafts
RGBA = ("red", "green", "blue", "alpha")
CORNER = np.dtype([*((axis, "<f4") for axis in "xyz"), *((part, "u1") for part in RGBA)])
FLOAT, BYTE = PackedElementFieldNumericType.Float32, PackedElementFieldNumericType.Uint8
FIELDS = [PackedElementField(name=name, offset=4 * row, type=FLOAT) for row, name in enumerate("xyz")]
FIELDS += [PackedElementField(name=name, offset=12 + row, type=BYTE) for row, name in enumerate(RGBA)]
MOST_S = 2**32 - 1  # that a stamp of Foxglove holds


def stamp_of(stamp_ns: int) -> Timestamp:
    """A time in nanoseconds, as far as Foxglove can tell it."""
    seconds, nanoseconds = divmod(max(stamp_ns, 0), 10**9)
    return Timestamp(min(seconds, MOST_S), nanoseconds)


def entity(name: str, shapes: Iterable[Shape], ink: Rgb, stamp_ns: int, **about: Any) -> SceneEntity:
    """All shapes of one thing; `about` are further fields of the entity."""
    parts: dict[str, Any] = {"lines": [], "triangles": [], "texts": [], "arrows": []}
    for shape in shapes:
        match shape:
            case Lines():
                parts["lines"].append(_lines(shape))
            case Mesh():
                parts["triangles"].append(_mesh(shape))
            case Name():
                parts["texts"].append(_name(shape, ink))
            case Arrows():
                parts["arrows"] += _arrows(shape)
    return SceneEntity(timestamp=stamp_of(stamp_ns), frame_id=WORLD, id=name, **parts, **about)


def cloud(points: list[Points], stamp_ns: int) -> PointCloud:
    """Coloured points as one message."""
    corners = np.zeros(sum(len(part.points_m) for part in points), CORNER)
    start = 0
    for part in points:
        rows = slice(start, start + len(part.points_m))
        for axis, name in enumerate("xyz"):
            corners[name][rows] = part.points_m[:, axis]
        for axis, name in enumerate(RGBA[:3]):
            corners[name][rows] = part.colors[:, axis]
        start = rows.stop
    corners["alpha"] = 255
    return PointCloud(
        timestamp=stamp_of(stamp_ns),
        frame_id=WORLD,
        pose=pose_of(np.eye(4)),
        point_stride=CORNER.itemsize,
        fields=FIELDS,
        data=corners.tobytes(),
    )


def pose_of(world_from_body: np.ndarray) -> Pose:
    """A rigid motion (4, 4)."""
    x, y, z = world_from_body[:3, 3].tolist()
    return Pose(position=Vector3(x=x, y=y, z=z), orientation=quaternion_of(world_from_body[:3, :3]))


def quaternion_of(rotation: np.ndarray) -> Quaternion:
    """A rotation (3, 3)."""
    x, y, z, w = Rotation.from_matrix(rotation).as_quat(canonical=True).tolist()
    return Quaternion(x=x, y=y, z=z, w=w)


def color_of(rgb: Rgb | np.ndarray, opacity: float = 1.0) -> Color:
    """A colour of bytes."""
    red, green, blue = (float(value) / 255 for value in rgb)
    return Color(r=red, g=green, b=blue, a=opacity)


def _points(points_m: np.ndarray) -> list[Point3]:
    return [Point3(x=x, y=y, z=z) for x, y, z in np.asarray(points_m, float).reshape(-1, 3).tolist()]


def _lines(shape: Lines) -> LinePrimitive:
    one = shape.colors.ndim == 1
    table: dict[bytes, Color] = {}
    rows = np.ascontiguousarray(shape.colors.reshape(-1, 3))
    return LinePrimitive(
        type=LinePrimitiveLineType.LineList,
        pose=pose_of(np.eye(4)),
        thickness=shape.width_px,
        scale_invariant=True,
        points=_points(shape.points_m),
        color=color_of(shape.colors) if one else None,
        colors=[] if one else [table.setdefault(row.tobytes(), color_of(row)) for row in rows],
    )


def _mesh(shape: Mesh) -> TriangleListPrimitive:
    return TriangleListPrimitive(
        pose=pose_of(np.eye(4)),
        points=_points(shape.vertices_m),
        indices=shape.faces.ravel().tolist(),
        color=color_of(shape.color, shape.opacity),
    )


def _name(shape: Name, ink: Rgb) -> TextPrimitive:
    pose = np.eye(4)
    pose[:3, 3] = shape.position_m
    return TextPrimitive(
        pose=pose_of(pose),
        billboard=True,
        font_size=TEXT_PX * shape.scale,
        scale_invariant=True,
        color=color_of(ink),
        text=shape.text,
    )


def _arrows(shape: Arrows) -> list[ArrowPrimitive]:
    """Each along the x axis of its pose."""
    made = []
    for start, end in shape.points_m.astype(float):
        length = float(np.linalg.norm(end - start))
        if length:
            made.append(
                ArrowPrimitive(
                    pose=pose_of(_along(start, (end - start) / length)),
                    shaft_length=max(length - HEAD_M, 0.0),
                    shaft_diameter=shape.shaft_m,
                    head_length=min(HEAD_M, length),
                    head_diameter=HEAD_WIDTH * shape.shaft_m,
                    color=color_of(shape.color),
                )
            )
    return made


def _along(start: np.ndarray, way: np.ndarray) -> np.ndarray:
    """A pose (4, 4) there whose x axis leads that way."""
    other = np.eye(3)[np.abs(way).argmin()]
    side = np.cross(way, other)
    side /= np.linalg.norm(side)
    pose = np.eye(4)
    pose[:3, :3] = np.stack((way, side, np.cross(way, side)), axis=1)
    pose[:3, 3] = start
    return pose

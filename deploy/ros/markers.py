"""The live page's picture of a scene as visualization_msgs/MarkerArray (pure).

A picture's names are paths: what is no number in them is the marker's namespace, which RViz switches on and off, and
the number its id: `/regions/7/floor` is marker 7 of `regions/floor`. Every array holds the whole picture and begins
with DELETEALL: whoever gets one, be it the first or after a gap, shows that scene and nothing of an older one.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np

from prior_sg.deploy.ros import messages
from prior_sg.deploy.ros.messages import Classes
from prior_sg.deploy.viewing.shapes import Arrows, Lines, Mesh, Name, Picture, Points, Shape

ARRAY, MARKER = "visualization_msgs/msg/MarkerArray", "visualization_msgs/msg/Marker"
MOST_IDS = 2**31  # an id is an int32
METRES_OF_PX = 0.02  # lines of the page are as wide on every screen, those of RViz in the world
GROUND_OPACITY = 0.6  # of the page's, where points of images lie between ground and edges
TEXT_M = 0.32  # height of a name of scale 1
BARB = 0.3  # of an arrow's length
BARB_ANGLE_RAD = 2.6


def marker_array(classes: Classes, picture: Picture, frame: str) -> Any:
    """The whole picture, in the order of its names."""
    removal = _marker(classes, frame, "", 0, 0, action=classes[MARKER].DELETEALL)
    return classes[ARRAY]([removal, *_markers(classes, picture, frame)])


def _markers(classes: Classes, picture: Picture, frame: str) -> Iterator[Any]:
    for path, shape in sorted(picture.items()):
        content = _content(classes, shape)
        if "text" in content or len(content["at"]):  # RViz calls an empty list an error
            yield _marker(classes, frame, *place_of(path), **content)


def place_of(path: str) -> tuple[str, int]:
    """Namespace and id of the marker of a path."""
    parts = path.strip("/").split("/")
    numbers = [int(part) for part in parts if part.isdigit()]
    return "/".join(part for part in parts if not part.isdigit()), (numbers or [0])[0] % MOST_IDS


def _content(classes: Classes, shape: Shape) -> dict[str, Any]:
    """What a shape makes of a marker."""
    kinds = classes[MARKER]
    match shape:
        case Points():
            tints = messages.colors(classes, shape.colors)
            return {"kind": kinds.SPHERE_LIST, "scale": 3 * (shape.size_m,), "at": shape.points_m, "colors": tints}
        case Lines():
            return {"kind": kinds.LINE_LIST, "at": shape.points_m} | _line(classes, shape)
        case Mesh():
            tint = messages.color(classes, shape.color, GROUND_OPACITY * shape.opacity)
            return {"kind": kinds.TRIANGLE_LIST, "at": shape.vertices_m[shape.faces], "color": tint}
        case Arrows():
            tint = messages.color(classes, shape.color)
            scale = (2 * shape.shaft_m, 0.0, 0.0)
            return {"kind": kinds.LINE_LIST, "at": with_barbs(shape.points_m), "color": tint, "scale": scale}
        case Name():
            said = {"text": shape.text, "position_m": shape.position_m, "scale": (0.0, 0.0, TEXT_M * shape.scale)}
            return {"kind": kinds.TEXT_VIEW_FACING} | said


def _line(classes: Classes, shape: Lines) -> dict[str, Any]:
    scale = {"scale": (METRES_OF_PX * shape.width_px, 0.0, 0.0)}
    if shape.colors.ndim == 1:
        return scale | {"color": messages.color(classes, shape.colors.tolist())}
    return scale | {"colors": messages.colors(classes, shape.colors)}


def with_barbs(arrows_m: np.ndarray) -> np.ndarray:
    """Segments (3 * arrow, 2, 3): each arrow's shaft, and two level barbs at its end."""
    starts, ends = arrows_m[:, 0].astype(np.float64), arrows_m[:, 1].astype(np.float64)
    along = ends - starts
    segments = [np.stack((starts, ends), axis=1)]
    cos, sin = np.cos(BARB_ANGLE_RAD), np.sin(BARB_ANGLE_RAD)
    for side in (sin, -sin):
        barb = BARB * np.stack((cos * along[:, 0] - side * along[:, 1], side * along[:, 0] + cos * along[:, 1]), axis=1)
        tips = ends + np.column_stack((barb, BARB * cos * along[:, 2]))
        segments.append(np.stack((ends, tips), axis=1))
    return np.concatenate(segments)


def _marker(
    classes: Classes,
    frame: str,
    namespace: str,
    number: int,
    kind: int,
    *,
    action: int = 0,
    at: np.ndarray | None = None,
    colors: list[Any] | None = None,
    color: Any = None,
    scale: tuple[float, float, float] = (1.0, 1.0, 1.0),
    text: str = "",
    position_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Any:
    nothing = np.zeros(0, np.uint8)
    return classes[MARKER](
        header=messages.header(classes, frame),
        ns=namespace,
        id=number,
        type=kind,
        action=action,
        pose=messages.pose(classes, position_m),
        scale=classes["geometry_msgs/msg/Vector3"](*map(float, scale)),
        color=color or messages.color(classes, (255, 255, 255)),
        lifetime=classes["builtin_interfaces/msg/Duration"](0, 0),
        frame_locked=False,
        points=[] if at is None else messages.points(classes, at),
        colors=colors or [],
        texture_resource="",
        texture=classes["sensor_msgs/msg/CompressedImage"](messages.header(classes, ""), "", nothing),
        uv_coordinates=[],
        text=text,
        mesh_resource="",
        mesh_file=classes["visualization_msgs/msg/MeshFile"]("", nothing),
        mesh_use_embedded_materials=False,
    )

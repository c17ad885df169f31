"""A scene and its images on Foxglove's topics, for a file and for a server alike.

Each layer of the map is a topic, so that the 3D panel switches it; every message holds its whole layer, so that one who
jumps in time or comes late sees all of it. What has not changed is not sent again.
"""

import json
from typing import Any, NamedTuple

import numpy as np
from foxglove import Channel, Context
from foxglove.channels import (
    CameraCalibrationChannel,
    CompressedImageChannel,
    FrameTransformChannel,
    LogChannel,
    PointCloudChannel,
    RawImageChannel,
    SceneUpdateChannel,
)
from foxglove.messages import (
    CameraCalibration,
    CompressedImage,
    FrameTransform,
    KeyValuePair,
    Log,
    LogLevel,
    RawImage,
    SceneEntity,
    SceneEntityDeletion,
    SceneEntityDeletionType,
    SceneUpdate,
    Vector3,
)

from prior_sg.deploy.viewing.drawing import Painter, marker_root
from prior_sg.deploy.viewing.foxglove.shapes import CAMERA, WORLD, cloud, entity, quaternion_of, stamp_of
from prior_sg.deploy.viewing.shapes import Picture, Points, same
from prior_sg.schemas.frames import Intrinsics
from prior_sg.schemas.levels import LEVELS
from prior_sg.schemas.markers import SceneMarker
from prior_sg.schemas.regions import Region
from prior_sg.schemas.scene import Scene

ABOVE = tuple(f"{level}s" for level in LEVELS)  # the levels above regions
LAYERS = (
    "regions",
    *ABOVE,
    "edges",
    "objects",
    "unnamed",
    "markers",
    "frontiers",
    "foreseen",
    "trajectory",
)  # of entities; the rest are points
TOLD = {"regions": 2, "markers": 3}  # layers whose entities have facts, and how much of a shape's name names an entity
PLACES, MAP, IMAGE, CALIBRATION = "/map/places", "/map/surface", "/camera/image", "/camera/calibration"
DEPTH = "/camera/depth"
TRANSFORMS, SCENE, NOTES = "/tf", "/scene", "/notes"
MAGIC = {b"\xff\xd8\xff": "jpeg", b"\x89PN": "png"}
SCENE_SCHEMA = {
    "title": "prior_sg.Scene",
    "type": "object",
    "properties": {
        "robot": {"type": "string"},
        "task": {"type": "string"},
        "environment": {"type": "string"},
        "places": {"type": "integer"},
        "regions": {"type": "array", "items": {"type": "object", "properties": {"label": {"type": "string"}}}},
        "objects": {"type": "array", "items": {"type": "object", "properties": {"label": {"type": "string"}}}},
    },
}


class _Made(NamedTuple):
    """An entity and what it was made of."""

    shapes: Picture
    facts: dict[str, Any]
    entity: SceneEntity


class Stream:
    """The topics of one robot in one context of Foxglove, whose sinks get all that is shown. Stamps are nanoseconds of
    the images; they say when in the story a message stands.
    """

    def __init__(self, context: Context, painter: Painter | None = None) -> None:
        self._context = context  # with which its channels close
        self._painter = painter or Painter()
        self._layers = {name: SceneUpdateChannel(f"/map/{name}", context=context) for name in LAYERS}
        self._points = {topic: PointCloudChannel(topic, context=context) for topic in (PLACES, MAP)}
        self._image = CompressedImageChannel(IMAGE, context=context)
        self._depth = RawImageChannel(DEPTH, context=context)
        self._calibration = CameraCalibrationChannel(CALIBRATION, context=context)
        self._transforms = FrameTransformChannel(TRANSFORMS, context=context)
        self._scene = Channel(SCENE, schema=SCENE_SCHEMA, context=context)
        self._notes = LogChannel(NOTES, context=context)
        self._shown: dict[str, Picture] = {}  # by topic, as sent
        self._made: dict[str, _Made] = {}  # by entity
        self._facts: dict[str, dict[str, Any]] = {}  # by entity
        self._told: tuple[str, str] | None = None  # task and environment

    def show(self, scene: Scene, stamp_ns: int) -> None:
        """Send the layers of a scene that have changed, its figures, and its task when it is another."""
        by_layer: dict[str, Picture] = {name: {} for name in (*LAYERS, "places")}
        for name, shape in self._painter.draw(scene).items():
            by_layer[_layer_of(name)][name] = shape
        points = by_layer.pop("places")
        if self._is_news(PLACES, points):
            self._points[PLACES].log(cloud(_dots(points), stamp_ns), log_time=stamp_ns)
        facts = {f"regions/{region.id}": facts_of(region) for region in scene.regions}
        facts |= {marker_root(marker).lstrip("/"): marker_facts(marker) for marker in scene.markers}
        for layer, picture in by_layer.items():
            if self._is_news(layer, picture) or _told_of(layer, facts) != _told_of(layer, self._facts):
                self._layers[layer].log(self._update(layer, picture, facts, stamp_ns), log_time=stamp_ns)
        self._facts = facts
        self._scene.log(json.dumps(figures(scene)).encode(), log_time=stamp_ns)
        if (told := (scene.task, scene.environment)) != self._told:
            self._told = told
            self.note(f"task: {scene.task or 'none'}; environment: {scene.environment or 'unknown'}", stamp_ns)

    def surface(self, picture: Picture, stamp_ns: int) -> None:
        """Send the coloured points of the map, if they have changed."""
        if self._is_news(MAP, picture):
            self._points[MAP].log(cloud(_dots(picture), stamp_ns), log_time=stamp_ns)

    def camera(self, image: bytes, lens: Intrinsics, world_from_camera: np.ndarray, stamp_ns: int) -> None:
        """Send one image, a JPEG or PNG file, with its lens and where it was taken."""
        when = stamp_of(stamp_ns)
        x, y, z = (float(value) for value in world_from_camera[:3, 3])
        self._transforms.log(
            FrameTransform(
                timestamp=when,
                parent_frame_id=WORLD,
                child_frame_id=CAMERA,
                translation=Vector3(x=x, y=y, z=z),
                rotation=quaternion_of(world_from_camera[:3, :3]),
            ),
            log_time=stamp_ns,
        )
        self._calibration.log(calibration_of(lens, stamp_ns), log_time=stamp_ns)
        form = next((name for magic, name in MAGIC.items() if image.startswith(magic)), "")
        self._image.log(CompressedImage(timestamp=when, frame_id=CAMERA, data=image, format=form), log_time=stamp_ns)

    def depth(self, depth_m: np.ndarray, stamp_ns: int) -> None:
        """Send the depth (h, w) of the image sent last, metres, 0 = no measurement, as millimetres of 16 bits."""
        units = np.minimum(np.rint(depth_m * 1000.0), np.iinfo(np.uint16).max).astype("<u2")
        height, width = units.shape
        message = RawImage(
            timestamp=stamp_of(stamp_ns),
            frame_id=CAMERA,
            width=width,
            height=height,
            encoding="16UC1",
            step=width * units.itemsize,
            data=units.tobytes(),
        )
        self._depth.log(message, log_time=stamp_ns)

    def note(self, text: str, stamp_ns: int) -> None:
        """One line of the log panel."""
        message = Log(timestamp=stamp_of(stamp_ns), level=LogLevel.Info, message=text, name="prior-sg")
        self._notes.log(message, log_time=stamp_ns)

    def forget(self) -> None:
        """Send everything anew with the next scene: somebody has come who has seen nothing."""
        self._shown.clear()
        self._told = None

    def _is_news(self, topic: str, picture: Picture) -> bool:
        known = self._shown.get(topic)
        if known is None:
            self._shown[topic] = picture
            return bool(picture)
        if picture.keys() == known.keys() and all(same(known[name], shape) for name, shape in picture.items()):
            return False
        self._shown[topic] = picture
        return True

    def _update(self, layer: str, picture: Picture, facts: dict[str, dict[str, Any]], stamp_ns: int) -> SceneUpdate:
        """The whole layer instead of what was there; entities that look the same are made once."""
        groups: dict[str, Picture] = {}
        for name, shape in picture.items():
            groups.setdefault(_entity_of(name), {})[name] = shape
        entities = []
        for name, shapes in groups.items():
            told, kept = facts.get(name, {}), self._made.get(name)
            if kept is None or kept.facts != told or not _alike(kept.shapes, shapes):
                about = [KeyValuePair(key=key, value=str(value)) for key, value in told.items()]
                made = entity(name, shapes.values(), self._painter.theme.ink, stamp_ns, metadata=about)
                kept = self._made[name] = _Made(shapes, told, made)
            entities.append(kept.entity)
        gone = [name for name in self._made if _layer_of(name) == layer and name not in groups]
        for name in gone:
            del self._made[name]
        old = SceneEntityDeletion(timestamp=stamp_of(stamp_ns), type=SceneEntityDeletionType.All)
        return SceneUpdate(deletions=[old], entities=entities)


def calibration_of(lens: Intrinsics, stamp_ns: int) -> CameraCalibration:
    """A pinhole without distortion, as all images are here."""
    fx, fy, cx, cy = lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px
    return CameraCalibration(
        timestamp=stamp_of(stamp_ns),
        frame_id=CAMERA,
        width=lens.width_px,
        height=lens.height_px,
        K=[fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
        R=[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        P=[fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
    )


def figures(scene: Scene) -> dict[str, Any]:
    """What tables and plots show: regions and objects as rows, and how much there is."""
    return {
        "robot": scene.robot,
        "task": scene.task,
        "environment": scene.environment,
        "places": len(scene.place_ids),
        "edges": len(scene.edges),
        "regions": [{"id": region.id, **facts_of(region), "objects": region.object_ids} for region in scene.regions],
        "objects": [
            {"id": item.id, "label": item.label, "known": round(item.known, 3), "frames": item.frames}
            for item in scene.objects
        ],
    }


def facts_of(region: Region) -> dict[str, Any]:
    """What a region is, in few numbers."""
    return {
        "label": region.label,
        "zone": region.parent,
        "probability": round(region.probability, 3),
        "unknown": round(region.unknown, 3),
        "predicted": region.predicted,
        "area_m2": round(region.area_m2, 1),
        "places": region.place_count,
    }


def marker_facts(marker: SceneMarker) -> dict[str, Any]:
    """What a printed marker is, in few words."""
    return {
        "number": marker.id,
        "dictionary": marker.dictionary,
        "size_m": round(marker.size_m, 3),
        "keyframes": marker.frames,
        "doubt": marker.doubt or "none",
    }


def _told_of(layer: str, facts: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    return {name: told for name, told in facts.items() if _layer_of(name) == layer}


def _layer_of(name: str) -> str:
    """Of a shape's name; what a search found lies with the objects."""
    layer = name.lstrip("/").split("/")[0]
    return "objects" if layer == "answers" else layer


def _entity_of(name: str) -> str:
    """All shapes of a region or a marker are one entity."""
    parts = name.lstrip("/").split("/")
    return "/".join(parts[: TOLD.get(parts[0])])


def _alike(one: Picture, other: Picture) -> bool:
    return one.keys() == other.keys() and all(same(one[name], shape) for name, shape in other.items())


def _dots(picture: Picture) -> list[Points]:
    return [shape for shape in picture.values() if isinstance(shape, Points)]

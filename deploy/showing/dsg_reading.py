"""A graph of Spark-DSG as a scene graph: our own files exactly, those of other programs as far as they tell."""

from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
import spark_dsg

from prior_sg.deploy.showing.dsg import MESH_PLACES
from prior_sg.schemas.foresight import Foresight
from prior_sg.schemas.levels import LevelNode
from prior_sg.schemas.markers import SceneMarker
from prior_sg.schemas.members import MapMember
from prior_sg.schemas.objects import SceneObject
from prior_sg.schemas.regions import NO_REGION, Region
from prior_sg.schemas.scene import Scene
from prior_sg.services.segmenter.core.regions.components import footprint_m2, hull_m

CELL_M = 0.1  # of the grid that footprints of foreign rooms are counted on
LAYERS = spark_dsg.DsgLayers


class Item(NamedTuple):
    """One node with our number for it and what it carries beside Spark-DSG's fields."""

    id: int
    node: spark_dsg.SceneGraphNode
    told: dict[str, Any]


def load_spark_dsg(path: str | Path) -> Scene:
    """The scene in a file of Spark-DSG, JSON or binary. Raises OSError, or ValueError for a file that is none."""
    Path(path).open("rb").close()  # a missing file is told as such
    try:
        graph = spark_dsg.DynamicSceneGraph.load(str(path))
    except Exception as error:  # whatever the bindings raise on foreign bytes
        raise ValueError(f"{path} cannot be read as a Spark-DSG graph: {str(error).splitlines()[0]}") from error
    return scene_of_graph(graph)


def scene_of_graph(graph: spark_dsg.DynamicSceneGraph) -> Scene:
    """The scene that a graph tells; positions stay as they are.

    Places are those of the layer PLACES, else of MESH_PLACES; a room is a region of the places below it. A name is the
    node's own, else that of its semantic label, else its symbol. Rooms without class probabilities count as certain,
    and places of other programs have no posterior.
    """
    about = dict(graph.metadata.get())
    places = _items(graph, LAYERS.PLACES) or _items(graph, MESH_PLACES)
    rooms, objects = _items(graph, LAYERS.ROOMS), _items(graph, LAYERS.OBJECTS)
    layers = {"places": places, "rooms": rooms, "objects": objects}
    names = {room.id: _name(graph, room.node) for room in rooms}
    labels = _labels(graph, rooms, names)
    columns = _columns(places, rooms, labels)
    return Scene(
        robot=about.get("robot", "robot"),
        stamp_ns=about.get("stamp_ns") or max(map(_stamp_ns, (*places, *rooms, *objects)), default=0),
        environment=about.get("environment") or _environment(graph),
        task=about.get("task", ""),
        merged_of=msgspec.convert(about.get("merged_of", []), list[str]),
        prior_digest=about.get("prior_digest", ""),
        space=about.get("embedding_space", ""),
        labels=labels,
        regions=[_region(room, names, columns, layers) for room in layers["rooms"]],
        objects=[object_of(graph, item) for item in objects],
        trajectory=np.array(about.get("trajectory_m", ()), np.float32).reshape(-1, 3),
        origin_m=tuple(about.get("origin_m", (0.0, 0.0, 0.0))),
        revision=-1,  # of no store
        nodes=[msgspec.convert(node, LevelNode) for node in about.get("levels", ())],
        foresight=msgspec.convert(about.get("foresight", {}), Foresight),
        markers=[msgspec.convert(marker, SceneMarker) for marker in about.get("markers", ())],
        **_edges(graph, places),
        **columns,
    )


def _items(graph: spark_dsg.DynamicSceneGraph, layer: str) -> list[Item]:
    """Nodes of a layer, sorted by id: the number of their symbol, or their whole value where numbers repeat."""
    if layer not in graph.layer_names:
        return []
    nodes = list(graph.get_layer(layer).nodes)
    distinct = len({node.id.category_id for node in nodes}) == len(nodes)
    ids = [node.id.category_id if distinct else node.id.value for node in nodes]
    items = [Item(number, node, dict(node.attributes.metadata.get())) for number, node in zip(ids, nodes, strict=True)]
    return sorted(items, key=lambda item: item.id)


def _name(graph: spark_dsg.DynamicSceneGraph, node: spark_dsg.SceneGraphNode) -> str:
    space = graph.get_labelspace(node.layer.layer, node.layer.partition)
    return node.attributes.name or space.labels_to_names.get(node.attributes.semantic_label) or node.id.str()


def _environment(graph: spark_dsg.DynamicSceneGraph) -> str:
    return next((_name(graph, building.node) for building in _items(graph, LAYERS.BUILDINGS)), "")


def _stamp_ns(item: Item) -> int:
    return int(item.node.attributes.last_update_time_ns)


def _labels(graph: spark_dsg.DynamicSceneGraph, rooms: list[Item], names: dict[int, str]) -> list[str]:
    """Those of the rooms' labelspace in its order, then whatever else rooms are called or believed to be."""
    key = graph.get_layer_key(LAYERS.ROOMS)
    known = [name for _, name in sorted(graph.get_labelspace(key.layer, key.partition).labels_to_names.items())]
    believed = [name for room in rooms for name in room.node.attributes.semantic_class_probabilities]
    return list(dict.fromkeys((*known, *believed, *names.values())))


def _columns(places: list[Item], rooms: list[Item], labels: list[str]) -> dict[str, Any]:
    """The scene's columns of places, with frontiers and ground."""
    regions = {room.node.id.value: room.id for room in rooms}
    posteriors = [[place.told.get("posterior", {}).get(label, 0.0) for label in labels] for place in places]
    parents = [regions.get(item.node.get_parent(), NO_REGION) if item.node.has_parent() else -1 for item in places]
    openings = [(place.id, *found) for place in places if (found := opening_of(place)) is not None]
    surfaces = [(place.id, *flat) for place in places if (flat := ground_of(place)) is not None]
    return {
        "place_ids": np.array([place.id for place in places], np.int64),
        "positions_m": np.array([place.node.attributes.position for place in places], np.float32).reshape(-1, 3),
        "radii_m": np.array([radius_m_of(place) for place in places], np.float32),
        "basis_points": np.array([basis_points_of(place) for place in places], np.int16),
        "place_regions": np.array(parents, np.int64),
        "posteriors": np.array(posteriors, np.float16).reshape(len(places), len(labels)),
        "unknown": np.array([place.told.get("unknown", 0.0) for place in places], np.float16),
        "predicted_ids": np.array([place.id for place in places if place.node.attributes.is_predicted], np.int64),
        "frontier_ids": np.array([place for place, _, _ in openings], np.int64),
        "frontier_directions": np.array([way for _, way, _ in openings], np.float32).reshape(-1, 3),
        "frontier_areas_m2": np.array([area_m2 for _, _, area_m2 in openings], np.float32),
        "surface_ids": np.array([place for place, _, _ in surfaces], np.int64),
        "ellipses": np.array([ellipse for _, ellipse, _ in surfaces], np.float32).reshape(-1, 3),
        "hull_counts": np.array([len(hull) for _, _, hull in surfaces], np.int64),
        "hulls_m": np.concatenate([np.zeros((0, 2)), *(hull for _, _, hull in surfaces)]).astype(np.float32),
    }


def radius_m_of(place: Item) -> float:
    """Of a sphere its distance to the nearest obstacle; of a piece of ground the short half axis."""
    attributes = place.node.attributes
    if isinstance(attributes, spark_dsg.PlaceNodeAttributes):
        return float(attributes.distance)
    return float(place.told.get("radius_m", _axes(attributes)[1]))


def basis_points_of(place: Item) -> int:
    """Obstacle points at the distance of its radius."""
    attributes = place.node.attributes
    return int(place.told.get("basis_points", getattr(attributes, "num_basis_points", 0)))


def opening_of(place: Item) -> tuple[np.ndarray, float] | None:
    """Direction and area of a frontier: as we wrote them, else the x axis and the size that Spark-DSG keeps."""
    if (told := place.told.get("frontier")) is not None:
        return np.array(told["direction"]), told["area_m2"]
    attributes = place.node.attributes
    if not getattr(attributes, "active_frontier", False):
        return None
    w, x, y, z = (getattr(attributes.orientation, axis) for axis in "wxyz")
    direction = np.array((1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)))
    return direction, float(attributes.frontier_scale[1] * attributes.frontier_scale[2])


def ground_of(place: Item) -> tuple[tuple[float, float, float], np.ndarray] | None:
    """Ellipse (half axes, angle of the long one) and hull (corner, 2) of a piece of ground."""
    attributes = place.node.attributes
    if not isinstance(attributes, spark_dsg.Place2dNodeAttributes) or not len(attributes.boundary):
        return None
    return _axes(attributes), np.array(attributes.boundary)[:, :2]


def _axes(attributes: spark_dsg.Place2dNodeAttributes) -> tuple[float, float, float]:
    long_axis, short_axis = np.asarray(attributes.ellipse_matrix_expand).T
    angle_rad = float(np.arctan2(long_axis[1], long_axis[0]))
    return float(np.linalg.norm(long_axis)), float(np.linalg.norm(short_axis)), angle_rad


def _edges(graph: spark_dsg.DynamicSceneGraph, places: list[Item]) -> dict[str, Any]:
    ids = {place.node.id.value: place.id for place in places}
    ways = [way for way in graph.edges if way.source in ids and way.target in ids]
    found = sorted(
        (*sorted((ids[way.source], ids[way.target])), way.info.weight if way.info.weighted else 0.0) for way in ways
    )
    return {
        "edges": np.array([pair for *pair, _ in found], np.int64).reshape(-1, 2),
        "clearances_m": np.array([clearance_m for _, _, clearance_m in found], np.float32),
    }


def _region(room: Item, names: dict[int, str], columns: dict[str, Any], layers: dict[str, list[Item]]) -> Region:
    """As we wrote it, or put together from the places and objects below the room and the rooms beside it."""
    if "place_count" in room.told:
        return msgspec.convert(room.told, Region)
    rows = np.flatnonzero(columns["place_regions"] == room.id)
    centers_m, radii_m = columns["positions_m"][rows], columns["radii_m"][rows]
    above = {room.node.id.value, *(layers["places"][row].node.id.value for row in rows)}
    beside = room.node.siblings()
    return Region(
        id=room.id,
        label=names[room.id],
        place_count=len(rows),
        probability=float(room.node.attributes.semantic_class_probabilities.get(names[room.id], 1.0)),
        position_m=tuple(np.asarray(room.node.attributes.position, float).tolist()),
        area_m2=footprint_m2(centers_m, radii_m, CELL_M) if len(rows) else 0.0,
        predicted=room.node.attributes.is_predicted,
        hull_m=hull_m(centers_m, radii_m) if len(rows) else [],
        neighbour_ids=[other.id for other in layers["rooms"] if other.node.id.value in beside],
        object_ids=[
            item.id for item in layers["objects"] if item.node.has_parent() and item.node.get_parent() in above
        ],
    )


def object_of(graph: spark_dsg.DynamicSceneGraph, item: Item) -> SceneObject:
    """An object without a valid box is as small as its position."""
    attributes = item.node.attributes
    middle_m = tuple(np.asarray(attributes.position, float).tolist())
    low_m, high_m = middle_m, middle_m
    if attributes.bounding_box.is_valid():
        corners_m = np.array(attributes.bounding_box.corners(), float)
        low_m, high_m = tuple(corners_m.min(axis=0).tolist()), tuple(corners_m.max(axis=0).tolist())
    return SceneObject(
        id=item.id,
        label=attributes.name if "known" in item.told else _name(graph, item.node),
        probability=item.told.get("probability", 1.0),
        known=item.told.get("known", 1.0),
        position_m=middle_m,
        min_m=low_m,
        max_m=high_m,
        frames=item.told.get("frames", 0),
        members=msgspec.convert(item.told.get("members", []), list[MapMember]),
    )

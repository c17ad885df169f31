"""A scene graph as a Spark-DSG graph."""

import errno
import json
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import spark_dsg

from prior_sg.deploy.showing.colors import label_colors
from prior_sg.deploy.showing.export import (
    adjacent_regions,
    frontiers_of,
    members_of,
    objects_with_places,
    regions_of,
    surfaces_of,
)
from prior_sg.schemas.objects import SceneObject
from prior_sg.schemas.regions import Region
from prior_sg.schemas.scene import Scene

OBJECT, PLACE, PLACE_2D, ROOM, BUILDING = "O", "p", "P", "R", "B"  # node prefixes of Spark-DSG
MESH_PLACES = "MESH_PLACES"  # its layer of 2D places


def spark_dsg_graph(scene: Scene) -> spark_dsg.DynamicSceneGraph:
    """The scene in Spark-DSG's layers: objects, places above them, rooms, buildings above the rooms.

    A place keeps its radius as `distance`, a room the mean posterior of its places as `semantic_class_probabilities`;
    what Spark-DSG has no field for stands in the nodes' and the graph's metadata. Edges between places weigh their
    clearance; rooms are joined where their places are. Labels are numbered as in `scene.labels`.
    """
    graph = spark_dsg.DynamicSceneGraph()
    colors = label_colors(scene)
    flat = len(scene.surface_ids) > 0
    prefix, layer = (PLACE_2D, MESH_PLACES) if flat else (PLACE, spark_dsg.DsgLayers.PLACES)
    if flat:
        graph.add_layer(3, 1, layer)
    _add_places(graph, scene, layer, prefix, colors)
    for item, place in objects_with_places(scene):
        _add(graph, spark_dsg.DsgLayers.OBJECTS, OBJECT, item.id, _object_node(scene, item))
        if place is not None:
            graph.insert_edge(_symbol(prefix, place), _symbol(OBJECT, item.id), enforce_single_parent=True)
    members = members_of(scene)
    for region in scene.regions:
        rows = members[region.id]
        _add(graph, spark_dsg.DsgLayers.ROOMS, ROOM, region.id, _room_node(scene, region, rows, colors))
        for place in scene.place_ids[rows].tolist():
            graph.insert_edge(_symbol(ROOM, region.id), _symbol(prefix, place), enforce_single_parent=True)
    for a, b in sorted(adjacent_regions(scene)):
        graph.insert_edge(_symbol(ROOM, a), _symbol(ROOM, b))
    if scene.regions:
        _add_buildings(graph, scene)
    about: dict[str, Any] = {"robot": scene.robot, "environment": scene.environment, "task": scene.task}
    about |= {"prior_digest": scene.prior_digest, "embedding_space": scene.space}
    about |= {"stamp_ns": scene.stamp_ns, "trajectory_m": scene.trajectory.tolist()}
    about |= {"levels": msgspec.to_builtins(scene.nodes)}  # zones, floors, districts and markers have no layer
    about |= {"merged_of": scene.merged_of}
    about |= {"markers": msgspec.to_builtins(scene.markers)}
    about |= {"foresight": msgspec.to_builtins(scene.foresight)}
    graph.metadata.set(about | {"origin_m": list(scene.origin_m)})
    labelspace = spark_dsg.Labelspace(dict(enumerate(scene.labels)))  # kept in the metadata, hence after them
    for named in (layer, spark_dsg.DsgLayers.ROOMS):
        key = graph.get_layer_key(named)
        graph.set_labelspace(labelspace, key.layer, key.partition)
    return graph


def save_spark_dsg(scene: Scene, path: str | Path) -> None:
    """Write a file that `DynamicSceneGraph.load` reads: JSON, or binary when the name ends in `.sparkdsg`.

    Raises OSError, also where Spark-DSG says nothing: it takes no notice of a full disk.
    """
    graph = spark_dsg_graph(scene)
    Path(path).open("wb").close()  # what cannot be written at all is told as such
    graph.save(str(path), include_mesh=False)
    if not _is_whole(Path(path), graph):
        raise OSError(errno.ENOSPC, "it was cut off, as on a full disk")


def _is_whole(path: Path, graph: spark_dsg.DynamicSceneGraph) -> bool:
    content = path.read_bytes()
    if path.suffix == ".sparkdsg":
        return content.endswith(graph.to_binary())
    try:
        json.loads(content)
    except ValueError:
        return False
    return True


def _add_places(
    graph: spark_dsg.DynamicSceneGraph, scene: Scene, layer: str, prefix: str, colors: dict[str, tuple[int, int, int]]
) -> None:
    surfaces, frontiers, predicted = surfaces_of(scene), frontiers_of(scene), set(scene.predicted_ids.tolist())
    names = {region.id: region.label for region in scene.regions}
    for row, place in enumerate(scene.place_ids.tolist()):
        opening = frontiers.get(place)
        node = _ground_node(scene, row, surfaces[place]) if place in surfaces else _place_node(scene, row, opening)
        node.is_predicted = place in predicted
        node.name = str(_symbol(prefix, place))
        label = names.get(int(scene.place_regions[row]), "")
        _describe_place(node, scene, row, label, opening)
        _label_node(node, label, scene, colors)
        _add(graph, layer, prefix, place, node)
    for (a, b), clearance_m in zip(scene.edges.tolist(), scene.clearances_m.tolist(), strict=True):
        weight = spark_dsg.EdgeAttributes()
        weight.weighted, weight.weight = True, clearance_m
        graph.insert_edge(_symbol(prefix, a), _symbol(prefix, b), weight)


def _place_node(scene: Scene, row: int, opening: tuple[np.ndarray, float] | None) -> spark_dsg.PlaceNodeAttributes:
    """A sphere; one beside unobserved space is an active frontier whose x axis leads there."""
    node = spark_dsg.PlaceNodeAttributes()
    node.distance = float(scene.radii_m[row])
    node.num_basis_points = int(scene.basis_points[row])
    node.real_place = True
    if opening is not None:
        (x, y, z), side_m = opening[0].astype(float), opening[1] ** 0.5
        node.active_frontier = True
        node.frontier_scale = np.array((0.0, side_m, side_m))
        # Half the turn from the x axis: the axis halfway between the two, as a quaternion (w, cross product).
        turn = np.array((1 + x, 0.0, -z, y)) if x > -1 + 1e-6 else np.array((0.0, 0.0, 0.0, 1.0))
        node.orientation = spark_dsg.Quaternion(*(turn / np.linalg.norm(turn)))
    return node


def _ground_node(scene: Scene, row: int, surface: tuple[np.ndarray, np.ndarray]) -> spark_dsg.Place2dNodeAttributes:
    """A piece of ground: its hull, and the ellipse as the matrix that makes it of the unit circle, and its inverse."""
    (long_m, short_m, angle_rad), hull_m = surface[0].astype(float), surface[1].astype(float)
    cosine, sine = np.cos(angle_rad), np.sin(angle_rad)
    expand = np.array(((cosine, -sine), (sine, cosine))) * (long_m, short_m)
    height_m = float(scene.positions_m[row, 2])
    node = spark_dsg.Place2dNodeAttributes()
    node.boundary = [np.array((x, y, height_m)) for x, y in hull_m]
    node.ellipse_centroid = scene.positions_m[row].astype(float)
    node.ellipse_matrix_expand, node.ellipse_matrix_compress = expand, np.linalg.inv(expand)
    return node


def _describe_place(
    node: spark_dsg.SemanticNodeAttributes,
    scene: Scene,
    row: int,
    label: str,
    opening: tuple[np.ndarray, float] | None,
) -> None:
    """What places of both kinds tell, and what Spark-DSG has no field for."""
    posterior = scene.posteriors[row].astype(float)
    node.position = scene.positions_m[row].astype(float)
    node.last_update_time_ns = scene.stamp_ns
    told: dict[str, Any] = {"label": label, "unknown": float(scene.unknown[row])}
    told |= {"radius_m": float(scene.radii_m[row]), "basis_points": int(scene.basis_points[row])}
    if posterior.any():
        told["posterior"] = dict(zip(scene.labels, posterior.tolist(), strict=True))
    if opening is not None:
        told["frontier"] = {"direction": opening[0].tolist(), "area_m2": opening[1]}
    node.metadata.set(told)


def _object_node(scene: Scene, item: SceneObject) -> spark_dsg.ObjectNodeAttributes:
    node = spark_dsg.ObjectNodeAttributes()
    node.position = np.array(item.position_m)
    node.last_update_time_ns = scene.stamp_ns
    node.name = item.label
    low_m, high_m = np.array(item.min_m), np.array(item.max_m)
    node.bounding_box = spark_dsg.BoundingBox(high_m - low_m, (high_m + low_m) / 2)
    node.registered = True
    node.metadata.set(
        {
            "probability": item.probability,
            "known": item.known,
            "frames": item.frames,
            "members": msgspec.to_builtins(item.members),
        }
    )
    return node


def _room_node(
    scene: Scene, region: Region, rows: np.ndarray, colors: dict[str, tuple[int, int, int]]
) -> spark_dsg.RoomNodeAttributes:
    node = spark_dsg.RoomNodeAttributes()
    node.position = np.array(region.position_m)
    node.last_update_time_ns = scene.stamp_ns
    node.name = region.label
    node.is_predicted = region.predicted
    node.metadata.set(msgspec.to_builtins(region))
    _label_node(node, region.label, scene, colors)
    if len(rows):
        posterior = scene.posteriors[rows].astype(float).mean(axis=0)
        node.semantic_class_probabilities = dict(zip(scene.labels, posterior.tolist(), strict=True))
        low = (scene.positions_m[rows] - scene.radii_m[rows, None]).min(axis=0)
        high = (scene.positions_m[rows] + scene.radii_m[rows, None]).max(axis=0)
        node.bounding_box = spark_dsg.BoundingBox(high - low, (high + low) / 2)
    return node


def _add_buildings(graph: spark_dsg.DynamicSceneGraph, scene: Scene) -> None:
    """A building for each of the scene's; one for all, called like the environment, where it has at most one."""
    found = [node for node in scene.nodes if node.level == "building"]
    several = len(found) > 1
    held = regions_of(scene, "building") if several else {0: [region.id for region in scene.regions]}
    for number, regions in held.items():
        node = spark_dsg.SemanticNodeAttributes()
        node.position = np.mean([one.position_m for one in scene.regions if one.id in set(regions)], axis=0)
        node.last_update_time_ns = scene.stamp_ns
        node.name = next(one.label for one in found if one.id == number) if several else scene.environment
        _add(graph, spark_dsg.DsgLayers.BUILDINGS, BUILDING, number, node)
        for region in regions:
            graph.insert_edge(_symbol(BUILDING, number), _symbol(ROOM, region), enforce_single_parent=True)


def _label_node(
    node: spark_dsg.SemanticNodeAttributes, label: str, scene: Scene, colors: dict[str, tuple[int, int, int]]
) -> None:
    if label in scene.labels:
        node.semantic_label = scene.labels.index(label)
    if label in colors:
        node.color = np.array(colors[label], np.uint8)


def _add(graph: spark_dsg.DynamicSceneGraph, layer: str, prefix: str, index: int, node: Any) -> None:
    """Spark-DSG refuses a node without an error: make it one."""
    if not graph.add_node(layer, _symbol(prefix, index), node):
        raise ValueError(f"Spark-DSG does not take node {prefix}{index}")


def _symbol(prefix: str, index: int) -> spark_dsg.NodeSymbol:
    return spark_dsg.NodeSymbol(prefix, index)

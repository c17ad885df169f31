"""A scene graph as plain JSON, as a Spark-DSG graph, and as a picture.

`scene_json` (lists sorted by id, metres, world with z up, null where nothing is known yet):

    robot, stamp_ns, environment, task, prior_digest, embedding_space
    labels        [label]                         columns of every posterior
    regions       [{id, label, parent, probability, unknown, predicted, area_m2, position_m [x, y, z], hull_m [[x, y]],
                    places [id], objects [id], adjacent [region id],
                    transitions [{region, edge [place id inside, outside], position_m, clearance_m, door}]}]
    places        [{id, position_m [x, y, z], radius_m, region, label, posterior {label: p}, unknown, predicted}]
    edges         [{a, b, clearance_m}]           between places
    trajectory_m  [[x, y, z]]                     camera centres in order of time

Two regions are adjacent when an edge joins a place of one with a place of the other.
"""

import json
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import spark_dsg

from deploy.evaluation.metrics import GroundTruth
from deploy.map_image import draw_map, label_colors
from schemas.places import VoxelMap
from schemas.regions import Region
from schemas.scene import Scene

NO_REGION = -1
DECIMALS = 4  # a tenth of a millimetre, a hundredth of a percent
PLACE, ROOM, BUILDING = "p", "R", "B"  # node prefixes of Spark-DSG


def scene_json(scene: Scene) -> dict[str, Any]:
    """The scene as dictionaries, lists, numbers and text only; layout above."""
    names = {region.id: region.label for region in scene.regions}
    adjacent = _adjacent(scene)
    members = _members(scene)
    predicted = set(scene.predicted_ids.tolist())
    return {
        "robot": scene.robot,
        "stamp_ns": scene.stamp_ns,
        "environment": scene.environment,
        "task": scene.task,
        "prior_digest": scene.prior_digest,
        "embedding_space": scene.space,
        "labels": list(scene.labels),
        "regions": [
            {
                "id": region.id,
                "label": region.label,
                "parent": region.parent,
                "probability": _short(region.probability),
                "unknown": _short(region.unknown),
                "predicted": region.predicted,
                "area_m2": _short(region.area_m2),
                "position_m": _short(region.position_m),
                "hull_m": _short(region.hull_m),
                "places": scene.place_ids[members[region.id]].tolist(),
                "objects": region.object_ids,
                "transitions": [msgspec.to_builtins(way) for way in region.transitions],
                "adjacent": sorted(b if a == region.id else a for a, b in adjacent if region.id in (a, b)),
            }
            for region in scene.regions
        ],
        "places": [_place_json(scene, row, names, predicted) for row in range(len(scene.place_ids))],
        "edges": [
            {"a": a, "b": b, "clearance_m": _short(clearance_m)}
            for (a, b), clearance_m in zip(scene.edges.tolist(), scene.clearances_m, strict=True)
        ],
        "trajectory_m": _short(scene.trajectory),
    }


def _place_json(scene: Scene, row: int, names: dict[int, str], predicted: set[int]) -> dict[str, Any]:
    region = int(scene.place_regions[row])
    posterior = scene.posteriors[row]
    return {
        "id": int(scene.place_ids[row]),
        "position_m": _short(scene.positions_m[row]),
        "radius_m": _short(scene.radii_m[row]),
        "region": None if region == NO_REGION else region,
        "label": names.get(region),
        "posterior": dict(zip(scene.labels, _short(posterior), strict=True)) if posterior.any() else None,
        "unknown": _short(scene.unknown[row]),
        "predicted": int(scene.place_ids[row]) in predicted,
    }


def save_json(scene: Scene, path: str | Path) -> None:
    """Write `scene_json`, indented. Raises OSError."""
    Path(path).write_text(json.dumps(scene_json(scene), indent=1) + "\n")


def spark_dsg_graph(scene: Scene) -> spark_dsg.DynamicSceneGraph:
    """The scene in Spark-DSG's layers: places, rooms above them, one building above the rooms.

    A place keeps its radius as `distance`, a room the mean posterior of its places as `semantic_class_probabilities`;
    what Spark-DSG has no field for stands in the nodes' and the graph's metadata. Edges between places weigh their
    clearance; rooms are joined where their places are. Labels are numbered as in `scene.labels`.
    """
    graph = spark_dsg.DynamicSceneGraph()
    colors = label_colors(scene)
    for row in range(len(scene.place_ids)):
        _add(graph, spark_dsg.DsgLayers.PLACES, PLACE, int(scene.place_ids[row]), _place_node(scene, row, colors))
    for (a, b), clearance_m in zip(scene.edges.tolist(), scene.clearances_m.tolist(), strict=True):
        weight = spark_dsg.EdgeAttributes()
        weight.weighted, weight.weight = True, clearance_m
        graph.insert_edge(_symbol(PLACE, a), _symbol(PLACE, b), weight)
    members = _members(scene)
    for region in scene.regions:
        rows = members[region.id]
        _add(graph, spark_dsg.DsgLayers.ROOMS, ROOM, region.id, _room_node(scene, region, rows, colors))
        for place in scene.place_ids[rows].tolist():
            graph.insert_edge(_symbol(ROOM, region.id), _symbol(PLACE, place), enforce_single_parent=True)
    for a, b in sorted(_adjacent(scene)):
        graph.insert_edge(_symbol(ROOM, a), _symbol(ROOM, b))
    if scene.regions:
        _add(graph, spark_dsg.DsgLayers.BUILDINGS, BUILDING, 0, _building_node(scene))
        for region in scene.regions:
            graph.insert_edge(_symbol(BUILDING, 0), _symbol(ROOM, region.id), enforce_single_parent=True)
    about = {"robot": scene.robot, "environment": scene.environment, "task": scene.task}
    graph.metadata.set(about | {"prior_digest": scene.prior_digest, "embedding_space": scene.space})
    labelspace = spark_dsg.Labelspace(dict(enumerate(scene.labels)))  # kept in the metadata, hence after them
    for layer in (spark_dsg.DsgLayers.PLACES, spark_dsg.DsgLayers.ROOMS):
        graph.set_labelspace(labelspace, graph.get_layer_key(layer).layer, 0)
    return graph


def save_spark_dsg(scene: Scene, path: str | Path) -> None:
    """Write a file that `DynamicSceneGraph.load` reads: JSON, or binary when the name ends in `.sparkdsg`."""
    spark_dsg_graph(scene).save(str(path), include_mesh=False)


def map_png(scene: Scene, voxel_map: VoxelMap | None, path: str | Path, truth: GroundTruth | None = None) -> None:
    """Write the scene from above as a PNG picture, with ground truth dashed where given. Raises OSError."""
    outlines = [region.polygon_m for region in truth.regions] if truth else []
    Path(path).write_bytes(draw_map(scene, voxel_map, outlines))


def _place_node(scene: Scene, row: int, colors: dict[str, tuple[int, int, int]]) -> spark_dsg.PlaceNodeAttributes:
    names = {region.id: region.label for region in scene.regions}
    label = names.get(int(scene.place_regions[row]), "")
    node = spark_dsg.PlaceNodeAttributes()
    node.position = scene.positions_m[row].astype(float)
    node.distance = float(scene.radii_m[row])
    node.num_basis_points = int(scene.basis_points[row])
    node.last_update_time_ns = scene.stamp_ns
    node.name = str(_symbol(PLACE, int(scene.place_ids[row])))
    node.metadata.set({"label": label, "unknown": float(scene.unknown[row])})
    _label_node(node, label, scene, colors)
    return node


def _room_node(
    scene: Scene, region: Region, rows: np.ndarray, colors: dict[str, tuple[int, int, int]]
) -> spark_dsg.RoomNodeAttributes:
    node = spark_dsg.RoomNodeAttributes()
    node.position = np.array(region.position_m)
    node.last_update_time_ns = scene.stamp_ns
    node.name = region.label
    node.metadata.set({"area_m2": region.area_m2, "probability": region.probability})
    _label_node(node, region.label, scene, colors)
    if len(rows):
        posterior = scene.posteriors[rows].astype(float).mean(axis=0)
        node.semantic_class_probabilities = dict(zip(scene.labels, posterior.tolist(), strict=True))
        low = (scene.positions_m[rows] - scene.radii_m[rows, None]).min(axis=0)
        high = (scene.positions_m[rows] + scene.radii_m[rows, None]).max(axis=0)
        node.bounding_box = spark_dsg.BoundingBox(high - low, (high + low) / 2)
    return node


def _building_node(scene: Scene) -> spark_dsg.SemanticNodeAttributes:
    node = spark_dsg.SemanticNodeAttributes()
    node.position = np.mean([region.position_m for region in scene.regions], axis=0)
    node.last_update_time_ns = scene.stamp_ns
    node.name = scene.environment
    return node


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


def _members(scene: Scene) -> dict[int, np.ndarray]:
    """Rows of the places of each listed region."""
    return {region.id: np.flatnonzero(scene.place_regions == region.id) for region in scene.regions}


def _adjacent(scene: Scene) -> set[tuple[int, int]]:
    """Pairs of listed regions (smaller id first) that an edge between places joins."""
    region_of = dict(zip(scene.place_ids.tolist(), scene.place_regions.tolist(), strict=True))
    known = {region.id for region in scene.regions}
    pairs = {tuple(sorted((region_of[a], region_of[b]))) for a, b in scene.edges.tolist()}
    return {(a, b) for a, b in pairs if a != b and a in known and b in known}


def _short(value: Any) -> Any:
    """Numbers as plain floats of few digits, in (nested) lists for arrays."""
    rounded = np.round(np.asarray(value, float), DECIMALS)
    return rounded.tolist()

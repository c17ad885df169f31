"""A scene graph as plain JSON, as a Spark-DSG graph, and as a picture.

`scene_json` (lists sorted by id, metres, world with z up, null where nothing is known yet):

    origin_m      [x, y, z]                       of this world in the source's: add it to any position
    robot, stamp_ns, environment, task, prior_digest, embedding_space
    labels        [label]                         columns of every posterior
    regions       [{id, label, parent, probability, unknown, predicted, area_m2, position_m [x, y, z], hull_m [[x, y]],
                    places [id], objects [id], adjacent [region id],
                    transitions [{region, edge [place id inside, outside], position_m, clearance_m, door}]}]
    zones         [{label, regions [id]}]         layer above: adjacent regions whose labels share a parent in the prior
    places        [{id, position_m [x, y, z], radius_m, region, label, posterior {label: p}, unknown, predicted,
                    frontier {direction [x, y, z], area_m2}, ellipse {half_axes_m, angle_rad}, hull_m [[x, y]]}]
    objects       [{id, label, probability, known, position_m, min_m, max_m, frames, place}]   place = the nearest
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

from prior_sg.deploy.showing.map import draw_map, label_colors
from prior_sg.deploy.showing.places import draw_places
from prior_sg.deploy.truth import GroundTruth
from prior_sg.schemas.objects import SceneObject
from prior_sg.schemas.places import VoxelMap
from prior_sg.schemas.regions import NO_REGION, Region
from prior_sg.schemas.scene import Scene

DECIMALS = 4  # a tenth of a millimetre, a hundredth of a percent
OBJECT, PLACE, PLACE_2D, ROOM, BUILDING = "O", "p", "P", "R", "B"  # node prefixes of Spark-DSG


def scene_json(scene: Scene) -> dict[str, Any]:
    """The scene as dictionaries, lists, numbers and text only; layout above."""
    names = {region.id: region.label for region in scene.regions}
    adjacent = _adjacent(scene)
    members = _members(scene)
    predicted = set(scene.predicted_ids.tolist())
    frontiers, surfaces = _frontiers(scene), _surfaces(scene)
    return {
        "robot": scene.robot,
        "stamp_ns": scene.stamp_ns,
        "environment": scene.environment,
        "task": scene.task,
        "prior_digest": scene.prior_digest,
        "embedding_space": scene.space,
        "origin_m": list(scene.origin_m),
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
        "zones": [{"label": label, "regions": ids} for label, ids in zones(scene)],
        "places": [
            _place_json(scene, row, names, predicted)
            | _opening_json(frontiers.get(place_id))
            | _ground_json(surfaces.get(place_id))
            for row, place_id in enumerate(scene.place_ids.tolist())
        ],
        "objects": [_object_json(item, place) for item, place in _placed(scene)],
        "edges": [
            {"a": a, "b": b, "clearance_m": _short(clearance_m)}
            for (a, b), clearance_m in zip(scene.edges.tolist(), scene.clearances_m, strict=True)
        ],
        "trajectory_m": _short(scene.trajectory),
    }


def _object_json(item: SceneObject, place: int | None) -> dict[str, Any]:
    return {
        "id": item.id,
        "label": item.label or None,
        "probability": _short(item.probability),
        "known": _short(item.known),
        "position_m": _short(item.position_m),
        "min_m": _short(item.min_m),
        "max_m": _short(item.max_m),
        "frames": item.frames,
        "place": place,
    }


def _placed(scene: Scene) -> list[tuple[SceneObject, int | None]]:
    """Each object with the id of its nearest place."""
    placed: list[tuple[SceneObject, int | None]] = []
    for item in scene.objects:
        distances_m = np.linalg.norm(scene.positions_m - np.array(item.position_m, np.float32), axis=1)
        placed.append((item, int(scene.place_ids[distances_m.argmin()]) if len(distances_m) else None))
    return placed


def zones(scene: Scene) -> list[tuple[str, list[int]]]:
    """The layer above the regions: label and region ids of each connected set of regions with one parent, sorted by
    the smallest id. Regions without a parent belong to none.
    """
    parents = {region.id: region.parent for region in scene.regions if region.parent}
    zone_of = {region: region for region in parents}
    for a, b in sorted(_adjacent(scene)):
        if a in parents and b in parents and parents[a] == parents[b]:
            kept, gone = sorted((zone_of[a], zone_of[b]))
            zone_of = {region: kept if zone == gone else zone for region, zone in zone_of.items()}
    members: dict[int, list[int]] = {}
    for region, zone in sorted(zone_of.items()):
        members.setdefault(zone, []).append(region)
    return [(parents[zone], ids) for zone, ids in sorted(members.items())]


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


def _opening_json(opening: tuple[np.ndarray, float] | None) -> dict[str, Any]:
    if opening is None:
        return {"frontier": None}
    return {"frontier": {"direction": _short(opening[0]), "area_m2": _short(opening[1])}}


def _ground_json(surface: tuple[np.ndarray, np.ndarray] | None) -> dict[str, Any]:
    if surface is None:
        return {"ellipse": None, "hull_m": []}
    (long_m, short_m, angle_rad), hull_m = surface
    ellipse = {"half_axes_m": _short((long_m, short_m)), "angle_rad": _short(angle_rad)}
    return {"ellipse": ellipse, "hull_m": _short(hull_m)}


def _frontiers(scene: Scene) -> dict[int, tuple[np.ndarray, float]]:
    """Direction and area of each opening, by place id."""
    columns = (scene.frontier_ids.tolist(), scene.frontier_directions, scene.frontier_areas_m2.tolist())
    return {place: (direction, area_m2) for place, direction, area_m2 in zip(*columns, strict=True)}


def _surfaces(scene: Scene) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Ellipse (half axes, angle) and hull (n, 2) of each 2D place, by place id."""
    hulls = np.split(scene.hulls_m, np.cumsum(scene.hull_counts)[:-1])
    return dict(zip(scene.surface_ids.tolist(), zip(scene.ellipses, hulls, strict=False), strict=True))


def save_json(scene: Scene, path: str | Path) -> None:
    """Write `scene_json`, indented. Raises OSError."""
    Path(path).write_text(json.dumps(scene_json(scene), indent=1) + "\n")


def spark_dsg_graph(scene: Scene) -> spark_dsg.DynamicSceneGraph:
    """The scene in Spark-DSG's layers: objects, places above them, rooms, one building above the rooms.

    A place keeps its radius as `distance`, a room the mean posterior of its places as `semantic_class_probabilities`;
    what Spark-DSG has no field for stands in the nodes' and the graph's metadata. Edges between places weigh their
    clearance; rooms are joined where their places are. Labels are numbered as in `scene.labels`.
    """
    graph = spark_dsg.DynamicSceneGraph()
    colors = label_colors(scene)
    surfaces = _surfaces(scene)
    prefix = PLACE_2D if surfaces else PLACE
    layer = "MESH_PLACES" if surfaces else spark_dsg.DsgLayers.PLACES
    if surfaces:
        graph.add_layer(3, 1, layer)
    for row, place in enumerate(scene.place_ids.tolist()):
        node = _ground_node(scene, row, surfaces[place]) if place in surfaces else _place_node(scene, row)
        _describe_place(node, scene, row, prefix, colors)
        _add(graph, layer, prefix, place, node)
    for (a, b), clearance_m in zip(scene.edges.tolist(), scene.clearances_m.tolist(), strict=True):
        weight = spark_dsg.EdgeAttributes()
        weight.weighted, weight.weight = True, clearance_m
        graph.insert_edge(_symbol(prefix, a), _symbol(prefix, b), weight)
    for item, place in _placed(scene):
        _add(graph, spark_dsg.DsgLayers.OBJECTS, OBJECT, item.id, _object_node(scene, item))
        if place is not None:
            graph.insert_edge(_symbol(prefix, place), _symbol(OBJECT, item.id), enforce_single_parent=True)
    members = _members(scene)
    for region in scene.regions:
        rows = members[region.id]
        _add(graph, spark_dsg.DsgLayers.ROOMS, ROOM, region.id, _room_node(scene, region, rows, colors))
        for place in scene.place_ids[rows].tolist():
            graph.insert_edge(_symbol(ROOM, region.id), _symbol(prefix, place), enforce_single_parent=True)
    for a, b in sorted(_adjacent(scene)):
        graph.insert_edge(_symbol(ROOM, a), _symbol(ROOM, b))
    if scene.regions:
        _add(graph, spark_dsg.DsgLayers.BUILDINGS, BUILDING, 0, _building_node(scene))
        for region in scene.regions:
            graph.insert_edge(_symbol(BUILDING, 0), _symbol(ROOM, region.id), enforce_single_parent=True)
    about = {"robot": scene.robot, "environment": scene.environment, "task": scene.task}
    graph.metadata.set(
        about | {"prior_digest": scene.prior_digest, "embedding_space": scene.space, "origin_m": list(scene.origin_m)}
    )
    labelspace = spark_dsg.Labelspace(dict(enumerate(scene.labels)))  # kept in the metadata, hence after them
    for named in (layer, spark_dsg.DsgLayers.ROOMS):
        key = graph.get_layer_key(named)
        graph.set_labelspace(labelspace, key.layer, key.partition)
    return graph


def save_spark_dsg(scene: Scene, path: str | Path) -> None:
    """Write a file that `DynamicSceneGraph.load` reads: JSON, or binary when the name ends in `.sparkdsg`."""
    spark_dsg_graph(scene).save(str(path), include_mesh=False)


def map_png(scene: Scene, voxel_map: VoxelMap | None, path: str | Path, truth: GroundTruth | None = None) -> None:
    """Write the scene from above as a PNG picture, with ground truth dashed where given. Raises OSError."""
    outlines = [region.polygon_m for region in truth.regions] if truth else []
    Path(path).write_bytes(draw_map(scene, voxel_map, outlines))


def places_png(scene: Scene, voxel_map: VoxelMap | None, path: str | Path) -> None:
    """Write places, edges and openings in three dimensions as a PNG picture. Raises OSError."""
    Path(path).write_bytes(draw_places(scene, voxel_map))


def _place_node(scene: Scene, row: int) -> spark_dsg.PlaceNodeAttributes:
    """A sphere; one beside unobserved space is an active frontier whose x axis leads there."""
    node = spark_dsg.PlaceNodeAttributes()
    node.distance = float(scene.radii_m[row])
    node.num_basis_points = int(scene.basis_points[row])
    node.real_place = True
    opening = np.flatnonzero(scene.frontier_ids == scene.place_ids[row])
    if len(opening):
        x, y, z = scene.frontier_directions[opening[0]].astype(float)
        side_m = float(scene.frontier_areas_m2[opening[0]]) ** 0.5
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
    prefix: str,
    colors: dict[str, tuple[int, int, int]],
) -> None:
    """What places of both kinds tell."""
    names = {region.id: region.label for region in scene.regions}
    label = names.get(int(scene.place_regions[row]), "")
    node.position = scene.positions_m[row].astype(float)
    node.last_update_time_ns = scene.stamp_ns
    node.name = str(_symbol(prefix, int(scene.place_ids[row])))
    node.metadata.set({"label": label, "unknown": float(scene.unknown[row])})
    _label_node(node, label, scene, colors)


def _object_node(scene: Scene, item: SceneObject) -> spark_dsg.ObjectNodeAttributes:
    node = spark_dsg.ObjectNodeAttributes()
    node.position = np.array(item.position_m)
    node.last_update_time_ns = scene.stamp_ns
    node.name = item.label
    low_m, high_m = np.array(item.min_m), np.array(item.max_m)
    node.bounding_box = spark_dsg.BoundingBox(high_m - low_m, (high_m + low_m) / 2)
    node.registered = True
    node.metadata.set({"probability": item.probability, "known": item.known, "frames": item.frames})
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

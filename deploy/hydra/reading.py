"""A message of Hydra's ZmqSink as columns: Spark-DSG's binary form of a whole graph, without a header."""

import re
from collections.abc import Iterator
from datetime import timedelta
from importlib.metadata import version
from typing import Any, NamedTuple

import numpy as np
import spark_dsg

from prior_sg.deploy.hydra.core.graph import MOST_M, NO_ROOM, HydraGraph
from prior_sg.deploy.showing.dsg import MESH_PLACES, OBJECT, PLACE, PLACE_2D
from prior_sg.deploy.showing.dsg_reading import (
    LAYERS,
    Item,
    basis_points_of,
    ground_of,
    object_of,
    opening_of,
    radius_m_of,
)
from prior_sg.schemas.objects import SceneObject
from prior_sg.services.geometry import pose_from_quaternion

INDEX_BITS = 56  # of a symbol's value; the rest is its letter
MOST_BASIS_POINTS, MOST_NS = 2**15 - 1, 2**63 - 1
PLACE_IN_CODE = re.compile(r"^\[[^]]*\] ")
AGENT, SEMANTIC = spark_dsg.AgentNodeAttributes, spark_dsg.SemanticNodeAttributes
MICROSECOND = timedelta(microseconds=1)
SOUND_AGENT = 1e-3  # by which a quaternion's length may differ from 1


class Place(NamedTuple):
    """What is taken of one place."""

    id: int
    symbol: int
    parent: int  # the value of the symbol above it, NO_ROOM = none
    stamp_ns: int
    position_m: list[float]
    radius_m: float
    basis_points: int
    opening: tuple[np.ndarray, float] | None  # direction, area
    surface: tuple[tuple[float, float, float], np.ndarray] | None  # ellipse, hull


class NotAGraph(ValueError):
    """The bytes are no graph of this version of Spark-DSG; one sentence."""


def read_graph(payload: bytes, robot: str) -> HydraGraph:
    """The columns of one message. Raises NotAGraph."""
    try:
        graph = spark_dsg.DynamicSceneGraph.from_binary(payload)
    except Exception as error:  # whatever the bindings raise on foreign bytes
        why = PLACE_IN_CODE.sub("", str(error).splitlines()[0]) if str(error) else type(error).__name__
        raise NotAGraph(f"{len(payload)} bytes are no graph of Spark-DSG {version('spark-dsg')}: {why}") from error
    return graph_columns(graph, robot)


def graph_columns(graph: spark_dsg.DynamicSceneGraph, robot: str) -> HydraGraph:
    """Places of the layer PLACES, else of MESH_PLACES, with the rooms above them; objects; agents of every robot."""
    items = _items(graph, LAYERS.PLACES, PLACE) or _items(graph, MESH_PLACES, PLACE_2D)
    places = [found for item in items if (found := _place(item)) is not None]
    rooms = {signed(node.id.value) for node in _nodes(graph, LAYERS.ROOMS)}
    things = [item for item in _items(graph, LAYERS.OBJECTS, OBJECT) if isinstance(item.node.attributes, SEMANTIC)]
    objects = [thing for item in things if (thing := _object(graph, item)) is not None]
    agents = list(_agents(graph))
    return HydraGraph(
        robot=robot,
        stamp_ns=max((place.stamp_ns for place in places), default=0),
        room_ids=np.array(sorted(rooms), np.int64),
        objects=objects,
        agent_stamps_ns=np.array([stamp_ns for stamp_ns, _ in agents], np.int64),
        world_from_agent=np.array([pose for _, pose in agents], float).reshape(-1, 4, 4),
        left_out=len(items) - len(places) + len(things) - len(objects),
        **_place_columns(places, rooms),
        **_edge_columns(graph, items, places),
    )


def signed(value: int) -> int:
    """A symbol's value as a whole number of 64 bits with a sign."""
    return value - 2**64 if value >= 2**63 else value


def _nodes(graph: spark_dsg.DynamicSceneGraph, layer: str) -> list[spark_dsg.SceneGraphNode]:
    return list(graph.get_layer(layer).nodes) if layer in graph.layer_names else []


def _items(graph: spark_dsg.DynamicSceneGraph, layer: str, letter: str) -> list[Item]:
    """Nodes by ascending number: that in their symbol if it has the layer's usual letter, else the symbol's value. So
    a node keeps its number whatever comes beside it."""
    items = []
    for node in _nodes(graph, layer):
        value = node.id.value
        usual = value >> INDEX_BITS == ord(letter)
        items.append(Item(value & (1 << INDEX_BITS) - 1 if usual else signed(value), node, {}))
    return sorted(items, key=lambda item: item.id)


def _place(item: Item) -> Place | None:
    """One place; None where its numbers are not finite, or absurd."""
    attributes = item.node.attributes
    position_m, radius_m = attributes.position.tolist(), radius_m_of(item)
    opening, surface = opening_of(item), ground_of(item)
    numbers = [*position_m, radius_m]
    if opening is not None:
        numbers += [*opening[0].tolist(), opening[1]]
    if surface is not None:
        numbers += [*surface[0], *surface[1].ravel().tolist()]
    if radius_m < 0 or not all(abs(number) < MOST_M for number in numbers):  # not a number is no less
        return None
    return Place(
        id=item.id,
        symbol=item.node.id.value,
        parent=signed(item.node.get_parent()) if item.node.has_parent() else NO_ROOM,
        stamp_ns=int(attributes.last_update_time_ns) & MOST_NS,
        position_m=position_m,
        radius_m=radius_m,
        basis_points=min(basis_points_of(item), MOST_BASIS_POINTS),
        opening=opening,
        surface=surface,
    )


def _object(graph: spark_dsg.DynamicSceneGraph, item: Item) -> SceneObject | None:
    try:
        found = object_of(graph, item)
    except ValueError:  # its numbers are not finite
        return None
    corners_m = np.array((found.position_m, found.min_m, found.max_m))
    return found if bool((np.abs(corners_m) < MOST_M).all()) else None


def _place_columns(places: list[Place], rooms: set[int]) -> dict[str, Any]:
    openings = [(place.id, *place.opening) for place in places if place.opening is not None]
    surfaces = [(place.id, *place.surface) for place in places if place.surface is not None]
    return {
        "place_ids": np.array([place.id for place in places], np.int64),
        "positions_m": np.array([place.position_m for place in places], float).reshape(-1, 3),
        "radii_m": np.array([place.radius_m for place in places], float),
        "basis_points": np.array([place.basis_points for place in places], np.int16),
        "place_rooms": np.array([place.parent if place.parent in rooms else NO_ROOM for place in places], np.int64),
        "frontier_ids": np.array([place for place, _, _ in openings], np.int64),
        "frontier_directions": np.array([way for _, way, _ in openings], float).reshape(-1, 3),
        "frontier_areas_m2": np.array([area_m2 for _, _, area_m2 in openings], float),
        "surface_ids": np.array([place for place, _, _ in surfaces], np.int64),
        "ellipses": np.array([ellipse for _, ellipse, _ in surfaces], float).reshape(-1, 3),
        "hull_counts": np.array([len(hull) for _, _, hull in surfaces], np.int64),
        "hulls_m": np.concatenate([np.zeros((0, 2)), *(hull for _, _, hull in surfaces)]),
    }


def _edge_columns(graph: spark_dsg.DynamicSceneGraph, items: list[Item], places: list[Place]) -> dict[str, Any]:
    """Edges between places that are there. One without a usable weight is as wide as the smaller of its ends."""
    ends = {place.symbol: place for place in places}
    found: dict[tuple[int, int], float] = {}
    layer = items[0].node.layer if items else None
    for way in [] if layer is None else graph.get_layer(layer.layer, layer.partition).edges:
        one, two = ends.get(way.source), ends.get(way.target)
        if one is not None and two is not None and one is not two:
            info = way.info
            weight = info.weight if info.weighted else -1.0
            pair = (one.id, two.id) if one.id < two.id else (two.id, one.id)
            found[pair] = weight if 0 <= weight < MOST_M else min(one.radius_m, two.radius_m)
    ordered = sorted(found.items())
    return {
        "edges": np.array([pair for pair, _ in ordered], np.int64).reshape(-1, 2),
        "clearances_m": np.array([clearance_m for _, clearance_m in ordered], float),
    }


def _agents(graph: spark_dsg.DynamicSceneGraph) -> Iterator[tuple[int, np.ndarray]]:
    """Time and pose of each agent node, of the robot with the smallest letter: others go their own ways."""
    views = (*graph.layer_partitions, *graph.layers)
    nodes = [node for view in views for node in view.nodes if isinstance(node.attributes, AGENT)]
    letter = min((node.id.value >> INDEX_BITS for node in nodes), default=0)
    for node in nodes:
        attributes, turn = node.attributes, node.attributes.world_R_body
        quaternion = np.array((turn.x, turn.y, turn.z, turn.w))
        position_m = np.asarray(attributes.position, float)
        unit = abs(float(np.linalg.norm(quaternion)) - 1) < SOUND_AGENT  # not a number is no less
        if node.id.value >> INDEX_BITS == letter and unit and bool((np.abs(position_m) < MOST_M).all()):
            yield attributes.timestamp // MICROSECOND * 1000, pose_from_quaternion(position_m, quaternion)

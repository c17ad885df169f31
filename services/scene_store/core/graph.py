"""The stored scene graph of each robot, and what deltas make of it (pure).

Three streams are mirrored independently, places, regions and objects; they meet only in `telling.py::scene`. So a
belief about a place that has not arrived yet is kept, and is listed as soon as the place exists.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import msgspec
import numpy as np

from prior_sg.schemas.foresight import Foresight
from prior_sg.schemas.levels import LevelName, LevelNode
from prior_sg.schemas.markers import MarkerKey, SceneMarker
from prior_sg.schemas.objects import ObjectDelta, SceneObject
from prior_sg.schemas.places import PlaceDelta
from prior_sg.schemas.priors import Task
from prior_sg.schemas.regions import Region, RegionDelta
from prior_sg.services.refusals import fault_of_stamp

Edge = tuple[int, int]


class Place(NamedTuple):
    """One free-space sphere; world, metres."""

    position_m: tuple[float, float, float]
    radius_m: float
    basis_points: int


class Belief(NamedTuple):
    """What the segmenter holds about one place; the posterior has one entry per label."""

    region: int
    posterior: np.ndarray  # (label,) float16
    unknown: float
    predicted: bool = False


class Sighting(NamedTuple):
    """Camera centre of one keyframe (world, metres), and which delta said so."""

    epoch: int
    revision: int
    camera_m: tuple[float, float, float]


@dataclass
class Cursor:
    """The last delta of one writer that is part of the graph; epoch -1 = none yet."""

    epoch: int = -1
    revision: int = -1
    stamp_ns: int = 0


class Alignment(NamedTuple):
    """What the regions of a robot were made from."""

    prior_digest: str = ""
    environment: str = ""
    task: str = ""
    space: str = ""
    labels: tuple[str, ...] = ()
    energy: float = 0.0


@dataclass
class Graph:
    """Everything known about one robot. Changes in place, only through the functions of this module."""

    robot: str
    places: dict[int, Place] = field(default_factory=dict)
    frontiers: dict[int, np.ndarray] = field(default_factory=dict)  # by place id: direction and area, (4,) float32
    surfaces: dict[int, np.ndarray] = field(default_factory=dict)  # by place id: ellipse, then hull, flat float32
    edges: dict[Edge, float] = field(default_factory=dict)  # smaller id first; clearance in metres
    neighbours: dict[int, set[int]] = field(default_factory=dict)
    sightings: dict[int, Sighting] = field(default_factory=dict)  # by frame id
    regions: dict[int, Region] = field(default_factory=dict)
    nodes: dict[tuple[LevelName, int], LevelNode] = field(default_factory=dict)  # of the levels above regions
    beliefs: dict[int, Belief] = field(default_factory=dict)  # by place id
    objects: dict[int, SceneObject] = field(default_factory=dict)
    markers: dict[MarkerKey, SceneMarker] = field(default_factory=dict)
    alignment: Alignment = field(default_factory=Alignment)
    foresight: Foresight = field(default_factory=Foresight)
    task: Task | None = None
    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of the world, as the place graph says
    merged_of: tuple[str, ...] = ()  # robots, as the place graph says
    place_cursor: Cursor = field(default_factory=Cursor)
    region_cursor: Cursor = field(default_factory=Cursor)
    object_cursor: Cursor = field(default_factory=Cursor)
    revision: int = -1


@dataclass
class Changes:
    """Ids that a delta touched; the graph says what became of each (absent = removed).

    With `replaced`, everything of that writer was dropped first.
    """

    replaced: bool = False
    places: set[int] = field(default_factory=set)
    edges: set[Edge] = field(default_factory=set)
    regions: set[int] = field(default_factory=set)
    beliefs: set[int] = field(default_factory=set)
    objects: set[int] = field(default_factory=set)


def apply_places(graph: Graph, delta: PlaceDelta) -> Changes:
    """Apply one place delta, in the order its schema states. A snapshot or a new writer replaces the place graph."""
    changes = Changes(replaced=delta.snapshot or delta.epoch != graph.place_cursor.epoch)
    if changes.replaced:
        graph.places.clear()
        graph.frontiers.clear()
        graph.surfaces.clear()
        graph.edges.clear()
        graph.neighbours.clear()
        graph.sightings = {frame: seen for frame, seen in graph.sightings.items() if seen.epoch >= delta.epoch}
    for a, b in delta.removed_edges.tolist():
        _remove_edge(graph, a, b, changes)
    for place in delta.removed_ids.tolist():
        _remove_place(graph, place, changes)
    for gone, into in delta.merged_ids.tolist():
        _merge_place(graph, gone, into, changes)
    columns = (delta.place_ids, delta.positions_m, delta.radii_m, delta.basis_points)
    for place, position_m, radius_m, basis in zip(*(column.tolist() for column in columns), strict=True):
        graph.places[place] = Place(tuple(position_m), radius_m, basis)
        changes.places.add(place)
    for (a, b), clearance_m in zip(delta.edges.tolist(), delta.clearances_m.tolist(), strict=True):
        _put_edge(graph, a, b, clearance_m, changes)
    _put_details(graph, delta, changes)
    graph.origin_m, graph.merged_of = delta.origin_m, tuple(delta.merged_of)
    graph.place_cursor = Cursor(delta.epoch, delta.revision, delta.stamp_ns)
    graph.revision += 1
    return changes


def _put_details(graph: Graph, delta: PlaceDelta, changes: Changes) -> None:
    """What a delta says about openings and ground of its places; an opening of no area is closed."""
    openings = np.concatenate((delta.frontier_directions, delta.frontier_areas_m2[:, None]), axis=1)
    for place, opening in zip(delta.frontier_ids.tolist(), openings, strict=True):
        graph.frontiers.pop(place, None)
        if opening[3] > 0 and place in graph.places:
            graph.frontiers[place] = opening.copy()
        changes.places.add(place)
    hulls = np.split(delta.hulls_m, np.cumsum(delta.hull_counts)[:-1])
    for place, ellipse, hull in zip(delta.surface_ids.tolist(), delta.ellipses, hulls, strict=False):
        if place in graph.places:
            graph.surfaces[place] = np.concatenate((ellipse, hull.ravel()))
            changes.places.add(place)


def apply_regions(graph: Graph, delta: RegionDelta) -> Changes:
    """Apply one region delta, in the order its schema states. A snapshot or a new writer replaces all regions.

    Posteriors over other labels cannot be compared with the new ones: when the labels change, they are dropped.
    """
    changes = Changes(replaced=delta.snapshot or delta.epoch != graph.region_cursor.epoch)
    if changes.replaced:
        graph.regions.clear()
        graph.nodes.clear()
        graph.beliefs.clear()
        graph.foresight = Foresight()
    elif tuple(delta.labels) != graph.alignment.labels:
        changes.beliefs.update(graph.beliefs)
        graph.beliefs.clear()
    if delta.foresight is not None:
        graph.foresight = delta.foresight
    for place in delta.removed_place_ids.tolist():
        graph.beliefs.pop(place, None)
        changes.beliefs.add(place)
    for region in delta.removed_ids.tolist():
        graph.regions.pop(region, None)
        changes.regions.add(region)
    for entry in delta.regions:
        graph.regions[entry.id] = entry
        changes.regions.add(entry.id)
    for key in delta.removed_nodes:
        graph.nodes.pop(key, None)
    graph.nodes.update({(node.level, node.id): node for node in delta.nodes})
    columns = (delta.place_ids.tolist(), delta.place_regions.tolist(), delta.posteriors, delta.unknown.tolist())
    predicted = set(delta.predicted_ids.tolist())
    for place, region, posterior, unknown in zip(*columns, strict=True):
        graph.beliefs[place] = Belief(region, posterior.copy(), unknown, place in predicted)
        changes.beliefs.add(place)
    graph.alignment = Alignment(
        delta.prior_digest, delta.environment, delta.task, delta.space, tuple(delta.labels), delta.energy
    )
    graph.region_cursor = Cursor(delta.epoch, delta.revision, delta.stamp_ns)
    graph.revision += 1
    return changes


def apply_objects(graph: Graph, delta: ObjectDelta) -> Changes:
    """Apply one object delta, in the order its schema states. A snapshot or a new writer replaces all objects."""
    changes = Changes(replaced=delta.snapshot or delta.epoch != graph.object_cursor.epoch)
    if changes.replaced:
        graph.objects.clear()
        graph.markers.clear()
    for gone in [*delta.removed_ids.tolist(), *delta.merged_ids[:, 0].tolist()]:
        graph.objects.pop(gone, None)
        changes.objects.add(gone)
    for entry in delta.objects:
        graph.objects[entry.id] = entry
        changes.objects.add(entry.id)
    graph.markers.update({marker.key: marker for marker in delta.markers})
    graph.object_cursor = Cursor(delta.epoch, delta.revision, delta.stamp_ns)
    graph.revision += 1
    return changes


def note_cameras(graph: Graph, delta: PlaceDelta) -> dict[int, Sighting]:
    """Camera centres of a delta that are news, by frame id; call it for every delta, whatever its revision.

    A camera centre is a fact of its own: a delta that a snapshot has overtaken still says where its keyframe was taken.
    The newest revision wins; centres of an earlier writer are forgotten.
    """
    reported = dict(zip(delta.past_frame_ids.tolist(), map(tuple, delta.past_cameras_m.tolist()), strict=True))
    if delta.camera_m is not None:
        reported[delta.frame_id] = _single(delta.camera_m)
    if delta.epoch < graph.place_cursor.epoch:
        return {}
    news = {}
    for frame_id, camera_m in sorted(reported.items()):
        sighting, known = Sighting(delta.epoch, delta.revision, camera_m), graph.sightings.get(frame_id)
        if known is None or known[:2] < sighting[:2]:
            graph.sightings[frame_id] = news[frame_id] = sighting
    return news


def set_task(graph: Graph, task: Task) -> bool:
    """Remember the robot's task; whether it is news."""
    if graph.task is not None and task.stamp_ns <= graph.task.stamp_ns:
        return False
    graph.task = task
    return True


def mend_task(graph: Graph, now_ns: int) -> Task | None:
    """Stamp a task anew that no clock can have stamped, so that the next one is newer; None where there is none."""
    if graph.task is None or not fault_of_stamp("the task", graph.task.stamp_ns, now_ns):
        return None
    graph.task = msgspec.structs.replace(graph.task, stamp_ns=now_ns)
    return graph.task


def cursors(graph: Graph) -> tuple[Cursor, Cursor, Cursor]:
    """Where the writers of places, regions and objects stand."""
    return graph.place_cursor, graph.region_cursor, graph.object_cursor


def stamp_ns(graph: Graph) -> int:
    """When the newest delta was made."""
    return max(cursor.stamp_ns for cursor in cursors(graph))


def link(graph: Graph, edge: Edge, clearance_m: float) -> None:
    """Put an edge into the graph, both ways."""
    a, b = edge
    graph.edges[edge] = clearance_m
    graph.neighbours.setdefault(a, set()).add(b)
    graph.neighbours.setdefault(b, set()).add(a)


def _put_edge(graph: Graph, a: int, b: int, clearance_m: float, changes: Changes) -> None:
    """An edge without both its places would dangle: it is left out."""
    if a == b or a not in graph.places or b not in graph.places:
        return
    edge = (min(a, b), max(a, b))
    link(graph, edge, clearance_m)
    changes.edges.add(edge)


def _remove_edge(graph: Graph, a: int, b: int, changes: Changes) -> None:
    edge = (min(a, b), max(a, b))
    if graph.edges.pop(edge, None) is not None:
        graph.neighbours[a].discard(b)
        graph.neighbours[b].discard(a)
    changes.edges.add(edge)


def _remove_place(graph: Graph, place: int, changes: Changes) -> None:
    for other in sorted(graph.neighbours.get(place, ())):
        _remove_edge(graph, place, other, changes)
    graph.neighbours.pop(place, None)
    for columns in (graph.places, graph.frontiers, graph.surfaces):
        columns.pop(place, None)
    changes.places.add(place)


def _merge_place(graph: Graph, gone: int, into: int, changes: Changes) -> None:
    """`gone` disappears and its edges lead to `into`, unless `into` has such an edge already."""
    if gone == into:
        return
    inherited = {
        other: graph.edges[min(gone, other), max(gone, other)] for other in sorted(graph.neighbours.get(gone, ()))
    }
    _remove_place(graph, gone, changes)
    for other, clearance_m in inherited.items():
        if (min(into, other), max(into, other)) not in graph.edges:
            _put_edge(graph, into, other, clearance_m, changes)


def _single(camera_m: tuple[float, float, float]) -> tuple[float, float, float]:
    """Rounded to single precision, as it appears in the scene and in snapshots."""
    x, y, z = (float(np.float32(value)) for value in camera_m)
    return x, y, z


def rows(values: list, width: int, dtype: type) -> np.ndarray:
    """A list of rows as an array (row, width), also when there are none."""
    return np.array(values, dtype).reshape(len(values), width)

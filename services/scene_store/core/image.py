"""A robot's graph as one message and back, exactly (pure): what a snapshot of the store holds."""

from typing import Annotated

import numpy as np

from prior_sg.schemas.codec import Message, Shape
from prior_sg.schemas.foresight import Foresight
from prior_sg.schemas.levels import LevelNode
from prior_sg.schemas.markers import SceneMarker
from prior_sg.schemas.objects import SceneObject
from prior_sg.schemas.priors import Task
from prior_sg.schemas.regions import Region
from prior_sg.services.scene_store.core import graph as core


class GraphImage(Message, frozen=True, kw_only=True):
    """Everything known about one robot; cursors are (epoch, revision, stamp_ns) of places, regions and objects."""

    robot: str
    revision: int
    cursors: list[tuple[int, int, int]]
    origin_m: tuple[float, float, float]
    place_ids: Annotated[np.ndarray, Shape("int64", "place")]
    positions_m: Annotated[np.ndarray, Shape("float32", "place", 3)]
    radii_m: Annotated[np.ndarray, Shape("float32", "place")]
    basis_points: Annotated[np.ndarray, Shape("int16", "place")]
    edges: Annotated[np.ndarray, Shape("int64", "edge", 2)]
    clearances_m: Annotated[np.ndarray, Shape("float32", "edge")]
    frontier_ids: Annotated[np.ndarray, Shape("int64", "frontier")]
    frontiers: Annotated[np.ndarray, Shape("float32", "frontier", 4)]
    surface_ids: Annotated[np.ndarray, Shape("int64", "surface")]
    surface_lengths: Annotated[np.ndarray, Shape("int64", "surface")]
    surfaces: Annotated[np.ndarray, Shape("float32", "surface_number")]
    frames: Annotated[np.ndarray, Shape("int64", "frame", 3)]  # id, epoch, revision
    cameras_m: Annotated[np.ndarray, Shape("float32", "frame", 3)]
    prior_digest: str
    environment: str
    task: str
    space: str
    labels: list[str]
    energy: float
    regions: list[Region]
    believed: Annotated[np.ndarray, Shape("int64", "belief", 2)]  # place, region
    posteriors: Annotated[np.ndarray, Shape("float16", "belief", "label")]
    unknown: Annotated[np.ndarray, Shape("float16", "belief")]
    predicted: Annotated[np.ndarray, Shape("bool", "belief")]
    objects: list[SceneObject]
    given: Task | None  # the newest task
    nodes: list[LevelNode] = []
    foresight: Foresight = Foresight()
    markers: list[SceneMarker] = []
    merged_of: list[str] = []


def image_of(graph: core.Graph) -> GraphImage:
    """All of a graph, in the order in which its dictionaries hold it."""
    places, beliefs = list(graph.places.values()), list(graph.beliefs.values())
    surfaces = list(graph.surfaces.values())
    aligned = graph.alignment
    return GraphImage(
        robot=graph.robot,
        revision=graph.revision,
        cursors=[(one.epoch, one.revision, one.stamp_ns) for one in core.cursors(graph)],
        origin_m=graph.origin_m,
        place_ids=np.array(list(graph.places), np.int64),
        positions_m=core.rows([place.position_m for place in places], 3, np.float32),
        radii_m=np.array([place.radius_m for place in places], np.float32),
        basis_points=np.array([place.basis_points for place in places], np.int16),
        edges=core.rows(list(graph.edges), 2, np.int64),
        clearances_m=np.array(list(graph.edges.values()), np.float32),
        frontier_ids=np.array(list(graph.frontiers), np.int64),
        frontiers=core.rows(list(graph.frontiers.values()), 4, np.float32),
        surface_ids=np.array(list(graph.surfaces), np.int64),
        surface_lengths=np.array([len(surface) for surface in surfaces], np.int64),
        surfaces=np.concatenate([np.zeros(0, np.float32), *surfaces]),
        frames=core.rows([(frame, seen.epoch, seen.revision) for frame, seen in graph.sightings.items()], 3, np.int64),
        cameras_m=core.rows([seen.camera_m for seen in graph.sightings.values()], 3, np.float32),
        prior_digest=aligned.prior_digest,
        environment=aligned.environment,
        task=aligned.task,
        space=aligned.space,
        labels=list(aligned.labels),
        energy=aligned.energy,
        regions=list(graph.regions.values()),
        believed=core.rows([(place, belief.region) for place, belief in graph.beliefs.items()], 2, np.int64),
        posteriors=core.rows([belief.posterior for belief in beliefs], len(aligned.labels), np.float16),
        unknown=np.array([belief.unknown for belief in beliefs], np.float16),
        predicted=np.array([belief.predicted for belief in beliefs], np.bool_),
        objects=list(graph.objects.values()),
        given=graph.task,
        nodes=list(graph.nodes.values()),
        foresight=graph.foresight,
        markers=list(graph.markers.values()),
        merged_of=list(graph.merged_of),
    )


def graph_of(image: GraphImage) -> core.Graph:
    """The graph that an image was made of."""
    graph = core.Graph(image.robot, revision=image.revision, origin_m=image.origin_m, task=image.given)
    graph.place_cursor, graph.region_cursor, graph.object_cursor = (core.Cursor(*cursor) for cursor in image.cursors)
    _restore_places(graph, image)
    frames = zip(image.frames.tolist(), image.cameras_m.tolist(), strict=True)
    graph.sightings = {
        frame: core.Sighting(epoch, revision, tuple(camera_m)) for (frame, epoch, revision), camera_m in frames
    }
    _restore_regions(graph, image)
    graph.objects = {entry.id: entry for entry in image.objects}
    graph.markers = {entry.key: entry for entry in image.markers}
    graph.merged_of = tuple(image.merged_of)
    return graph


def _restore_places(graph: core.Graph, image: GraphImage) -> None:
    columns = (image.place_ids, image.positions_m, image.radii_m, image.basis_points)
    for place, position_m, radius_m, basis in zip(*(column.tolist() for column in columns), strict=True):
        graph.places[place] = core.Place(tuple(position_m), radius_m, basis)
    for (a, b), clearance_m in zip(image.edges.tolist(), image.clearances_m.tolist(), strict=True):
        core.link(graph, (a, b), clearance_m)
    graph.frontiers = dict(zip(image.frontier_ids.tolist(), image.frontiers, strict=True))
    surfaces = np.split(image.surfaces, np.cumsum(image.surface_lengths)[:-1]) if len(image.surface_ids) else []
    graph.surfaces = dict(zip(image.surface_ids.tolist(), surfaces, strict=True))


def _restore_regions(graph: core.Graph, image: GraphImage) -> None:
    graph.alignment = core.Alignment(
        image.prior_digest, image.environment, image.task, image.space, tuple(image.labels), image.energy
    )
    graph.regions = {entry.id: entry for entry in image.regions}
    graph.nodes = {(node.level, node.id): node for node in image.nodes}
    graph.foresight = image.foresight
    columns = (image.believed.tolist(), image.posteriors, image.unknown.tolist(), image.predicted.tolist())
    for (place, region), posterior, unknown, predicted in zip(*columns, strict=True):
        graph.beliefs[place] = core.Belief(region, posterior, unknown, predicted)

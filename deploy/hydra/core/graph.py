"""One scene graph of Hydra as columns, without features and mesh, and in our world (pure)."""

from collections.abc import Sequence
from typing import Annotated

import msgspec
import numpy as np

from prior_sg.schemas.codec import Message, Shape
from prior_sg.schemas.objects import SceneObject

NO_ROOM = -1  # in place of a room's number: the place belongs to none
MOST_M = 1e5  # farther from the origin than any building
Origin = tuple[float, float, float]


class HydraGraph(Message, frozen=True, kw_only=True):
    """What the bridge takes from one message of Hydra. Metres of Hydra's world, which has z up.

    Places and objects are named by the number in their symbol, rooms by the whole value of theirs.
    """

    robot: str
    stamp_ns: int  # of the newest place, by the clock of the images; 0 = it says none
    place_ids: Annotated[np.ndarray, Shape("int64", "place")]  # ascending
    positions_m: Annotated[np.ndarray, Shape("float64", "place", 3)]
    radii_m: Annotated[np.ndarray, Shape("float64", "place")]
    basis_points: Annotated[np.ndarray, Shape("int16", "place")]
    place_rooms: Annotated[np.ndarray, Shape("int64", "place")]  # NO_ROOM = none
    edges: Annotated[np.ndarray, Shape("int64", "edge", 2)]  # place ids, smaller first, each once
    clearances_m: Annotated[np.ndarray, Shape("float64", "edge")]
    frontier_ids: Annotated[np.ndarray, Shape("int64", "frontier")]
    frontier_directions: Annotated[np.ndarray, Shape("float64", "frontier", 3)]
    frontier_areas_m2: Annotated[np.ndarray, Shape("float64", "frontier")]
    surface_ids: Annotated[np.ndarray, Shape("int64", "surface")]
    ellipses: Annotated[np.ndarray, Shape("float64", "surface", 3)]
    hull_counts: Annotated[np.ndarray, Shape("int64", "surface")]
    hulls_m: Annotated[np.ndarray, Shape("float64", "hull", 2)]
    room_ids: Annotated[np.ndarray, Shape("int64", "room")]
    objects: list[SceneObject]
    agent_stamps_ns: Annotated[np.ndarray, Shape("int64", "agent")]
    world_from_agent: Annotated[np.ndarray, Shape("float64", "agent", 4, 4)]
    left_out: int = 0  # places and objects whose numbers are not finite, or absurd


class GraphLost(Message, frozen=True, kw_only=True):
    """A message of Hydra gave no graph."""

    robot: str
    why: str  # one sentence


def in_our_world(graph: HydraGraph, scale: float, origin_m: Origin) -> HydraGraph:
    """The same in metres from our origin: lengths times `scale`, positions less the origin."""
    if scale == 1.0 and not any(origin_m):
        return graph
    agents = graph.world_from_agent.copy()
    agents[:, :3, 3] = agents[:, :3, 3] * scale - origin_m
    ellipses = graph.ellipses * (scale, scale, 1.0)
    return msgspec.structs.replace(
        graph,
        positions_m=graph.positions_m * scale - origin_m,
        radii_m=graph.radii_m * scale,
        clearances_m=graph.clearances_m * scale,
        frontier_areas_m2=graph.frontier_areas_m2 * scale**2,
        ellipses=ellipses,
        hulls_m=graph.hulls_m * scale - origin_m[:2],
        objects=[_moved(item, scale, origin_m) for item in graph.objects],
        world_from_agent=agents,
    )


def _moved(item: SceneObject, scale: float, origin_m: Origin) -> SceneObject:
    def moved(point_m: Sequence[float]) -> tuple[float, float, float]:
        x, y, z = (value * scale - zero for value, zero in zip(point_m, origin_m, strict=True))
        return x, y, z

    return msgspec.structs.replace(
        item, position_m=moved(item.position_m), min_m=moved(item.min_m), max_m=moved(item.max_m)
    )

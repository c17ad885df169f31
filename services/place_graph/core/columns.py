"""What a PlaceDelta tells, as columns of equal length, and the one place where they become a delta (pure)."""

from typing import NamedTuple

import numpy as np

from prior_sg.schemas.places import PlaceDelta


class PlaceColumns(NamedTuple):
    """Places that are new or have changed."""

    place_ids: np.ndarray  # int64 (place,)
    positions_m: np.ndarray  # float32 (place, 3), world
    radii_m: np.ndarray  # float32 (place,)
    basis_points: np.ndarray  # int16 (place,)


class EdgeColumns(NamedTuple):
    """Edges that are new or have changed."""

    edges: np.ndarray  # int64 (edge, 2), place ids, smaller first
    clearances_m: np.ndarray  # float32 (edge,)


class GoneColumns(NamedTuple):
    """Places and edges that are no more."""

    removed_ids: np.ndarray  # int64 (removed,)
    merged_ids: np.ndarray  # int64 (merged, 2), (gone, into)
    removed_edges: np.ndarray  # int64 (removed edge, 2)

    @property
    def place_ids(self) -> list[int]:
        """The places that are no more, wherever they went."""
        return [*self.removed_ids.tolist(), *self.merged_ids[:, 0].tolist()]


class GraphColumns(NamedTuple):
    """The change of the graph itself."""

    places: PlaceColumns
    edges: EdgeColumns
    gone: GoneColumns


class OpeningColumns(NamedTuple):
    """Openings to unobserved space that are new or have changed."""

    frontier_ids: np.ndarray  # int64 (frontier,)
    frontier_directions: np.ndarray  # float32 (frontier, 3), unit length
    frontier_areas_m2: np.ndarray  # float32 (frontier,), 0 = no opening any more


class GroundColumns(NamedTuple):
    """The shapes of places on the ground; the hulls follow each other."""

    surface_ids: np.ndarray  # int64 (surface,)
    ellipses: np.ndarray  # float32 (surface, 3): half axes in metres, angle of the long one in radians
    hull_counts: np.ndarray  # int64 (surface,)
    hulls_m: np.ndarray  # float32 (hull, 2), world


class CameraColumns(NamedTuple):
    """Camera centres of earlier keyframes."""

    past_frame_ids: np.ndarray  # int64 (past,)
    past_cameras_m: np.ndarray  # float32 (past, 3), world


class Heading(NamedTuple):
    """What a delta says of itself; fields as in PlaceDelta."""

    robot: str
    epoch: int
    revision: int
    stamp_ns: int
    frame_id: int
    snapshot: bool = False
    camera_m: tuple[float, float, float] | None = None
    event: str = ""
    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    merged_of: tuple[str, ...] = ()


def no_ground() -> GroundColumns:
    """The shapes of places that have none: spheres."""
    return GroundColumns(
        surface_ids=np.empty(0, np.int64),
        ellipses=np.empty((0, 3), np.float32),
        hull_counts=np.empty(0, np.int64),
        hulls_m=np.empty((0, 2), np.float32),
    )


def place_delta(
    heading: Heading, graph: GraphColumns, openings: OpeningColumns, ground: GroundColumns, cameras: CameraColumns
) -> PlaceDelta:
    """One delta, or with `heading.snapshot` the whole graph."""
    return PlaceDelta(
        robot=heading.robot,
        epoch=heading.epoch,
        revision=heading.revision,
        stamp_ns=heading.stamp_ns,
        frame_id=heading.frame_id,
        snapshot=heading.snapshot,
        camera_m=heading.camera_m,
        event=heading.event,
        origin_m=heading.origin_m,
        merged_of=list(heading.merged_of),
        place_ids=graph.places.place_ids,
        positions_m=graph.places.positions_m,
        radii_m=graph.places.radii_m,
        basis_points=graph.places.basis_points,
        edges=graph.edges.edges,
        clearances_m=graph.edges.clearances_m,
        removed_ids=graph.gone.removed_ids,
        merged_ids=graph.gone.merged_ids,
        removed_edges=graph.gone.removed_edges,
        frontier_ids=openings.frontier_ids,
        frontier_directions=openings.frontier_directions,
        frontier_areas_m2=openings.frontier_areas_m2,
        surface_ids=ground.surface_ids,
        ellipses=ground.ellipses,
        hull_counts=ground.hull_counts,
        hulls_m=ground.hulls_m,
        past_frame_ids=cameras.past_frame_ids,
        past_cameras_m=cameras.past_cameras_m,
    )

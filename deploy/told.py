"""What readers know of a graph that comes as a whole each time, and the delta that brings them up to date (pure).

A value is told again when it differs by more than a tolerance from what was told, so that slow drift adds up.
"""

from dataclasses import dataclass, field
from typing import Protocol

import msgspec
import numpy as np

from prior_sg.schemas.objects import SceneObject
from prior_sg.services.place_graph.core.columns import (
    EdgeColumns,
    GoneColumns,
    GraphColumns,
    GroundColumns,
    OpeningColumns,
    PlaceColumns,
    no_ground,
)

Key = tuple[int, ...]


class Whole(Protocol):
    """A place graph as columns: `Scene` is one, and so is what Hydra tells."""

    @property
    def place_ids(self) -> np.ndarray:
        """(place,)."""

    @property
    def positions_m(self) -> np.ndarray:
        """(place, 3)."""

    @property
    def radii_m(self) -> np.ndarray:
        """(place,)."""

    @property
    def basis_points(self) -> np.ndarray:
        """(place,)."""

    @property
    def edges(self) -> np.ndarray:
        """(edge, 2) place ids, smaller first."""

    @property
    def clearances_m(self) -> np.ndarray:
        """(edge,)."""

    @property
    def frontier_ids(self) -> np.ndarray:
        """(frontier,)."""

    @property
    def frontier_directions(self) -> np.ndarray:
        """(frontier, 3)."""

    @property
    def frontier_areas_m2(self) -> np.ndarray:
        """(frontier,)."""

    @property
    def surface_ids(self) -> np.ndarray:
        """(surface,)."""

    @property
    def ellipses(self) -> np.ndarray:
        """(surface, 3)."""

    @property
    def hull_counts(self) -> np.ndarray:
        """(surface,)."""

    @property
    def hulls_m(self) -> np.ndarray:
        """(hull, 2)."""


class Rows:
    """Numbers by key, as told."""

    def __init__(self) -> None:
        self.values: dict[Key, tuple[float, ...]] = {}

    def follow(self, keys: np.ndarray, values: np.ndarray, tolerance: float) -> tuple[np.ndarray, list[Key]]:
        """Rows (n,) that are new or differ, and keys that are gone; both are noted as told.

        `keys` (row, k) are whole numbers, `values` (row, v).
        """
        named = list(map(tuple, keys.tolist()))
        unknown = (np.nan,) * values.shape[1]
        known = np.array([self.values.get(key, unknown) for key in named], float).reshape(values.shape)
        rows = np.flatnonzero(~(np.abs(values - known) <= tolerance).all(axis=1))
        gone = sorted(self.values.keys() - set(named))
        for key in gone:
            del self.values[key]
        fresh = values[rows].tolist()
        self.values.update((named[row], tuple(told)) for row, told in zip(rows.tolist(), fresh, strict=True))
        return rows, gone

    def table(self, keys: int, values: int) -> tuple[np.ndarray, np.ndarray]:
        """All that was told, by ascending key: (row, keys) and (row, values)."""
        items = sorted(self.values.items())
        return (
            np.array([key for key, _ in items], np.int64).reshape(-1, keys),
            np.array([told for _, told in items], float).reshape(-1, values),
        )


@dataclass
class ToldGraph:
    """Places, edges, openings and ground as readers know them."""

    places: Rows = field(default_factory=Rows)  # id: position, radius, basis points
    edges: Rows = field(default_factory=Rows)  # ids: clearance
    openings: Rows = field(default_factory=Rows)  # id: direction, area
    ground: dict[int, bytes] = field(default_factory=dict)  # id: ellipse and hull, float32

    def follow(self, graph: Whole, min_change_m: float) -> tuple[GraphColumns, OpeningColumns, GroundColumns] | None:
        """What readers must hear of a graph; None when it is what they know."""
        values = np.column_stack((graph.positions_m, graph.radii_m, graph.basis_points))
        rows, gone = self.places.follow(graph.place_ids[:, None], values, min_change_m)
        ways, cut = self.edges.follow(graph.edges, graph.clearances_m[:, None], min_change_m)
        lost = {place for (place,) in gone}
        opened = self._openings(graph, min_change_m, lost)
        ground = self._ground(graph)
        if not (len(rows) or gone or len(ways) or cut or len(opened.frontier_ids) or len(ground.surface_ids)):
            return None
        explicit = [pair for pair in cut if not lost.intersection(pair)]
        columns = GraphColumns(
            _places(graph.place_ids[rows], values[rows]),
            _edges(graph.edges[ways], graph.clearances_m[ways]),
            _gone(sorted(lost), explicit),
        )
        return columns, opened, ground

    def _openings(self, graph: Whole, min_change_m: float, lost: set[int]) -> OpeningColumns:
        """Those that are new or differ; of those that have closed, the area is 0."""
        values = np.column_stack((graph.frontier_directions, graph.frontier_areas_m2))
        rows, gone = self.openings.follow(graph.frontier_ids[:, None], values, min_change_m)
        closed = [place for (place,) in gone if place not in lost]
        shut = np.column_stack((np.tile((1.0, 0.0, 0.0), (len(closed), 1)), np.zeros(len(closed))))
        return _openings(np.append(graph.frontier_ids[rows], closed).astype(np.int64), np.vstack((values[rows], shut)))

    def _ground(self, graph: Whole) -> GroundColumns:
        now = dict(zip(graph.surface_ids.tolist(), _shapes(graph), strict=True))
        news = {place: shape for place, shape in now.items() if self.ground.get(place) != shape}
        self.ground = now
        return _ground(news)

    def snapshot(self) -> tuple[GraphColumns, OpeningColumns, GroundColumns]:
        """All of it."""
        ids, values = self.places.table(1, 5)
        edges, clearances = self.edges.table(2, 1)
        graph = GraphColumns(_places(ids[:, 0], values), _edges(edges, clearances[:, 0]), _gone([], []))
        opened, openings = self.openings.table(1, 4)
        return graph, _openings(opened[:, 0], openings), _ground(self.ground)


@dataclass
class ToldObjects:
    """Objects as readers know them, by id."""

    items: dict[int, SceneObject] = field(default_factory=dict)

    def follow(self, objects: list[SceneObject], min_change_m: float) -> tuple[list[SceneObject], list[int]]:
        """Objects that are new or differ, and ids that are gone."""
        now = {item.id: item for item in objects}
        gone = sorted(self.items.keys() - now.keys())
        news = [item for number, item in sorted(now.items()) if _differs(self.items.get(number), item, min_change_m)]
        for number in gone:
            del self.items[number]
        self.items.update((item.id, item) for item in news)
        return news, gone

    def all(self) -> list[SceneObject]:
        """By ascending id."""
        return [item for _, item in sorted(self.items.items())]


def _differs(known: SceneObject | None, now: SceneObject, min_change_m: float) -> bool:
    if known is None:
        return True
    there = msgspec.structs.replace(known, position_m=now.position_m, min_m=now.min_m, max_m=now.max_m)
    moved = np.abs(np.subtract((known.position_m, known.min_m, known.max_m), (now.position_m, now.min_m, now.max_m)))
    return there != now or bool((moved > min_change_m).any())


def _shapes(graph: Whole) -> list[bytes]:
    hulls = np.split(graph.hulls_m, np.cumsum(graph.hull_counts)[:-1]) if len(graph.hull_counts) else []
    return [
        np.concatenate((ellipse, hull.ravel())).astype(np.float32).tobytes()
        for ellipse, hull in zip(graph.ellipses, hulls, strict=True)
    ]


def _places(ids: np.ndarray, values: np.ndarray) -> PlaceColumns:
    return PlaceColumns(
        place_ids=ids,
        positions_m=values[:, :3].astype(np.float32),
        radii_m=values[:, 3].astype(np.float32),
        basis_points=values[:, 4].astype(np.int16),
    )


def _edges(edges: np.ndarray, clearances_m: np.ndarray) -> EdgeColumns:
    return EdgeColumns(edges=edges, clearances_m=clearances_m.astype(np.float32))


def _gone(places: list[int], edges: list[Key]) -> GoneColumns:
    return GoneColumns(
        removed_ids=np.array(places, np.int64),
        merged_ids=np.zeros((0, 2), np.int64),
        removed_edges=np.array(edges, np.int64).reshape(-1, 2),
    )


def _openings(ids: np.ndarray, values: np.ndarray) -> OpeningColumns:
    return OpeningColumns(
        frontier_ids=ids,
        frontier_directions=values[:, :3].astype(np.float32),
        frontier_areas_m2=values[:, 3].astype(np.float32),
    )


def _ground(shapes: dict[int, bytes]) -> GroundColumns:
    if not shapes:
        return no_ground()
    flat = {place: np.frombuffer(shape, np.float32) for place, shape in sorted(shapes.items())}
    hulls = [shape[3:].reshape(-1, 2) for shape in flat.values()]
    return GroundColumns(
        surface_ids=np.array(list(flat), np.int64),
        ellipses=np.array([shape[:3] for shape in flat.values()], np.float32),
        hull_counts=np.array([len(hull) for hull in hulls], np.int64),
        hulls_m=np.concatenate(hulls),
    )

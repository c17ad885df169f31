"""The place graph as received: arrays in the order of place ids (pure).

A delta is small beside the map, so what it does not touch is only copied, never sorted, searched or compared.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from prior_sg.schemas.places import PlaceDelta
from prior_sg.services.compiled import compiled
from prior_sg.services.segmenter.core.map.arcs import Arcs, arcs_from, arcs_of, edges_between, grown


def _empty(dtype: str, *shape: int) -> np.ndarray:
    return np.zeros((0, *shape), dtype=dtype)


@dataclass(eq=False)
class ReceivedGraph:
    """Places sorted by id, and edges between their rows. Once built it does not change."""

    ids: np.ndarray = field(default_factory=lambda: _empty("int64"))  # (place,)
    positions_m: np.ndarray = field(default_factory=lambda: _empty("float64", 3))  # (place, 3) world
    radii_m: np.ndarray = field(default_factory=lambda: _empty("float64"))  # (place,)
    edges: np.ndarray = field(default_factory=lambda: _empty("int64", 2))  # (edge, 2) rows, smaller first, sorted
    clearances_m: np.ndarray = field(default_factory=lambda: _empty("float64"))  # (edge,)
    on_ground: bool = False  # 2D places: they lie on the ground, and their radii along it

    def rows(self, place_ids: np.ndarray) -> np.ndarray:
        """Row of each id, -1 where there is no such place."""
        if not len(self.ids):
            return np.full(len(place_ids), -1)
        rows = np.minimum(np.searchsorted(self.ids, place_ids), len(self.ids) - 1)
        return np.where(self.ids[rows] == place_ids, rows, -1)

    @cached_property
    def lengths_m(self) -> np.ndarray:
        """Length (edge,) of each edge."""
        return _lengths_m(self.positions_m, self.edges)

    @cached_property
    def arcs(self) -> Arcs:
        """Neighbours of each place; an arc weighs its length in metres."""
        return arcs_of(len(self.ids), self.edges, self.lengths_m)


@dataclass(frozen=True)
class Step:
    """How one graph follows from the one before."""

    graph: ReceivedGraph
    previous: np.ndarray  # (place,) row of each place in the former graph, -1 = new
    moved: np.ndarray  # (place,) bool: new, or the position differs
    touched: np.ndarray  # (place,) bool: new, moved, or an edge of it may have changed
    upserted: np.ndarray  # (upserted,) rows of the graph that the delta names
    removed: np.ndarray  # (removed,) rows of the former graph that are gone

    @cached_property
    def same_rows(self) -> bool:
        """Whether every place is where it was, and none is new."""
        return not len(self.removed) and np.array_equal(self.previous, np.arange(len(self.previous)))


def apply(graph: ReceivedGraph, delta: PlaceDelta, replaces: bool) -> Step:
    """The graph after `delta`, in the order that the delta's schema states; with `replaces`, the delta is all of it.

    A place that was merged into another hands its edges over to it; edges to places that do not exist are dropped.
    """
    merged = [(gone, into) for gone, into in delta.merged_ids.tolist() if gone != into]
    upserted, first = np.unique(delta.place_ids, return_index=True)
    known = graph.rows(upserted)
    if not (replaces or merged or len(delta.removed_ids) or len(delta.removed_edges) or (known < 0).any()):
        step = _told_anew(graph, delta, known, first)
        if step is not None:
            return step
    kept = np.full(len(graph.ids), not replaces)
    gone = graph.rows(np.concatenate((delta.removed_ids, np.array([pair[0] for pair in merged], dtype=np.int64))))
    kept[gone[gone >= 0]] = False
    kept[known[known >= 0]] = True
    previous = np.flatnonzero(kept)
    new = upserted[known < 0]
    at = np.searchsorted(graph.ids[previous], new)
    ids = inserted(graph.ids[previous], at, new)
    previous = inserted(previous, at, np.full(len(new), -1))
    old = previous >= 0
    after = ReceivedGraph(
        ids=ids,
        positions_m=realigned(graph.positions_m, previous, 0.0),
        radii_m=realigned(graph.radii_m, previous, 0.0),
        on_ground=len(delta.surface_ids) > 0 or (graph.on_ground and not replaces),
    )
    rows = after.rows(upserted)
    moved = ~old
    moved[rows] |= (after.positions_m[rows] != delta.positions_m[first]).any(axis=1)
    after.positions_m[rows], after.radii_m[rows] = delta.positions_m[first], delta.radii_m[first]
    ends = _join_edges(graph, after, delta, merged, previous=previous, replaces=replaces)
    touched = moved.copy()
    touched[ends] = True
    return Step(after, previous, moved, touched, upserted=rows, removed=np.flatnonzero(~kept))


def _told_anew(graph: ReceivedGraph, delta: PlaceDelta, rows: np.ndarray, first: np.ndarray) -> Step | None:
    """The step of a delta after which the same places are joined by the same edges; None where it is another.

    Arrays that it cannot change are those of `graph` themselves, and of lengths only the changed ones are computed.
    `rows` are those of the places that the delta names, each of which it says first at `first`.
    """
    told = graph.rows(delta.edges.reshape(-1)).reshape(-1, 2)
    valid = (told >= 0).all(axis=1) & (told[:, 0] != told[:, 1])
    told, numbers = told[valid], edges_between(graph.arcs, told[valid])
    if (numbers < 0).any():
        return None
    after = replace(
        graph,
        positions_m=graph.positions_m.copy(),
        radii_m=graph.radii_m.copy(),
        clearances_m=graph.clearances_m.copy(),
        on_ground=len(delta.surface_ids) > 0 or graph.on_ground,
    )
    moved = np.zeros(len(graph.ids), dtype=bool)
    moved[rows] = (graph.positions_m[rows] != delta.positions_m[first]).any(axis=1)
    after.positions_m[rows], after.radii_m[rows] = delta.positions_m[first], delta.radii_m[first]
    after.clearances_m[numbers[::-1]] = delta.clearances_m[valid][::-1]  # of a pair told twice, the first counts
    after.arcs = _lengthened(graph.arcs, after.positions_m, np.flatnonzero(moved))
    touched = moved.copy()
    touched[told.reshape(-1)] = True
    none = np.zeros(0, dtype=np.int64)
    return Step(after, np.arange(len(graph.ids)), moved, touched, upserted=rows, removed=none)


def _lengthened(near: Arcs, positions_m: np.ndarray, rows: np.ndarray) -> Arcs:
    """The same arcs after the places `rows` have moved."""
    at, lengths_m = arcs_from(near, rows), near.weights.copy()
    sources = np.repeat(rows, near.starts[rows + 1] - near.starts[rows])
    lengths_m[at] = np.linalg.norm(positions_m[sources] - positions_m[near.neighbours[at]], axis=1)
    lengths_m[near.twins[at]] = lengths_m[at]
    return near._replace(weights=lengths_m)


def with_neighbours(graph: ReceivedGraph, mask: np.ndarray) -> np.ndarray:
    """Mask (place,) grown by one edge."""
    return grown(graph.arcs, mask)


def _join_edges(
    graph: ReceivedGraph,
    after: ReceivedGraph,
    delta: PlaceDelta,
    merged: list[tuple[int, int]],
    *,
    previous: np.ndarray,
    replaces: bool,
) -> np.ndarray:
    """Fill in the edges of `after`, and return the rows of `after` at their changed ends; `previous` as in `Step`.

    Where several say something of one pair, the delta wins, then the edge that was there, then one inherited by
    merging.
    """
    count = max(len(after.ids), 1)
    row_after, old = np.full(len(graph.ids), -1), np.flatnonzero(previous >= 0)
    row_after[previous[old]] = old
    untouched = np.full(len(graph.edges), not replaces)
    untouched[_edges_at(graph, delta.removed_ids)] = False
    untouched[_edge_numbers(graph, delta.removed_edges)] = False
    handed = _edges_at(graph, np.array([pair[0] for pair in merged], dtype=np.int64))
    handed = handed[untouched[handed]]
    untouched[handed] = False
    inherited = graph.ids[graph.edges[handed]]
    for gone, into in merged:
        inherited[inherited == gone] = into
    kept = np.flatnonzero(untouched)
    pairs, clearances_m = np.take(row_after, np.take(graph.edges, kept, axis=0)), np.take(graph.clearances_m, kept)
    keys = pairs[:, 0] * count + pairs[:, 1]  # ascending: rows keep their order
    told = after.rows(np.concatenate((delta.edges, inherited)).reshape(-1)).reshape(-1, 2)
    told_m = np.concatenate((delta.clearances_m, graph.clearances_m[handed]))
    from_delta = np.arange(len(told)) < len(delta.edges)
    valid = (told >= 0).all(axis=1) & (told[:, 0] != told[:, 1])
    told, told_m, from_delta = np.sort(told[valid], axis=1), told_m[valid], from_delta[valid]
    told_keys, first = np.unique(told[:, 0] * count + told[:, 1], return_index=True)
    told, told_m, from_delta = told[first], told_m[first].astype(np.float64), from_delta[first]
    at = np.searchsorted(keys, told_keys)
    there = at < len(keys)
    there[there] = keys[at[there]] == told_keys[there]
    clearances_m[at[there & from_delta]] = told_m[there & from_delta]
    after.edges = inserted(pairs, at[~there], told[~there])
    after.clearances_m = inserted(clearances_m, at[~there], told_m[~there])
    ends = np.concatenate((told.reshape(-1), row_after[graph.edges[np.flatnonzero(~untouched)]].reshape(-1)))
    return ends[ends >= 0]


def realigned(column: np.ndarray, previous: np.ndarray, fill: float | bool) -> np.ndarray:
    """A column on other rows: `previous` is the former row of each, -1 = new, which gets `fill`."""
    if not len(column):
        return np.full((len(previous), *column.shape[1:]), fill, dtype=column.dtype)
    after = np.take(column, previous, axis=0, mode="clip")
    after[np.flatnonzero(previous < 0)] = fill
    return after


def inserted(column: np.ndarray, at: np.ndarray, values: np.ndarray) -> np.ndarray:
    """The column with `values` (n,) put in before its rows `at` (n,), ascending, as `np.insert` does, but in blocks."""
    places, first = np.unique(at, return_index=True)
    kept, new = np.split(column, places), np.split(values, first)  # before the first of `values` is nothing
    return np.concatenate([piece for pair in zip(new, kept, strict=True) for piece in pair])


def _edges_at(graph: ReceivedGraph, place_ids: np.ndarray) -> np.ndarray:
    """Numbers (n,), ascending, of the edges of these places."""
    rows = graph.rows(place_ids)
    return np.unique(graph.arcs.edges[arcs_from(graph.arcs, rows[rows >= 0])])


def _edge_numbers(graph: ReceivedGraph, pairs: np.ndarray) -> np.ndarray:
    """Which edges join these pairs (n, 2) of place ids, in any order; pairs without an edge are left out."""
    rows = graph.rows(pairs.reshape(-1)).reshape(-1, 2)
    numbers = edges_between(graph.arcs, rows[(rows >= 0).all(axis=1)])
    return numbers[numbers >= 0]


@compiled()
def _lengths_m(positions_m, edges):  # noqa: ANN001, ANN202
    """Length (edge,) of each edge, as `np.linalg.norm` adds it up."""
    lengths_m = np.empty(len(edges))
    for edge in range(len(edges)):
        one, other = edges[edge, 0], edges[edge, 1]
        x_m = positions_m[one, 0] - positions_m[other, 0]
        y_m = positions_m[one, 1] - positions_m[other, 1]
        z_m = positions_m[one, 2] - positions_m[other, 2]
        lengths_m[edge] = np.sqrt(x_m * x_m + y_m * y_m + z_m * z_m)
    return lengths_m

"""The place graph as received: arrays in the order of place ids (pure)."""

from dataclasses import dataclass, field

import numpy as np

from schemas.places import PlaceDelta


def _empty(dtype: str, *shape: int) -> np.ndarray:
    return np.zeros((0, *shape), dtype=dtype)


@dataclass
class PlaceGraph:
    """Places sorted by id, and edges between their rows."""

    ids: np.ndarray = field(default_factory=lambda: _empty("int64"))  # (place,)
    positions_m: np.ndarray = field(default_factory=lambda: _empty("float64", 3))  # (place, 3) world
    radii_m: np.ndarray = field(default_factory=lambda: _empty("float64"))  # (place,)
    edges: np.ndarray = field(default_factory=lambda: _empty("int64", 2))  # (edge, 2) rows, smaller first, sorted
    clearances_m: np.ndarray = field(default_factory=lambda: _empty("float64"))  # (edge,)

    def rows(self, place_ids: np.ndarray) -> np.ndarray:
        """Row of each id, -1 where there is no such place."""
        if not len(self.ids):
            return np.full(len(place_ids), -1)
        rows = np.minimum(np.searchsorted(self.ids, place_ids), len(self.ids) - 1)
        return np.where(self.ids[rows] == place_ids, rows, -1)


@dataclass(frozen=True)
class Step:
    """How one graph follows from the one before."""

    graph: PlaceGraph
    previous: np.ndarray  # (place,) row of each place in the former graph, -1 = new
    moved: np.ndarray  # (place,) bool: new, or the position differs
    removed: np.ndarray  # (removed,) ids that are gone


def apply(graph: PlaceGraph, delta: PlaceDelta, replaces: bool) -> Step:
    """The graph after `delta`, in the order that the delta's schema states; with `replaces`, the delta is all of it.

    A place that was merged into another hands its edges over to it; edges to places that do not exist are dropped.
    """
    merged = [(gone, into) for gone, into in delta.merged_ids.tolist() if gone != into]
    gone = np.union1d(delta.removed_ids, np.array([pair[0] for pair in merged], dtype=np.int64))
    kept = np.zeros(len(graph.ids), dtype=bool) if replaces else ~np.isin(graph.ids, gone)
    ids = np.union1d(graph.ids[kept], delta.place_ids)
    known = graph.rows(ids)
    after = PlaceGraph(ids=ids, positions_m=np.zeros((len(ids), 3)), radii_m=np.zeros(len(ids)))
    old = known >= 0
    after.positions_m[old], after.radii_m[old] = graph.positions_m[known[old]], graph.radii_m[known[old]]
    rows = after.rows(delta.place_ids)
    after.positions_m[rows], after.radii_m[rows] = delta.positions_m, delta.radii_m
    moved = ~old
    moved[old] = (after.positions_m[old] != graph.positions_m[known[old]]).any(axis=1)
    _join_edges(graph, after, delta, merged, replaces)
    return Step(graph=after, previous=known, moved=moved, removed=np.setdiff1d(graph.ids, ids))


def _join_edges(
    graph: PlaceGraph, after: PlaceGraph, delta: PlaceDelta, merged: list[tuple[int, int]], replaces: bool
) -> None:
    """Fill in the edges of `after`: where several say something of one pair, the delta wins, then the edge that was
    there, then one inherited by merging.
    """
    edges = graph.ids[graph.edges]
    removed = {(min(pair), max(pair)) for pair in delta.removed_edges.tolist()}
    stays = np.array([not replaces and tuple(pair) not in removed for pair in edges.tolist()], dtype=bool)
    stays &= ~np.isin(edges, delta.removed_ids).any(axis=1)
    edges, clearances_m = edges[stays], graph.clearances_m[stays]
    inherited = np.isin(edges, [gone for gone, _ in merged]).any(axis=1)
    for gone, into in merged:
        edges[edges == gone] = into
    order = np.argsort(inherited, kind="stable")
    pairs = after.rows(np.concatenate((delta.edges, edges[order])).reshape(-1)).reshape(-1, 2)
    clearances_m = np.concatenate((delta.clearances_m, clearances_m[order]))
    valid = (pairs >= 0).all(axis=1) & (pairs[:, 0] != pairs[:, 1])
    pairs, clearances_m = np.sort(pairs[valid], axis=1), clearances_m[valid]
    _, first = np.unique(pairs[:, 0] * max(len(after.ids), 1) + pairs[:, 1], return_index=True)
    after.edges, after.clearances_m = pairs[first], clearances_m[first].astype(np.float64)

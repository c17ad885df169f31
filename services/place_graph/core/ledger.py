"""What readers of the place graph know, and the delta that brings them up to date (pure)."""

from collections.abc import Mapping

import numpy as np

from prior_sg.services.place_graph.core.columns import EdgeColumns, GoneColumns, GraphColumns, PlaceColumns
from prior_sg.services.place_graph.core.skeleton.graph import Changes, Place, PlaceGraph

Pair = tuple[int, int]


class PlaceLedger:
    """The graph as published: without components that are too small, and without changes that are too small."""

    def __init__(self) -> None:
        self.places: dict[int, Place] = {}
        self.edges: dict[int, dict[int, int]] = {}  # id -> neighbour -> squared clearance (voxels)

    def update(
        self, graph: PlaceGraph, changes: Changes, voxel_m: float, min_component_size: int, min_change_m: float
    ) -> GraphColumns:
        """What readers must hear of `changes`; it is remembered as told."""
        affected = _within_hops(graph, changes.touched, min_component_size)
        shown = {i for i in affected if i in graph.places and _component_reaches(graph, i, min_component_size)}
        gone = [i for i in affected if i in self.places and i not in shown]
        changed_edges, lost_edges = self._edge_changes(graph, affected, shown, voxel_m, min_change_m)
        upserts = [i for i in sorted(shown) if _differs(self.places.get(i), graph.places[i], voxel_m, min_change_m)]
        for place_id in gone:
            del self.places[place_id]
        for place_id in upserts:
            self.places[place_id] = graph.places[place_id]
        merged = [(i, changes.merged[i]) for i in gone if changes.merged.get(i) in self.places]
        removed = sorted(set(gone) - {i for i, _ in merged})
        self._forget(lost_edges)
        for (a, b), clearance in changed_edges:
            self.edges.setdefault(a, {})[b] = self.edges.setdefault(b, {})[a] = clearance
        implied = set(removed)
        explicit = [pair for pair in lost_edges if not implied.intersection(pair)]
        return GraphColumns(
            _place_columns([(i, self.places[i]) for i in upserts], voxel_m),
            _edge_columns(changed_edges, voxel_m),
            _gone_columns(removed, merged, explicit),
        )

    def renumber(self, number: Mapping[int, int]) -> None:
        """Places have other ids; nothing of this ledger has been told yet."""
        self.places = {number[i]: place for i, place in self.places.items()}
        self.edges = {number[a]: {number[b]: c for b, c in links.items()} for a, links in self.edges.items()}

    def snapshot(self, voxel_m: float) -> GraphColumns:
        """All that readers have been told, ids ascending."""
        edges = sorted(((a, b), c) for a, links in self.edges.items() for b, c in links.items() if a < b)
        return GraphColumns(
            _place_columns(sorted(self.places.items()), voxel_m),
            _edge_columns(edges, voxel_m),
            _gone_columns([], [], []),
        )

    def _edge_changes(
        self, graph: PlaceGraph, affected: list[int], shown: set[int], voxel_m: float, min_change_m: float
    ) -> tuple[list[tuple[Pair, int]], list[Pair]]:
        """Edges to upsert and edges that are gone, each with its smaller id first, sorted."""
        upserts: dict[Pair, int] = {}
        lost: set[Pair] = set()
        for a in affected:
            links = graph.edges.get(a, {}) if a in shown else {}
            for b, clearance in links.items():
                # Neighbours of a shown place are in its component, hence shown too.
                known = self.edges.get(a, {}).get(b)
                if known == clearance:
                    continue
                if known is None or abs(known**0.5 - clearance**0.5) * voxel_m > min_change_m:
                    upserts[min(a, b), max(a, b)] = clearance
            lost.update((min(a, b), max(a, b)) for b in self.edges.get(a, {}) if b not in links)
        return sorted(upserts.items()), sorted(lost)

    def _forget(self, pairs: list[Pair]) -> None:
        for a, b in pairs:
            for one, two in ((a, b), (b, a)):
                del self.edges[one][two]
                if not self.edges[one]:
                    del self.edges[one]


def _within_hops(graph: PlaceGraph, ids: set[int], hops: int) -> list[int]:
    """Ids and all places at most `hops` edges away, ascending: whose component size may have crossed the limit."""
    found, front = set(ids), set(ids)
    for _ in range(hops):
        front = {b for a in front for b in graph.edges.get(a, ())} - found
        found |= front
    return sorted(found)


def _component_reaches(graph: PlaceGraph, start: int, size: int) -> bool:
    if len(graph.edges.get(start, ())) + 1 >= size:
        return True
    found, stack = {start}, [start]
    while stack and len(found) < size:
        fresh = set(graph.edges.get(stack.pop(), ())) - found
        found |= fresh
        stack.extend(fresh)
    return len(found) >= size


def _differs(known: Place | None, place: Place, voxel_m: float, min_change_m: float) -> bool:
    """Whether readers must hear of a place: it is new, or moved or resized by more than the smallest change."""
    if known == place:
        return False
    if known is None or known.basis != place.basis:
        return True
    moved = max(abs(a - b) for a, b in zip(known.center, place.center, strict=True)) * voxel_m
    return moved > min_change_m or abs(known.free_d2**0.5 - place.free_d2**0.5) * voxel_m > min_change_m


def _place_columns(places: list[tuple[int, Place]], voxel_m: float) -> PlaceColumns:
    centers = np.array([p.center for _, p in places], np.float64).reshape(-1, 3)
    return PlaceColumns(
        place_ids=np.array([i for i, _ in places], np.int64),
        positions_m=(centers * voxel_m).astype(np.float32),
        radii_m=(np.sqrt([float(p.free_d2) for _, p in places]) * voxel_m).astype(np.float32),
        basis_points=np.array([p.basis for _, p in places], np.int16),
    )


def _edge_columns(edges: list[tuple[Pair, int]], voxel_m: float) -> EdgeColumns:
    return EdgeColumns(
        edges=np.array([pair for pair, _ in edges], np.int64).reshape(-1, 2),
        clearances_m=(np.sqrt([float(c) for _, c in edges]) * voxel_m).astype(np.float32),
    )


def _gone_columns(removed: list[int], merged: list[Pair], edges: list[Pair]) -> GoneColumns:
    return GoneColumns(
        removed_ids=np.array(removed, np.int64),
        merged_ids=np.array(merged, np.int64).reshape(-1, 2),
        removed_edges=np.array(edges, np.int64).reshape(-1, 2),
    )

"""The place graph against a literal dictionary of places and edges."""

import numpy as np

from prior_sg.services.segmenter.core.map.received import ReceivedGraph, apply
from tests.help.world import place_delta


class Literal:
    """Applies deltas one item at a time, in the order of the schema."""

    def __init__(self):
        self.places, self.edges = {}, {}

    def apply(self, delta):
        if delta.snapshot:
            self.places, self.edges = {}, {}
        for pair in delta.removed_edges.tolist():
            self.edges.pop(tuple(pair), None)
        for place in delta.removed_ids.tolist():
            self.drop(place)
        for gone, into in delta.merged_ids.tolist():
            inherited = {next(iter({*pair} - {gone})): c for pair, c in self.edges.items() if gone in pair}
            self.drop(gone)
            for other, clearance in inherited.items():
                if other != into:
                    self.edges.setdefault((min(into, other), max(into, other)), clearance)
        for row, place in enumerate(delta.place_ids.tolist()):
            self.places[place] = (*delta.positions_m[row].tolist(), float(delta.radii_m[row]))
        for pair, clearance in zip(delta.edges.tolist(), delta.clearances_m.tolist(), strict=True):
            self.edges[tuple(pair)] = clearance

    def drop(self, place):
        self.places.pop(place, None)
        self.edges = {pair: c for pair, c in self.edges.items() if place not in pair}


def random_delta(rng, literal, snapshot):
    alive = sorted(literal.places)
    upserts = np.unique(rng.integers(0, 60, 8))
    spare = [place for place in alive if place not in set(upserts.tolist())]
    rng.shuffle(spare)
    removed = np.array(spare[:2], dtype=np.int64) if not snapshot else np.zeros(0, dtype=np.int64)
    merged = np.array([spare[2:4]], dtype=np.int64) if len(spare) > 5 and not snapshot else np.zeros((0, 2), np.int64)
    gone = {*removed.tolist(), *merged[:, 0].tolist()}
    after = sorted(({*alive} - gone if not snapshot else set()) | set(upserts.tolist()))
    pairs = {tuple(sorted(rng.choice(after, 2, replace=False).tolist())) for _ in range(10)}
    edges = np.array(sorted(pairs), dtype=np.int64)
    known = [pair for pair in literal.edges if pair not in pairs]
    return place_delta(
        rng.uniform(-5, 5, (len(upserts), 3)),
        edges,
        snapshot=snapshot,
        place_ids=upserts,
        radii_m=rng.uniform(0.4, 2, len(upserts)).astype(np.float32),
        clearances_m=rng.uniform(0.2, 2, len(edges)).astype(np.float32),
        removed_ids=removed,
        merged_ids=merged,
        removed_edges=np.array(known[:1], dtype=np.int64).reshape(-1, 2),
    )


def test_random_deltas_equal_the_literal_graph():
    rng = np.random.default_rng(2)
    literal, graph = Literal(), ReceivedGraph()
    for turn in range(60):
        delta = random_delta(rng, literal, snapshot=turn in (0, 30))
        before = graph
        step = apply(graph, delta, replaces=delta.snapshot)
        literal.apply(delta)
        graph = step.graph
        assert graph.ids.tolist() == sorted(literal.places)
        values = np.column_stack((graph.positions_m, graph.radii_m))
        np.testing.assert_array_equal(values, [literal.places[place] for place in sorted(literal.places)])
        found = dict(zip(map(tuple, graph.ids[graph.edges].tolist()), graph.clearances_m.tolist(), strict=True))
        assert found == literal.edges
        assert set(before.ids[step.removed].tolist()) == set(before.ids.tolist()) - set(graph.ids.tolist())
        untold = {int(place) for place in graph.ids[~step.touched]}
        assert all(neighbours(before, place) == neighbours(graph, place) for place in untold)


def neighbours(graph, place):
    """Ids of the neighbours of a place by brute force, checked against the compressed table."""
    row = int(graph.rows(np.array([place]))[0])
    found = {*graph.edges[graph.edges[:, 0] == row, 1].tolist(), *graph.edges[graph.edges[:, 1] == row, 0].tolist()}
    near = graph.arcs
    at = slice(near.starts[row], near.starts[row + 1])
    assert sorted(found) == sorted(near.neighbours[at].tolist())
    for other, edge in zip(near.neighbours[at].tolist(), near.edges[at].tolist(), strict=True):
        assert set(graph.edges[edge].tolist()) == {row, other}
    return set(graph.ids[sorted(found)].tolist())


def test_only_real_changes_count_as_moved():
    positions = np.array([(0.0, 0.0, 1.0), (1.0, 0.0, 1.0), (2.0, 0.0, 1.0)])
    first = apply(ReceivedGraph(), place_delta(positions, np.array([(0, 1)])), replaces=False)
    assert first.moved.all() and (first.previous == -1).all()
    positions[1, 0] = 1.5
    second = apply(first.graph, place_delta(positions, np.zeros((0, 2))), replaces=False)
    assert second.moved.tolist() == [False, True, False]
    assert second.previous.tolist() == [0, 1, 2]
    assert second.graph.edges.tolist() == [[0, 1]]

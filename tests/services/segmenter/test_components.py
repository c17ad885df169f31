"""Components, ids that last, and footprints."""

import tracemalloc

import numpy as np
import pytest
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull

from prior_sg.schemas.regions import NO_REGION
from prior_sg.services.segmenter.core.experts.context import ObjectView
from prior_sg.services.segmenter.core.map.received import ReceivedGraph, apply
from prior_sg.services.segmenter.core.regions.components import (
    border,
    events,
    footprint_m2,
    hull_m,
    members,
    numbered,
    track,
)
from tests.help.world import place_delta


def test_components_by_hand():
    labels = np.array([0, 0, 1, 1, 0, 0])
    edges = np.array([(0, 1), (1, 2), (2, 3), (3, 4)])  # 5 has no edge
    assert numbered(labels, edges).tolist() == [0, 0, 1, 1, 2, 3]
    assert numbered(np.zeros(3, int), np.zeros((0, 2), int)).tolist() == [0, 1, 2]
    assert len(numbered(np.zeros(0, int), np.zeros((0, 2), int))) == 0


N = NO_REGION
TRACKING = [  # name, components, ids before, next id, ids after, next id after
    ("first time", [0, 0, 1], [N, N, N], 0, [0, 0, 1], 2),
    ("unchanged", [0, 0, 1], [7, 7, 3], 9, [7, 7, 3], 9),
    ("growth", [0, 0, 0, 1], [4, 4, N, 2], 9, [4, 4, 4, 2], 9),
    ("split: the larger part keeps the id", [0, 1, 1], [4, 4, 4], 9, [9, 4, 4], 10),
    ("even split: the older place keeps the id", [0, 0, 1, 1], [4, 4, 4, 4], 9, [4, 4, 9, 9], 10),
    ("merge: the larger id survives", [0, 0, 0], [2, 5, 5], 9, [5, 5, 5], 9),
    ("even merge: the older id survives", [0, 0], [5, 2], 9, [2, 2], 9),
    ("a place changes sides", [0, 1, 1, 1], [1, 1, 2, 2], 9, [1, 2, 2, 2], 9),
    ("an id follows most of its places, not a remnant", [0, 0, 0, 0, 0, 1], [1, 1, 1, 2, 2, 2], 9, [1] * 5 + [9], 10),
]


@pytest.mark.parametrize("case", TRACKING, ids=[case[0] for case in TRACKING])
def test_track(case):
    _, component, before, next_id, after, next_after = case
    ids, following = track(np.array(component), np.array(before), next_id)
    assert ids.tolist() == after
    assert following == next_after


def test_tracked_ids_are_distinct_and_never_used_again():
    rng = np.random.default_rng(0)
    ids, next_id, dead = np.full(40, NO_REGION), 0, set()
    for _ in range(60):
        alive = set(ids.tolist()) - {NO_REGION}
        component = numbered(rng.integers(0, 3, 40), np.stack((np.arange(39), np.arange(1, 40)), axis=1))
        ids, next_id = track(component, ids, next_id)
        assert len(set(zip(component.tolist(), ids.tolist(), strict=True))) == len(set(ids.tolist()))
        assert len(set(component.tolist())) == len(set(ids.tolist()))
        dead |= alive - set(ids.tolist())
        assert not dead & set(ids.tolist())


def test_footprint_of_discs():
    one = np.array([(3.3, -2.1, 1.0)])
    assert footprint_m2(one, np.array([1.0]), 0.02) == pytest.approx(np.pi, rel=0.01)
    apart = np.array([(0.0, 0.0, 0.0), (10.0, 3.0, 2.0)])
    assert footprint_m2(apart, np.array([1.0, 0.5]), 0.02) == pytest.approx(1.25 * np.pi, rel=0.01)
    inside = np.array([(0.0, 0.0, 0.0), (0.2, 0.1, 5.0)])
    assert footprint_m2(inside, np.array([1.0, 0.5]), 0.02) == pytest.approx(np.pi, rel=0.01)
    lens = 2 * np.pi / 3 - np.sqrt(3) / 2  # two unit discs whose centres are one radius apart
    overlapping = np.array([(0.0, 0.0, 0.0), (1.0, 0.0, 0.0)])
    assert footprint_m2(overlapping, np.ones(2), 0.02) == pytest.approx(2 * np.pi - lens, rel=0.01)


@pytest.mark.parametrize("seed", range(5))
def test_a_footprint_is_the_number_of_cells_whose_middle_a_disc_covers(seed):
    rng = np.random.default_rng(seed)
    positions_m, radii_m, cell_m = rng.uniform(0, 6, (20, 3)), rng.uniform(0, 1, 20), 0.1
    low = (positions_m[:, :2] - radii_m[:, None]).min(axis=0)
    middles_m = low + (np.indices((90, 90)).reshape(2, -1).T + 0.5) * cell_m
    inside = np.linalg.norm(middles_m[:, None] - positions_m[:, :2], axis=2) <= radii_m
    assert footprint_m2(positions_m, radii_m, cell_m) == float(inside.any(axis=1).sum() * cell_m**2)


def test_a_footprint_takes_no_memory_for_what_lies_between_discs():
    apart = np.array([(0.0, 0.0, 0.0), (3000.0, 3000.0, 0.0)])
    tracemalloc.start()
    try:
        assert footprint_m2(apart, np.array([1.0, 0.5]), 0.1) == pytest.approx(1.25 * np.pi, rel=0.02)
        assert tracemalloc.get_traced_memory()[1] < 1e6  # bytes
    finally:
        tracemalloc.stop()


def test_footprint_of_discs_smaller_than_a_cell():
    assert footprint_m2(np.array([(0.0, 0.0, 0.0)]), np.array([0.0]), 0.1) <= 0.01


@pytest.mark.parametrize("seed", range(5))
def test_components_equal_scipys(seed):
    rng = np.random.default_rng(seed)
    labels = rng.integers(0, 3, 200)
    edges = np.unique(np.sort(rng.integers(0, 200, (300, 2)), axis=1), axis=0)
    edges = edges[edges[:, 0] != edges[:, 1]]
    same = edges[labels[edges[:, 0]] == labels[edges[:, 1]]]
    graph = sparse.coo_matrix((np.ones(len(same)), same.T), shape=(200, 200))
    expected = connected_components(graph, directed=False)[1]
    found = numbered(labels, edges)
    assert len(np.unique(np.stack((found, expected), axis=1), axis=0)) == len(np.unique(expected))
    assert len(np.unique(found)) == len(np.unique(expected))
    firsts = np.unique(found, return_index=True)[1]
    assert (np.diff(firsts) > 0).all()


EVENTS = [  # name, ids before, ids now, labels before, labels now, (kind, region, other, label)
    ("nothing", [1, 1, 2], [1, 1, 2], {1: "a", 2: "b"}, {1: "a", 2: "b"}, []),
    ("appeared", [1, N, N], [1, 2, 2], {1: "a"}, {1: "a", 2: "b"}, [("appeared", 2, -1, "b")]),
    ("split", [1, 1, 1], [1, 1, 2], {1: "a"}, {1: "a", 2: "b"}, [("split", 2, 1, "b")]),
    ("merged", [1, 1, 2], [1, 1, 1], {1: "a", 2: "b"}, {1: "a"}, [("merged", 2, 1, "b")]),
    (
        "divided among two",
        [1, 3, 3, 2],
        [1, 1, 2, 2],
        {1: "a", 2: "b", 3: "c"},
        {1: "a", 2: "b"},
        [("merged", 3, 2, "c")],
    ),
    ("removed", [1, 1], [1, 1], {1: "a", 2: "b"}, {1: "a"}, [("removed", 2, -1, "b")]),
    ("relabelled", [1, 1], [1, 1], {1: "a"}, {1: "b"}, [("relabelled", 1, -1, "b")]),
]


@pytest.mark.parametrize("case", EVENTS, ids=[case[0] for case in EVENTS])
def test_events(case):
    _, previous, now, before, after, expected = case
    found = events(np.array(previous), np.array(now), before, after)
    assert [(event.kind, event.region, event.other, event.label) for event in found] == expected
    for event in found:
        assert event.former_label == (before[event.region] if event.kind == "relabelled" else "")


def two_rooms():
    """Two rows of three places 1 m apart: a doorway at y = 0 (clearance 0.4), a wide opening at y = 5 and 6."""
    left = [(0.0, y, 1.0) for y in (0.0, 5.0, 6.0)]
    right = [(1.0, y, 1.0) for y in (0.0, 5.0, 6.0)]
    edges = np.array([(0, 3), (1, 4), (2, 5), (0, 1), (1, 2), (3, 4), (4, 5)])
    clearances = np.array([0.4, 0.9, 1.1, 1.0, 1.0, 1.0, 1.0], np.float32)
    return apply(ReceivedGraph(), place_delta(np.array(left + right), edges, clearances_m=clearances), False).graph


def test_border_by_hand():
    """Edges at y = 5 and 6 lie side by side: one way, told by the wider; the doorway is another."""
    found = border(two_rooms(), np.array([7, 7, 7, 9, 9, 9]), {7, 9}, door_clearance_m=0.7)
    assert found.neighbours == {7: [9], 9: [7]}
    door, opening = found.transitions[7]
    assert (door.region, door.edge, door.position_m, door.door) == (9, (0, 3), (0.5, 0.0, 1.0), True)
    assert door.clearance_m == pytest.approx(0.4) and opening.clearance_m == pytest.approx(1.1)
    assert (opening.edge, opening.position_m, opening.door) == ((2, 5), (0.5, 6.0, 1.0), False)
    assert [way.edge for way in found.transitions[9]] == [(3, 0), (5, 2)]
    assert border(two_rooms(), np.array([7, 7, 7, 9, 9, 9]), {9}, 0.7).transitions.keys() == {9}
    assert border(two_rooms(), np.zeros(6, int), {0}, 0.7).neighbours == {}


def test_hull_is_convex_and_holds_the_discs():
    rng = np.random.default_rng(1)
    positions, radii = rng.uniform(0, 5, (30, 3)), rng.uniform(0.2, 1.0, 30)
    outline = np.array(hull_m(positions, radii))
    assert len(ConvexHull(outline).vertices) == len(outline)
    x, y = outline.T
    assert 0.5 * (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() > 0  # counter-clockwise
    following = np.roll(outline, -1, axis=0)
    normals = np.stack((following[:, 1] - y, x - following[:, 0]), axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    inside = (outline * normals).sum(axis=1) - positions[:, :2] @ normals.T
    assert (inside >= radii[:, None] - 0.02).all()
    assert len(hull_m(positions[:1], np.zeros(1))) == 8


def test_objects_belong_to_the_region_of_the_nearest_place():
    graph = two_rooms()
    region_of = np.array([7, 7, 7, 9, 9, 9])
    view = ObjectView(
        ids=np.array([40, 41, 42]),
        positions_m=np.array([(-0.5, 5.0, 0.5), (1.2, 0.0, 1.0), (30.0, 0.0, 0.0)]),
        concepts=np.ones((3, 1)),
    )
    assert members(view, graph.positions_m, region_of, np.arange(6)) == {7: [40], 9: [41]}
    assert members(view, graph.positions_m, region_of, np.array([5])) in ({}, {7: [40]})
    assert members(ObjectView(), graph.positions_m, region_of, np.arange(6)) == {}

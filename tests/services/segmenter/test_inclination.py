"""Local shape of the place graph against hand-made surfaces and SciPy's shortest paths."""

import numpy as np
import pytest
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from prior_sg.services.segmenter.core.map.inclination import GeometryConfig, disturbed, reach, shape_of
from prior_sg.services.segmenter.core.map.received import ReceivedGraph, apply
from tests.help.world import place_delta

CFG = GeometryConfig(neighbourhood_m=2.5, saturation=10.0)


def grid(inclination_rad, rows=5, columns=5):
    """A tilted plane of places 1 m apart, rising along x, edges along rows and columns."""
    points = np.array([(i, j, 0.0) for i in range(rows) for j in range(columns)])
    rise = np.array((np.cos(inclination_rad), 0.0, np.sin(inclination_rad)))
    positions = points[:, :1] * rise + points[:, 1:2] * (0.0, 1.0, 0.0)
    first, second = np.triu_indices(len(points), 1)
    near = np.linalg.norm(points[first] - points[second], axis=1) < 1.01
    return apply(ReceivedGraph(), place_delta(positions, np.stack((first, second), axis=1)[near]), False).graph


@pytest.mark.parametrize("degrees", [0, 20, 32, 60, 90])
def test_planes_have_their_inclination(degrees):
    """Within 2.5 m along edges of the middle: itself, 4 at 1 m, 4 at 2 m straight, 4 round the corner: 13 places."""
    shape = shape_of(grid(np.radians(degrees)), np.array([12]), CFG)
    assert np.degrees(shape.inclination_rad[0]) == pytest.approx(degrees, abs=1e-3)
    assert shape.support[0] == pytest.approx(13 / 23)
    assert shape.anisotropy[0] == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("degrees", [0, 32, 90])
def test_lines_have_the_inclination_of_their_direction(degrees):
    """Their best plane could turn about them, so a level corridor would have any inclination."""
    shape = shape_of(grid(np.radians(degrees), rows=7, columns=1), np.array([3]), CFG)
    assert np.degrees(shape.inclination_rad[0]) == pytest.approx(degrees, abs=1e-3)
    assert shape.support[0] == pytest.approx(5 / 15)


def test_a_ball_of_places_says_little_and_a_single_place_nothing():
    """Six places at the ends of three equal axes and one in the middle: l1 = l3, anisotropy 0."""
    points = np.vstack((np.zeros((1, 3)), np.eye(3), -np.eye(3)))
    edges = np.array([(0, i) for i in range(1, 7)])
    graph = apply(ReceivedGraph(), place_delta(np.vstack((points, [(50.0, 0.0, 0.0)])), edges), False).graph
    shape = shape_of(graph, np.array([0, 7]), CFG)
    np.testing.assert_allclose(shape.anisotropy, 0.0, atol=1e-9)
    assert shape.support.tolist() == pytest.approx([7 / 17, 1 / 11])
    assert shape.inclination_rad[1] == 0.0


def random_graph(rng, count=80):
    positions = rng.uniform(0, 6, (count, 3))
    first, second = np.triu_indices(count, 1)
    near = np.linalg.norm(positions[first] - positions[second], axis=1) < 1.6
    return positions, np.stack((first, second), axis=1)[near]


@pytest.mark.parametrize("seed", range(3))
def test_neighbourhoods_equal_scipys_shortest_paths(seed):
    rng = np.random.default_rng(seed)
    graph = apply(ReceivedGraph(), place_delta(*random_graph(rng)), False).graph
    count = len(graph.ids)
    weights = csr_matrix((graph.lengths_m, graph.edges.T), shape=(count, count))
    inside = dijkstra(weights, directed=False) <= CFG.neighbourhood_m
    shape = shape_of(graph, np.arange(count), CFG)
    np.testing.assert_allclose(shape.support, inside.sum(axis=1) / (inside.sum(axis=1) + CFG.saturation))
    for row in range(count):
        l3, _, l1 = np.linalg.eigvalsh(np.cov(graph.positions_m[inside[row]].T)) if inside[row].sum() > 1 else (0, 0, 0)
        assert shape.anisotropy[row] == pytest.approx(1 - l3 / l1 if l1 > 0 else 0.0, abs=1e-6)
    sources = rng.choice(count, 4, replace=False)
    assert reach(graph, sources, 2.5).tolist() == np.flatnonzero(inside[sources].any(axis=0)).tolist()


@pytest.mark.parametrize("seed", range(5))
def test_whatever_a_change_does_not_disturb_keeps_its_shape(seed):
    rng = np.random.default_rng(seed)
    positions, edges = random_graph(rng)
    before = apply(ReceivedGraph(), place_delta(positions, edges), False).graph
    some = rng.choice(len(positions), 6, replace=False)
    change = place_delta(
        positions[some[:2]] + 0.3,
        np.array([sorted(some[:2].tolist())]),
        place_ids=some[:2],
        removed_ids=some[2:3],
        merged_ids=some[None, 3:5],
        removed_edges=edges[rng.choice(len(edges), 1)],
        revision=1,
    )
    step = apply(before, change, False)
    mask = disturbed(before, step, CFG.neighbourhood_m)
    assert 0 < mask.sum() < len(mask)
    rest = np.flatnonzero(~mask)
    for now, then in zip(shape_of(step.graph, rest, CFG), shape_of(before, step.previous[rest], CFG), strict=True):
        np.testing.assert_allclose(now, then)


@pytest.mark.parametrize("fields", [{"neighbourhood_m": 0.0}, {"saturation": 0.0}, {"line_ratio": 2.0}])
def test_impossible_settings_are_refused(fields):
    with pytest.raises(ValueError):
        GeometryConfig(**fields)

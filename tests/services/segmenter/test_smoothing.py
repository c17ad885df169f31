"""Sharing of evidence against matrices."""

import numpy as np
import pytest

from prior_sg.services.segmenter.core.appearance.smoothing import SharingConfig, reached, shared
from prior_sg.services.segmenter.core.map.received import ReceivedGraph, apply
from tests.help.world import place_delta


def random_field(seed, count=60, columns=3):
    rng = np.random.default_rng(seed)
    positions = rng.uniform(0, 6, (count, 3))
    first, second = np.triu_indices(count, 1)
    near = np.linalg.norm(positions[first] - positions[second], axis=1) < 1.8
    graph = apply(ReceivedGraph(), place_delta(positions, np.stack((first, second), axis=1)[near]), False).graph
    trust = rng.uniform(0, 8, count) * (rng.random(count) < 0.7)
    return graph, rng.uniform(0.1, 2, len(graph.edges)), trust, rng.normal(size=(count, columns))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("steps", [0, 1, 4])
def test_sharing_equals_powers_of_the_walk(seed, steps):
    """(1 - s) I + s D^-1 W, `steps` times, on mass and on mass times value."""
    graph, weights, trust, own = random_field(seed)
    cfg, count = SharingConfig(steps=steps, share=0.6, trust_limit=5.0, gain=2.0), len(trust)
    walk = np.zeros((count, count))
    walk[graph.edges[:, 0], graph.edges[:, 1]] = walk[graph.edges[:, 1], graph.edges[:, 0]] = weights
    sums = walk.sum(axis=1, keepdims=True)
    alone = sums[:, 0] == 0
    walk = 0.4 * np.eye(count) + 0.6 * np.divide(walk, sums, out=np.zeros_like(walk), where=sums > 0)
    walk[alone] = np.eye(count)[alone]
    spread = np.linalg.matrix_power(walk, steps)
    mass = np.minimum(trust, 5.0)
    sums, total = spread @ (mass[:, None] * own), (spread @ mass)[:, None]
    expected = 2.0 * np.divide(sums, total, out=np.zeros_like(own), where=total > 0) if steps else own
    found = shared(own, trust, graph.arcs.weighing(weights), rows=np.arange(count), cfg=cfg)
    np.testing.assert_allclose(found, expected, atol=1e-12)
    some = np.random.default_rng(seed).choice(count, 5, replace=False)
    np.testing.assert_allclose(
        shared(own, trust, graph.arcs.weighing(weights), rows=some, cfg=cfg), expected[some], atol=1e-12
    )


@pytest.mark.parametrize("seed", range(3))
def test_a_change_reaches_as_many_edges_as_there_are_steps(seed):
    graph, weights, trust, own = random_field(seed)
    cfg, mask = SharingConfig(steps=2), np.zeros(len(trust), dtype=bool)
    mask[[3, 9]] = True
    rows = reached(graph.arcs, mask, 2)
    changed = own + np.where(mask[:, None], 5.0, 0.0)
    everyone = np.arange(len(trust))
    before = shared(own, trust, graph.arcs.weighing(weights), rows=everyone, cfg=cfg)
    after = shared(changed, np.where(mask, trust + 1, trust), graph.arcs.weighing(weights), rows=everyone, cfg=cfg)
    rest = np.setdiff1d(everyone, rows)
    assert len(rest)
    np.testing.assert_array_equal(before[rest], after[rest])
    assert not np.allclose(before[rows], after[rows])


@pytest.mark.parametrize("fields", [{"steps": -1}, {"share": 1.5}, {"trust_limit": 0.0}, {"gain": 0.0}])
def test_impossible_settings_are_refused(fields):
    with pytest.raises(ValueError):
        SharingConfig(**fields)

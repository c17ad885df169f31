"""Posteriors of places against sums over the field and numbers worked by hand."""

import numpy as np
import pytest

from prior_sg.services.segmenter.core.energy.mrf import Field, energy
from prior_sg.services.segmenter.core.energy.posteriors import conditional_costs, posteriors
from prior_sg.services.segmenter.core.map.received import ReceivedGraph, apply
from tests.help.world import place_delta


@pytest.mark.parametrize("seed", range(3))
def test_conditional_costs_are_differences_of_the_energy(seed):
    """Giving one place another label changes the energy by the difference of its two conditional costs."""
    rng = np.random.default_rng(seed)
    count, labels = 20, 4
    edges = np.unique(np.sort(rng.integers(0, count, (40, 2)), axis=1), axis=0)
    edges = edges[edges[:, 0] != edges[:, 1]]
    graph = apply(ReceivedGraph(), place_delta(rng.uniform(0, 9, (count, 3)), edges), False).graph
    pairwise = np.triu(rng.uniform(0, 3, (labels, labels)), 1)
    field = Field(
        rng.normal(size=(count, labels)), graph.edges, rng.uniform(0, 2, len(graph.edges)), pairwise + pairwise.T
    )
    taken, rows = rng.integers(0, labels, count), rng.choice(count, 6, replace=False)
    costs = conditional_costs(field, graph.arcs.weighing(field.weights), taken, rows)
    for index, row in enumerate(rows.tolist()):
        for label in range(labels):
            changed = taken.copy()
            changed[row] = label
            rise = energy(field, changed) - energy(field, taken)
            assert costs[index, label] - costs[index, taken[row]] == pytest.approx(rise)


def test_posteriors_by_hand():
    """Costs 0 and 2 at temperature 2: odds e = 2.71828, so 0.73106 and 0.26894; huge costs do no harm."""
    found = posteriors(np.array([(0.0, 2.0), (1e6, 1e6 + 2.0)]), 2.0)
    np.testing.assert_allclose(found, [(0.73106, 0.26894)] * 2, atol=1e-5)

"""The energy that is told, from terms that are kept."""

import numpy as np
import pytest

from prior_sg.services.segmenter.core.energy.mrf import KeptTerms, energy
from prior_sg.services.segmenter.core.map.arcs import arcs_of
from tests.help.fields import random_field

PLACES, LABELS = 60, 4


@pytest.mark.parametrize("seed", range(10))
def test_kept_terms_give_the_energy_of_all_terms_to_the_last_digit(seed):
    """Costs, weights and labels change, together and alone; edges, label costs or places at times."""
    rng, kept = np.random.default_rng(seed), KeptTerms()
    field, labels = random_field(seed, PLACES, LABELS, degree=4), rng.integers(0, LABELS, PLACES)
    for turn in range(40):
        if turn % 13 == 12:  # some of the edges, in new rows
            field = field._replace(edges=field.edges[1:].copy(), weights=field.weights[1:].copy())
        if turn % 17 == 16:
            field = field._replace(pairwise=2 * field.pairwise)
        costly, others = rng.choice(PLACES, rng.integers(3)), rng.choice(PLACES, rng.integers(3))
        field.unary[costly] = rng.uniform(0, 4, (len(costly), LABELS))
        weights = field.weights.copy()
        weights[rng.choice(len(weights), rng.integers(3))] = rng.uniform(0, 1)
        ends = field.edges[weights != field.weights, rng.integers(2)]
        field, labels = field._replace(weights=weights), labels.copy()
        labels[others] = rng.integers(0, LABELS, len(others))
        ties, rows = arcs_of(PLACES, field.edges, field.weights), np.concatenate((costly, others, ends))
        assert kept.energy(field, labels, ties, rows) == energy(field, labels)


def test_places_that_edges_do_not_reach_may_come_and_go():
    field, kept = random_field(0, PLACES, LABELS, degree=4), KeptTerms()
    for count in (PLACES, PLACES + 2, PLACES):
        grown = field._replace(unary=np.resize(field.unary, (count, LABELS)))
        labels = np.arange(count) % LABELS
        ties, rows = arcs_of(count, field.edges, field.weights), np.zeros(0, np.int64)
        assert kept.energy(grown, labels, ties, rows) == energy(grown, labels)

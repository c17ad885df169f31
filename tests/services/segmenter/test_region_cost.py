"""Regions that must pay for themselves, against brute force on random fields."""

import numpy as np
import pytest

from prior_sg.services.segmenter.core.energy.mrf import Field, energy
from prior_sg.services.segmenter.core.energy.region_cost import _pass, consolidated
from prior_sg.services.segmenter.core.energy.solver import minimise
from prior_sg.services.segmenter.core.map.arcs import arcs_of
from prior_sg.services.segmenter.core.regions.components import numbered
from tests.help import fields

POTTS = 1.0 - np.eye(3)


def chain(unary: np.ndarray) -> Field:
    count = len(unary)
    edges = np.column_stack((np.arange(count - 1), np.arange(1, count)))
    return Field(unary.astype(float), edges, np.ones(count - 1), POTTS)


def random_field(seed: int) -> Field:
    rng = np.random.default_rng(seed)
    count = int(rng.integers(8, 40))
    tree = [(int(rng.integers(0, place)), place) for place in range(1, count)]
    more = [tuple(sorted(rng.choice(count, 2, replace=False).tolist())) for _ in range(count)]
    edges = np.array(sorted(set(tree + more)), np.int64)
    pairwise = rng.uniform(0.2, 2.0, (4, 4))
    pairwise = (pairwise + pairwise.T) / 2
    np.fill_diagonal(pairwise, 0.0)
    return Field(rng.uniform(0, 3, (count, 4)), edges, rng.uniform(0.1, 1.0, len(edges)), pairwise)


def regions(field: Field, labels: np.ndarray) -> int:
    return int(numbered(labels, field.edges).max()) + 1


def test_a_place_that_gains_little_joins_its_neighbours_and_one_that_gains_more_stays():
    """Five places in a row; the middle one is cheaper under label 1 by 5, less two borders of 1: it gains 3."""
    unary = np.zeros((5, 3))
    unary[:, 1:] = 9.0
    unary[2] = (5.0, 0.0, 9.0)
    labels = np.array([0, 0, 1, 0, 0])
    assert consolidated(chain(unary), labels, 2.9).tolist() == labels.tolist()
    assert consolidated(chain(unary), labels, 3.1).tolist() == [0] * 5
    assert labels.tolist() == [0, 0, 1, 0, 0]  # left as they were


def test_without_cost_or_neighbours_nothing_changes():
    field = random_field(0)
    labels = minimise(field, field.unary.argmin(axis=1))
    np.testing.assert_array_equal(consolidated(field, labels, 0.0), labels)
    alone = Field(np.ones((2, 3)), np.zeros((0, 2), np.int64), np.zeros(0), POTTS)
    assert consolidated(alone, np.array([0, 2]), 100.0).tolist() == [0, 2]


@pytest.mark.parametrize("seed", range(20))
def test_passes_over_what_was_relabelled_equal_passes_over_all(seed):
    field = random_field(seed)
    labels = field.unary.argmin(axis=1)
    expected, near, nobody = labels.copy(), arcs_of(len(labels), field.edges, field.weights), np.full(len(labels), -1)
    while len(_pass(expected, np.arange(len(labels)), near, nobody, *field, 2.0)):
        pass
    assert (nobody == -1).all()
    np.testing.assert_array_equal(consolidated(field, labels, 2.0), expected)


@pytest.mark.parametrize("cost", [0.5, 2.0, 8.0])
@pytest.mark.parametrize("seed", range(40))
def test_each_region_that_is_left_pays_and_those_given_away_did_not(seed, cost):
    field = random_field(seed)
    before = minimise(field, field.unary.argmin(axis=1))
    after = consolidated(field, before, cost)
    gone = regions(field, before) - regions(field, after)
    assert gone >= 0
    assert energy(field, after) <= energy(field, before) + cost * gone + 1e-9
    region_of = numbered(after, field.edges)
    for region in range(regions(field, after)):
        inside = region_of == region
        crossing = inside[field.edges[:, 0]] != inside[field.edges[:, 1]]
        for label in set(after[field.edges[crossing].reshape(-1)].tolist()) - set(after[inside].tolist()):
            otherwise = np.where(inside, label, after)
            assert energy(field, otherwise) - energy(field, after) >= cost - 1e-9


@pytest.mark.parametrize("seed", range(20))
def test_what_is_found_again_where_something_changed_is_what_is_found_anywhere(seed):
    """A hundred places, of which a few change at a time, in costs, labels or weights."""
    rng = np.random.default_rng(seed)
    field = fields.random_field(seed, 100, 4, degree=3)
    labels = field.unary.argmin(axis=1)
    found = consolidated(field, labels, 2.0)
    for _ in range(15):
        changed = found != labels  # given away
        costly, other, edges = rng.choice(100, 2), rng.choice(100, 2), rng.choice(len(field.edges), 2)
        field.unary[costly], field.weights[edges] = rng.uniform(0, 4, (2, 4)), rng.uniform(0, 1, 2)
        labels = labels.copy()
        labels[other] = rng.integers(0, 4, 2)
        changed[[*costly, *other, *field.edges[edges].reshape(-1)]] = True
        found = consolidated(field, labels, 2.0, changed, arcs_of(100, field.edges, field.weights))
        np.testing.assert_array_equal(found, consolidated(field, labels, 2.0))

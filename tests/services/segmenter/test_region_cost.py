"""Regions that must pay for themselves, against brute force on random fields."""

import itertools

import numpy as np
import pytest

from prior_sg.services.segmenter.core.energy.mrf import Field, energy
from prior_sg.services.segmenter.core.energy.region_cost import consolidated, passes
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


def weighed(field: Field, labels: np.ndarray) -> list[tuple[float, int, np.ndarray]]:
    """Gain, best other label and mask of each region that touches another; by the energy of the whole field."""
    found, region_of = [], numbered(labels, field.edges)
    for region in range(int(region_of.max()) + 1):
        inside = region_of == region
        crossing = inside[field.edges[:, 0]] != inside[field.edges[:, 1]]
        beside = sorted(set(labels[field.edges[crossing].reshape(-1)].tolist()) - set(labels[inside].tolist()))
        if beside:
            gains = [energy(field, np.where(inside, label, labels)) - energy(field, labels) for label in beside]
            found.append((min(gains), beside[int(np.argmin(gains))], inside))
    return found


def whole_pass(field: Field, labels: np.ndarray, cost: float) -> np.ndarray:
    """One pass as the module says, over all regions."""
    after, fixed = labels.copy(), np.zeros(len(labels), bool)
    for gain, best, inside in sorted(weighed(field, labels), key=lambda one: one[0]):
        if gain < cost and not fixed[inside].any():
            after[inside] = best
            touching = inside[field.edges].any(axis=1)
            fixed[np.isin(numbered(labels, field.edges), numbered(labels, field.edges)[field.edges[touching]])] = True
    return after


@pytest.mark.parametrize("seed", range(20))
def test_passes_are_those_over_all_regions(seed):
    field = random_field(seed)
    found = passes(field, field.unary.argmin(axis=1), 2.0)
    for before, after in itertools.pairwise([*found, found[-1]]):
        np.testing.assert_array_equal(after, whole_pass(field, before, 2.0))


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


@pytest.mark.parametrize("seed", range(30))
def test_what_is_gone_over_again_where_something_changed_is_what_is_found_from_nothing(seed):
    """A hundred places, of which a few change at a time, in costs, labels or weights, come or go."""
    rng = np.random.default_rng(seed)
    field, cost = fields.random_field(seed, 100, 4, degree=3), (1.0, 2.0, 4.0)[seed % 3]
    labels, found, deepest = field.unary.argmin(axis=1), [], 0
    for _ in range(25):
        costly, other, edges = rng.choice(100, 2), rng.choice(100, rng.integers(3)), rng.choice(len(field.edges), 2)
        field.unary[costly], field.weights[edges] = rng.uniform(0, 4, (2, 4)), rng.uniform(0, 1, 2)
        labels = labels.copy()
        labels[other] = rng.integers(0, 4, len(other))
        changed = np.array([*costly, *field.edges[edges].reshape(-1)])
        new = rng.choice(100, rng.integers(2))  # as a place that was not there before
        for one in found:
            one[new] = -1
        found = passes(field, labels, cost, found, changed=changed, ties=arcs_of(100, field.edges, field.weights))
        anew = passes(field, labels, cost)
        assert len(found) == len(anew)
        for one, other_one in zip(found, anew, strict=True):
            np.testing.assert_array_equal(one, other_one)
        deepest = max(deepest, len(found))
    assert deepest > 2

"""The homes of `prior-sg bench learning` follow the prior they are drawn from."""

import itertools

import msgspec
import numpy as np
import pytest

from prior_sg.deploy.benches import homes, learning
from prior_sg.deploy.benches.homes import DOORS, Sight

SURE = Sight(lookalike=0.2, detected=1.0, mistaken=0.0)


@pytest.fixture(scope="module")
def prior():
    return learning.prior_in_hand()


def cut(prior, count, adjacency):
    """The first regions of a prior, all equally common."""
    regions = [msgspec.structs.replace(region, existence=1 / count) for region in prior.regions[:count]]
    return msgspec.structs.replace(
        prior, regions=regions, adjacency=adjacency.astype(np.float32), containment=prior.containment[:count]
    )


def test_layouts_have_the_odds_of_touching(prior):
    """Against all 4^9 layouts: within the homes of the same rooms, a layout is as likely as the product of its odds."""
    adjacency = np.array([[0.5, 0.7, 0.5, 0.3], [0.7, 0.5, 0.4, 0.6], [0.5, 0.4, 0.5, 0.5], [0.3, 0.6, 0.5, 0.5]])
    every = np.array(list(itertools.product(range(4), repeat=9)))
    odds = adjacency / (1 - adjacency)
    np.fill_diagonal(odds, homes.SAME / (1 - homes.SAME))
    weight = odds[every[:, DOORS[:, 0]], every[:, DOORS[:, 1]]].prod(axis=1)
    _, kind, number = np.unique(np.sort(every, axis=1), axis=0, return_inverse=True, return_counts=True)
    kind = kind.ravel()
    weight *= number[kind] / np.bincount(kind, weight)[kind]
    drawn = homes.layouts(cut(prior, 4, adjacency), 6000, np.random.default_rng(0))
    for one, other in itertools.combinations(range(4), 2):

        def doors(labels, one=one, other=other):
            ends = np.sort(labels[:, DOORS], axis=2)
            return ((ends[..., 0] == one) & (ends[..., 1] == other)).sum(axis=1)

        expected = np.average(doors(every), weights=weight)
        assert doors(drawn).mean() == pytest.approx(expected, rel=0.06)


def test_touching_frequency_of_one_home():
    found = homes.touching_frequency(np.array([[0, 1, 2, 1, 0, 1, 2, 1, 2]]), 4)
    assert found[0, 1] == pytest.approx(6 / 8)  # two rooms of 0, four of 1: six of the eight pairs have a door
    assert found[0, 2] == 0 and found[0, 0] == 0 and np.isnan(found[3, 3])
    np.testing.assert_array_equal(found, found.T)


def test_exchanged_regions_keep_all_statements_but_others_say_them(prior):
    other = homes.exchanged(prior, 3, np.random.default_rng(1))
    other.check()
    moved = (prior.containment != other.containment).any(axis=1)
    assert moved.sum() == 6
    np.testing.assert_array_equal(np.sort(prior.containment, axis=0), np.sort(other.containment, axis=0))
    assert sorted(prior.adjacency.ravel()) == sorted(other.adjacency.ravel())


def test_errors_of_a_prior_that_is_right_and_of_one_that_is_not(prior):
    """Of 0.25 in each adjacency of different regions and nothing else; a right one has no gross errors to be told."""
    met = prior.adjacency + 0.25
    met[0, 1] = np.nan
    right = learning.errors(prior, prior, prior, met)
    assert right == pytest.approx({"containment_error": 0, "adjacency_error": 0.25, "existence_error": 0})
    other = homes.exchanged(prior, 3, np.random.default_rng(1))
    wrong = learning.errors(other, other, prior, met)
    gap = np.abs(other.containment - prior.containment)
    assert wrong["containment_error"] == pytest.approx(gap.mean())
    assert wrong["containment_error_gross"] == pytest.approx(gap[gap >= learning.GROSS].mean())
    assert learning.errors(prior, other, prior, met)["containment_error_gross"] == 0


def test_a_home_seen_well_is_labelled_and_counted_as_it_is(prior):
    certain = msgspec.structs.replace(prior, containment=(prior.containment > 0.3).astype(np.float32))
    labels = np.array([0, 1, 2, 3, 4, 5, 6, 7, 8])
    home = homes.home(labels, certain, SURE, learning.CFG.space, np.random.default_rng(0))
    assert len(home.places.edges) == 9 * 24 + 12 * 2  # in each room, through each of the doors
    state = learning.explore(home)
    learning.label(state, home, certain)
    assert learning.f1_s(home.truth, state) == 1.0
    seen = learning.prior_evidence.evidence(state, learning.CFG)
    np.testing.assert_array_equal(seen.holding[:9], certain.containment[:9])
    assert seen.touching.sum() == 2 * 12


def test_the_score_counts_wrong_labels(prior):
    home = homes.home(np.arange(9), prior, SURE, learning.CFG.space, np.random.default_rng(0))
    state = learning.explore(home)
    learning.label(state, home, prior)
    renamed = np.where(home.truth == 0, 11, home.truth)  # one of nine rooms is something else in truth
    assert learning.f1_s(renamed, state) == pytest.approx(8 / 9)

"""The map's label bias against hand-worked numbers, its defining property, and its bounds."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from prior_sg.services.segmenter.core.appearance.label_bias import BalanceConfig, label_bias

FREE = BalanceConfig(limit=100.0, half_places=1e-9, existence_share=1.0)


def softmax(scores):
    beliefs = np.exp(scores - scores.max(axis=1, keepdims=True))
    return beliefs / beliefs.sum(axis=1, keepdims=True)


def test_one_kind_of_place_by_hand():
    """All beliefs are (0.8, 0.2) and (0.5, 0.5) is expected: odds must fall by 4, log 4 / 2 = 0.69315 each way."""
    scores = np.log(np.tile((0.8, 0.2), (5, 1)))
    np.testing.assert_allclose(label_bias(scores, np.ones(2), FREE), (-0.69315, 0.69315), atol=1e-5)


def test_few_places_move_little_by_hand():
    """The same with 5 places of 20 that half of the correction takes: 5 / 25 of it, 0.13863."""
    scores = np.log(np.tile((0.8, 0.2), (5, 1)))
    cfg = BalanceConfig(limit=100.0, half_places=20.0, existence_share=1.0)
    np.testing.assert_allclose(label_bias(scores, np.ones(2), cfg), (-0.13863, 0.13863), atol=1e-5)


def test_expected_proportions_by_hand():
    """Half existence (0.9, 0.1), half uniform: (0.7, 0.3) is expected; even ones move by log(7 / 3) / 2 = 0.42365."""
    cfg = BalanceConfig(limit=100.0, half_places=1e-9, existence_share=0.5)
    bias = label_bias(np.zeros((4, 2)), np.array((0.9, 0.1)), cfg)
    np.testing.assert_allclose(bias, (0.42365, -0.42365), atol=1e-5)


@given(st.integers(0, 10_000))
def test_mean_belief_meets_the_expected_proportions(seed):
    rng = np.random.default_rng(seed)
    existence = rng.dirichlet(np.ones(4)) + 0.05
    scores = rng.normal(size=(60, 4)) + rng.normal(size=4)
    bias = label_bias(scores, existence, FREE)
    np.testing.assert_allclose(softmax(scores + bias).mean(axis=0), existence / existence.sum(), atol=2e-3)
    np.testing.assert_allclose(bias.mean(), 0.0, atol=1e-9)


def test_a_constant_offset_of_a_label_is_taken_out():
    rng = np.random.default_rng(0)
    scores, offset = rng.normal(size=(50, 3)), np.array((2.0, 0.0, -1.0))
    bias, shifted = (label_bias(s, np.ones(3), FREE) for s in (scores, scores + offset))
    np.testing.assert_allclose(bias - shifted, offset - offset.mean(), atol=1e-3)


def test_certain_evidence_is_only_moved_up_to_the_limit():
    cfg = BalanceConfig()
    scores = np.tile((0.0, -2000.0, -3000.0), (10_000, 1))
    bias = label_bias(scores, np.ones(3), cfg)
    assert np.isfinite(bias).all() and (np.abs(bias) <= cfg.limit).all()
    assert (scores + bias).argmax(axis=1).tolist() == [0] * len(scores)


def test_off_or_without_places_there_is_no_bias():
    scores = np.log(np.tile((0.8, 0.2), (5, 1)))
    np.testing.assert_array_equal(label_bias(scores, np.ones(2), BalanceConfig(limit=0.0)), 0.0)
    np.testing.assert_array_equal(label_bias(scores[:0], np.ones(2), BalanceConfig()), 0.0)


@pytest.mark.parametrize("fields", [{"limit": -1.0}, {"half_places": 0.0}, {"existence_share": 1.5}])
def test_impossible_settings_are_refused(fields):
    with pytest.raises(ValueError):
        BalanceConfig(**fields)

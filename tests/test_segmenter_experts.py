"""Experts against numbers worked by hand."""

import numpy as np
import pytest
from segmenter_world import prior, text

from schemas.priors import RegionPrior
from services.segmenter.experts import REGISTRY
from services.segmenter.experts.context import Context, standardised


def context(descriptors, frames, concepts=None, bias=(0.0, 0.0)):
    concepts = concepts or text(
        np.array([(1.0, 0.0), (0.0, 1.0)]),
        background_mean=np.array((0.5, 0.1), dtype=np.float32),
        background_std=np.array((0.25, 0.5), dtype=np.float32),
        temperature=1.0,
        null_score=0.5,
    )
    regions = [
        RegionPrior(name="kitchen", phrases=["k"], existence=0.8),
        RegionPrior(name="hall", phrases=["h"], existence=0.2),
    ]
    padded = np.zeros((len(descriptors), 6))
    padded[:, :2] = descriptors
    return Context(
        prior=prior(["kitchen", "hall"], regions=regions),
        text=concepts,
        similarity=standardised(padded, concepts),
        frames=np.array(frames),
        bias=np.array(bias),
    )


def test_visual_by_hand():
    """s = (0.6, 0.8): z = (0.1 / 0.25, 0.7 / 0.5) = (0.4, 1.4), null 0.5.

    exp: 1.49182, 4.05520, 1.64872; sum 7.19574; p = (0.20732, 0.56356); c = 0.77088; P = (0.26894, 0.73106).
    """
    log_probabilities, confidence = REGISTRY["visual"](context([(0.6, 0.8)], [3]))
    assert confidence[0] == pytest.approx(0.77088, abs=1e-5)
    np.testing.assert_allclose(np.exp(log_probabilities[0]), (0.26894, 0.73106), atol=1e-5)


def test_visual_bias_by_hand():
    """Odds of hall against kitchen are e^(1.4 - 0.4) = e; a bias of (0.5, -0.5) makes them even; the null has none."""
    log_probabilities, confidence = REGISTRY["visual"](context([(0.6, 0.8)], [3], bias=(0.5, -0.5)))
    np.testing.assert_allclose(np.exp(log_probabilities[0]), (0.5, 0.5))
    assert confidence[0] == pytest.approx(2 * np.exp(0.9) / (2 * np.exp(0.9) + np.exp(0.5)))


def test_visual_says_nothing_of_places_never_observed():
    log_probabilities, confidence = REGISTRY["visual"](context([(0.0, 0.0), (1.0, 0.0)], [0, 1]))
    assert confidence[0] == 0
    assert confidence[1] > 0
    assert np.isfinite(log_probabilities).all()


def test_visual_confidence_falls_when_the_null_class_wins():
    lower = context([(0.6, 0.8)], [1], text(np.eye(2), temperature=1.0, null_score=50.0))
    log_probabilities, confidence = REGISTRY["visual"](lower)
    assert confidence[0] < 1e-15
    assert np.exp(log_probabilities).sum() == pytest.approx(1.0)


def test_visual_is_stable_at_extreme_temperatures():
    hot = context([(0.6, 0.8)], [1], text(np.eye(2), temperature=1e4))
    log_probabilities, confidence = REGISTRY["visual"](hot)
    assert np.isfinite(log_probabilities).all()
    assert confidence[0] == pytest.approx(1.0)


def test_environment_is_the_existence_prior():
    log_probabilities, confidence = REGISTRY["environment"](context([(0.6, 0.8), (0.0, 0.0)], [1, 0]))
    np.testing.assert_allclose(np.exp(log_probabilities), [(0.8, 0.2), (0.8, 0.2)])
    np.testing.assert_array_equal(confidence, 1.0)

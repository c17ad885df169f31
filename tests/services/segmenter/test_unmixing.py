"""Crops told apart into places: against least squares, and information by hand."""

import numpy as np
import pytest
from scipy import sparse

from prior_sg.services.segmenter.core.appearance.information import InformationConfig, told, worth
from prior_sg.services.segmenter.core.appearance.unmixing import UnmixingConfig, unmixed
from prior_sg.services.segmenter.core.map.arcs import arcs_of
from prior_sg.services.segmenter.core.slices import at_once

LONG = UnmixingConfig(rounds=4000, steps=0, ridge=1e-9)


def apart(similarity, looks, shares, cfg):
    """On a graph without edges."""
    near = arcs_of(len(similarity), np.zeros((0, 2), np.int64), np.zeros(0))
    return at_once(unmixed(similarity, looks, sparse.csr_matrix(shares), near, cfg))


def test_two_places_that_every_crop_mixes_are_found_as_they_are():
    """Crops show 0.7 and 0.3 of a kitchen (4, 0) and a bath (0, 4): their mean tells kitchen from bath by 1.6 only."""
    shares, truth = np.array([(0.7, 0.3), (0.3, 0.7)]), np.array([(4.0, 0.0), (0.0, 4.0)])
    looks = shares @ truth
    blurred = shares.T @ looks
    assert blurred[0, 0] - blurred[0, 1] == pytest.approx(0.64)
    np.testing.assert_allclose(apart(blurred, looks, shares, LONG), truth, atol=1e-3)


def test_many_rounds_end_at_least_squares():
    rng = np.random.default_rng(1)
    shares = rng.uniform(0, 1, (30, 6)) ** 4
    shares /= shares.sum(axis=1, keepdims=True)
    looks = rng.normal(0, 2, (30, 4))
    expected = np.linalg.lstsq(shares, looks, rcond=None)[0]
    np.testing.assert_allclose(apart(np.zeros((6, 4)), looks, shares, LONG), expected, atol=1e-4)


def test_places_that_no_crop_shows_and_crops_that_show_nothing_change_nothing():
    similarity = np.array([(1.0, 2.0), (3.0, 4.0)])
    shares = np.array([(0.9, 0.0), (0.1, 0.0)])
    found = apart(similarity, np.array([(5.0, 5.0), (99.0, -99.0)]), shares, LONG)
    np.testing.assert_allclose(found, [(5.0, 5.0), (3.0, 4.0)], atol=1e-6)


def test_crops_tell_what_their_beliefs_share_with_the_labels():
    """Sure crops of four labels tell all; crops that say the same, however surely, nothing; unsure ones nothing."""
    many = 100_000 // 4
    sure = 50.0 * np.tile(np.eye(4), (many, 1))
    assert told(sure) == pytest.approx(1.0, abs=1e-3)
    assert told(50.0 * np.tile(np.eye(4)[:1], (4 * many, 1))) == pytest.approx(0.0, abs=1e-3)
    assert told(np.zeros((many, 4))) == pytest.approx(0.0, abs=1e-9)
    assert told(50.0 * np.eye(4)[:1]) == pytest.approx(20 / 21)  # one crop may well see one region only
    assert told(np.zeros((0, 4))) == told(np.zeros((5, 1))) == 0.0


def test_what_is_told_counts_between_two_bounds():
    cfg = InformationConfig(least=0.1, full=0.3)
    assert [worth(share, cfg) for share in (0.0, 0.1, 0.2, 0.3, 0.9)] == pytest.approx([0, 0, 0.5, 1, 1])


@pytest.mark.parametrize("wrong", [{"rounds": -1}, {"ridge": 0.0}])
def test_settings_out_of_range_are_refused(wrong):
    with pytest.raises(ValueError, match="range"):
        UnmixingConfig(**wrong)


def test_bounds_of_information_in_the_wrong_order_are_refused():
    with pytest.raises(ValueError, match="below"):
        InformationConfig(least=0.7)

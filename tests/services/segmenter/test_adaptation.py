"""What labels look like in a map: by hand, against a literal loop, and a map that the text alone gets wrong."""

import numpy as np
import pytest

from prior_sg.services.segmenter.core.appearance import adaptation
from prior_sg.services.segmenter.core.appearance.adaptation import Adaptation, AdaptationConfig, differs
from prior_sg.services.segmenter.core.slices import at_once

PLAIN = AdaptationConfig(rounds=1, half_places=0.0)


def adapted(*given):
    return at_once(adaptation.adapted(*given, visits=0))


def nearest(similarity):
    return similarity.argmax(axis=1)


def test_directions_by_hand():
    """Two places a label at +-1 on the first axis: the map's mean is 0, each label's direction is its side."""
    descriptors = np.array([(1.0, 0.3), (1.0, -0.3), (-1.0, 0.3), (-1.0, -0.3)])
    similarity = np.array([(2.0, 0.0), (2.0, 0.0), (0.0, 2.0), (0.0, 2.0)])
    found = adapted(descriptors, similarity, np.ones(4), nearest, PLAIN)
    np.testing.assert_allclose(found.center, 0.0, atol=1e-12)
    # the spread of each row is 1, that of the offsets along (1, 0) is 1: the direction is (1, 0) and gives +-1
    np.testing.assert_allclose(found.directions, [(1.0, 0.0), (-1.0, 0.0)], atol=1e-12)
    np.testing.assert_allclose(found.similarity(descriptors), [(1, -1), (1, -1), (-1, 1), (-1, 1)], atol=1e-12)
    half = adapted(descriptors, similarity, np.ones(4), nearest, AdaptationConfig(rounds=1, half_places=4.0))
    np.testing.assert_allclose(half.directions, found.directions / 2, atol=1e-12)


def test_directions_against_a_literal_loop():
    rng = np.random.default_rng(0)
    descriptors, similarity = rng.standard_normal((30, 5)), rng.standard_normal((30, 4))
    masses = rng.uniform(0.1, 5.0, 30)
    cfg = AdaptationConfig(weight=0.7, rounds=3, half_places=10.0)
    found = adapted(descriptors, similarity, masses, nearest, cfg)
    center = sum(m * d for m, d in zip(masses, descriptors, strict=True)) / sum(masses)
    variance = sum(m * ((row - row.mean()) ** 2).mean() for m, row in zip(masses, similarity, strict=True))
    scale = 0.7 * 30 / 40 * np.sqrt(variance / sum(masses))
    own = similarity
    for _ in range(3):
        best, directions = own.argmax(axis=1), []
        for label in range(4):
            members = [i for i in range(30) if best[i] == label]
            mean = sum(masses[i] * (descriptors[i] - center) for i in members) / sum(masses[i] for i in members)
            along = [(d - center) @ mean for d in descriptors]
            spread = np.sqrt(sum(m * a**2 for m, a in zip(masses, along, strict=True)) / sum(masses))
            directions.append(scale * mean / spread)
        own = np.array([[s + (d - center) @ a for s, a in zip(row, directions, strict=True)]
                        for row, d in zip(similarity, descriptors, strict=True)])  # fmt: skip
    np.testing.assert_allclose(found.directions, directions, atol=1e-9)


def test_a_label_that_nothing_resembles_most_gets_no_direction_and_all_alike_gives_none():
    descriptors = np.array([(1.0, 0.0), (0.0, 1.0)])
    found = adapted(descriptors, np.array([(1.0, 0.0, -1.0), (0.0, 1.0, -1.0)]), np.ones(2), nearest, PLAIN)
    assert (found.directions[2] == 0.0).all() and np.isfinite(found.directions).all()
    alike = adapted(np.ones((3, 2)), np.eye(3), np.ones(3), nearest, PLAIN)
    np.testing.assert_allclose(alike.similarity(np.ones((3, 2))), 0.0, atol=1e-9)


def test_before_the_map_was_looked_at_nothing_is_added():
    assert Adaptation().similarity(np.ones((2, 3))) == 0.0
    descriptors, similarity = np.array([(1.0, 0.0), (-1.0, 0.0)]), np.eye(2)
    found = adapted(descriptors, similarity, np.ones(2), nearest, PLAIN)
    assert differs(found, Adaptation(), descriptors, similarity, 0.05)
    assert not differs(found, found, descriptors, similarity, 0.0)


@pytest.mark.parametrize("settings", [{"weight": -1.0}, {"rounds": 0}, {"half_places": -1.0}])
def test_settings_out_of_range_are_refused(settings):
    with pytest.raises(ValueError, match="out of range"):
        AdaptationConfig(**settings)


def test_places_that_the_text_cannot_tell_apart_go_with_those_that_look_like_them():
    """Two kinds of places. The text knows half of each kind; the others share another, nameless feature with them."""
    rng = np.random.default_rng(1)
    kind = np.repeat((0, 1), 40)
    known = np.tile((True, False), 40)
    descriptors = 0.3 * rng.standard_normal((80, 8))
    descriptors[np.arange(80), 2 + kind] += 1.0  # what the text does not know
    similarity = 0.1 * rng.standard_normal((80, 2))
    similarity[known, kind[known]] += 1.0
    similarity[~known, 0] += 0.2  # misled, weakly
    assert (similarity.argmax(axis=1) == kind).mean() < 0.8
    found = adapted(descriptors, similarity, np.ones(80), nearest, AdaptationConfig())
    assert ((similarity + found.similarity(descriptors)).argmax(axis=1) == kind).mean() > 0.9

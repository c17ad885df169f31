"""Experts against numbers worked by hand."""

import re

import numpy as np
import pytest

from prior_sg.schemas.priors import LEAST_STD_RAD, Counts, RegionPrior
from prior_sg.services.segmenter.core.experts import REGISTRY
from prior_sg.services.segmenter.core.experts.contents import words_of_contents
from prior_sg.services.segmenter.core.experts.context import Context, ObjectSettings, ObjectView, standardised
from prior_sg.services.segmenter.core.experts.object import region_of_concept
from tests.help.paths import ROOT
from tests.help.world import prior, text


def context(descriptors, frames, concepts=None, bias=(0.0, 0.0), **changes):
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
    count = len(descriptors)
    fields = {
        "prior": prior(["kitchen", "hall"], regions=regions),
        "text": concepts,
        "similarity": standardised(padded, concepts),
        "frames": np.array(frames),
        "bias": np.array(bias),
        "positions_m": np.zeros((count, 3)),
        "radii_m": np.full(count, 0.5),
        "inclination_rad": np.zeros(count),
        "support": np.full(count, 0.5),
        "anisotropy": np.full(count, 0.8),
    }
    return Context(**(fields | changes))


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


def inclined(means_rad, stds_rad):
    rows = zip(("kitchen", "hall"), means_rad, stds_rad, strict=True)
    return [
        RegionPrior(name=name, phrases=["p"], existence=0.5, inclination_mean_rad=mean, inclination_std_rad=std)
        for name, mean, std in rows
    ]


def test_geometric_by_hand():
    """kappa = 1 / 0.5^2 = 4; theta = 30 degrees: cos 30 = 0.86603 against 0, cos 0 = 1 against 30 degrees.

    Odds e^(4 (1 - 0.86603)) = e^0.53590 = 1.70898; P = (0.36914, 0.63086); confidence 0.5 x 0.8.
    """
    fields = {"prior": prior(["kitchen", "hall"], regions=inclined((0.0, np.pi / 6), (0.5, 0.5)))}
    found = context([(0.6, 0.8)], [1], inclination_rad=np.array([np.pi / 6]), **fields)
    log_probabilities, confidence = REGISTRY["geometric"](found)
    np.testing.assert_allclose(np.exp(log_probabilities[0]), (0.36914, 0.63086), atol=1e-5)
    assert confidence[0] == pytest.approx(0.4)


def test_the_sharpest_and_the_widest_spread_of_a_prior_are_numbers():
    for spread in (LEAST_STD_RAD, 1e300):
        fields = {"prior": prior(["kitchen", "hall"], regions=inclined((0.0, np.pi / 2), (spread, spread)))}
        angles = np.array([0.0, 0.7, np.pi / 2])
        found = context([(0.6, 0.8)] * 3, [1] * 3, inclination_rad=angles, **fields)
        assert not np.isnan(REGISTRY["geometric"](found)[0]).any()


def test_geometric_densities_are_normalised():
    """With the same mean, the sharper region wins at it by I0(1) e^25 / (I0(25) e) and loses far away."""
    from scipy.stats import vonmises

    fields = {"prior": prior(["kitchen", "hall"], regions=inclined((0.0, 0.0), (0.2, 1.0)))}
    angles = np.array([0.0, 0.5, 1.5])
    found = context([(0.6, 0.8)] * 3, [1] * 3, inclination_rad=angles, **fields)
    densities = np.stack((vonmises.pdf(angles, 25.0), vonmises.pdf(angles, 1.0)), axis=1)
    expected = densities / densities.sum(axis=1, keepdims=True)
    np.testing.assert_allclose(np.exp(REGISTRY["geometric"](found)[0]), expected, rtol=1e-6)
    assert expected[0, 0] > 0.7 and expected[2, 0] < 0.3


CONTAINMENT = np.array([(0.9, 0.1), (0.3, 0.3)], dtype=np.float32)  # of oven and bed in kitchen and hall


def test_region_of_concept_by_hand():
    """Oven: 0.9 x 0.8 against 0.3 x 0.2, 0.72 : 0.06 = (0.92308, 0.07692); bed: 0.08 : 0.06 = (0.57143, 0.42857)."""
    found = region_of_concept(context([(0.6, 0.8)], [1]).prior)
    np.testing.assert_allclose(found, [(0.8, 0.2), (0.8, 0.2)])  # the test prior's containment is uniform
    regions = context([(0.6, 0.8)], [1]).prior.regions
    found = region_of_concept(prior(["kitchen", "hall"], regions=regions, containment=CONTAINMENT))
    np.testing.assert_allclose(found, [(0.92308, 0.07692), (0.57143, 0.42857)], atol=1e-5)
    nowhere = prior(["kitchen", "hall"], regions=regions, containment=np.zeros((2, 2), np.float32))
    np.testing.assert_allclose(region_of_concept(nowhere), [(0.8, 0.2), (0.8, 0.2)])


def with_objects(positions_m, concepts):
    base = context([(0.6, 0.8)] * 3, [1] * 3)
    view = ObjectView(ids=np.arange(len(concepts)), positions_m=np.array(positions_m), concepts=np.array(concepts))
    return context(
        [(0.6, 0.8)] * 3,
        [1] * 3,
        prior=prior(["kitchen", "hall"], regions=base.prior.regions, containment=CONTAINMENT),
        positions_m=np.array([(0.0, 0.0, 1.0), (1.0, 0.0, 1.0), (9.0, 0.0, 1.0)]),
        objects=view,
        object_settings=ObjectSettings(decay_m=2.0, reach_m=3.0),
    )


def test_objects_by_hand():
    """An oven at x = 1 and something that is half oven, half bed at x = -2; gamma 2 m, reach 3 m.

    P(r | o) = (0.92308, 0.07692) and (0.74725, 0.25275). Place 0: weights e^-0.5 = 0.60653, e^-1 = 0.36788; pooled
    kitchen max(0.55987, 0.27490) = 0.55987, hall max(0.04666, 0.09298) = 0.09298; mass 0.65285; P = (0.85758, 0.14242).
    Place 1: weights 1 and e^-1.5 = 0.22313 at exactly 3 m: 0.92308, max(0.07692, 0.05640) = 0.07692; mass 1. Place 2 is
    out of reach.
    """
    found = with_objects([(1.0, 0.0, 1.0), (-2.0, 0.0, 1.0)], [(1.0, 0.0), (0.5, 0.5)])
    log_probabilities, confidence = REGISTRY["object"](found)
    np.testing.assert_allclose(confidence, (0.65285, 1.0, 0.0), atol=1e-5)
    np.testing.assert_allclose(np.exp(log_probabilities[:2]), [(0.85758, 0.14242), (0.92308, 0.07692)], atol=1e-5)
    np.testing.assert_allclose(np.exp(log_probabilities[2]), (0.5, 0.5))


def test_object_confidence_ends_at_one():
    """At the place itself, an oven and a bed: pooled kitchen 0.92308, hall 0.42857, mass 1.35165."""
    found = with_objects([(0.0, 0.0, 1.0), (0.0, 0.0, 1.0)], [(1.0, 0.0), (0.0, 1.0)])
    log_probabilities, confidence = REGISTRY["object"](found)
    assert confidence[0] == 1.0
    np.testing.assert_allclose(np.exp(log_probabilities[0]), (0.92308 / 1.35165, 0.42857 / 1.35165), atol=1e-5)


def test_without_objects_nothing_is_said():
    log_probabilities, confidence = REGISTRY["object"](context([(0.6, 0.8)], [1]))
    assert confidence[0] == 0
    np.testing.assert_allclose(np.exp(log_probabilities[0]), (0.5, 0.5))


def test_contents_by_hand():
    """An oven, P(o | r) = 0.9 and 0.3 with mean 0.6, counted in 2 and 6 regions, of which 2 make a row count half:

    log 1.5 x 2 / 4 = 0.20273 and log 0.5 x 6 / 8 = -0.51986; P = (0.67318, 0.32682).
    """
    regions = context([(0.6, 0.8)], [1]).prior.regions
    counted = Counts(regions=np.array([2.0, 6.0], np.float32))
    known = prior(["kitchen", "hall"], regions=regions, containment=CONTAINMENT, tested=counted)
    words = words_of_contents(known, np.array([(1.0, 0.0), (0.0, 0.0)]))
    log_probabilities, confidence = REGISTRY["contents"](
        context([(0.6, 0.8)] * 2, [1] * 2, prior=known, contents=words)
    )
    np.testing.assert_allclose(np.exp(log_probabilities), [(0.67318, 0.32682), (0.5, 0.5)], atol=1e-5)
    np.testing.assert_allclose(confidence, (1.0, 0.0))
    untested = prior(["kitchen", "hall"], regions=regions, containment=CONTAINMENT)
    assert not words_of_contents(untested, np.array([(1.0, 0.0)])).any()


@pytest.mark.parametrize("seed", range(3))
def test_objects_equal_the_equations_written_out(seed):
    rng = np.random.default_rng(seed)
    count, number = 20, 7
    places_m, objects_m = rng.uniform(0, 4, (count, 3)), rng.uniform(0, 4, (number, 3))
    concepts = rng.dirichlet((1, 1), number)
    base = with_objects(objects_m, concepts)
    settings = base.object_settings
    found = context(
        [(0.6, 0.8)] * count,
        [1] * count,
        prior=base.prior,
        positions_m=places_m,
        objects=base.objects,
        object_settings=settings,
    )
    log_probabilities, confidence = REGISTRY["object"](found)
    by_concept = region_of_concept(base.prior)
    for place in range(count):
        pooled = [0.0, 0.0]
        for item in range(number):
            distance_m = np.linalg.norm(places_m[place] - objects_m[item])
            weight = np.exp(-distance_m / settings.decay_m) if distance_m <= settings.reach_m else 0.0
            for region in range(2):
                share = sum(by_concept[c, region] * concepts[item, c] for c in range(2))
                pooled[region] = max(pooled[region], weight * share)
        assert confidence[place] == pytest.approx(min(sum(pooled), 1.0))
        if sum(pooled):
            np.testing.assert_allclose(np.exp(log_probabilities[place]), np.array(pooled) / sum(pooled))


def test_the_expert_of_the_documentation_works():
    """Spheres of 1 m and 4 m: the small one fits everywhere; the large one sticks out of a 2.6 m room by 1.4 m."""
    page = (ROOT / "docs" / "extending.md").read_text()
    code = re.search(r"```python\n(# services/segmenter/core/experts/ceiling.py.*?)```", page, re.DOTALL).group(1)
    names: dict = {}
    exec(code, names)  # the page's own code
    regions = [RegionPrior(name=name, phrases=["p"], existence=0.5) for name in ("kitchen", "station hall")]
    fields = {"prior": prior(["kitchen", "station hall"], regions=regions), "radii_m": np.array((0.5, 2.0))}
    log_probabilities, confidence = names["ceiling"](context([(0.6, 0.8)] * 2, [1, 1], **fields))
    np.testing.assert_allclose(np.exp(log_probabilities[0]), (0.5, 0.5))
    assert log_probabilities[1, 1] - log_probabilities[1, 0] == pytest.approx(0.5 * (1.4 / 0.3) ** 2)
    np.testing.assert_allclose(confidence, (1 / 3, 1.0))


def test_the_test_of_the_documentation_works(monkeypatch):
    page = (ROOT / "docs" / "extending.md").read_text()
    expert = re.search(r"```python\n(# services/segmenter/core/experts/ceiling.py.*?)```", page, re.DOTALL).group(1)
    test = re.search(r"```python\n(def test_ceiling_by_hand.*?)```", page, re.DOTALL).group(1)
    names: dict = {}
    exec(expert, names)  # the page's own code
    monkeypatch.setitem(REGISTRY, "ceiling", names["ceiling"])
    here = dict(globals())
    exec(test, here)
    here["test_ceiling_by_hand"]()

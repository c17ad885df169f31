"""Components, ids that last, and footprints."""

import numpy as np
import pytest

from services.segmenter.regions import NO_REGION, components, footprint_m2, track


def test_components_by_hand():
    labels = np.array([0, 0, 1, 1, 0, 0])
    edges = np.array([(0, 1), (1, 2), (2, 3), (3, 4)])  # 5 has no edge
    assert components(labels, edges).tolist() == [0, 0, 1, 1, 2, 3]
    assert components(np.zeros(3, int), np.zeros((0, 2), int)).tolist() == [0, 1, 2]
    assert len(components(np.zeros(0, int), np.zeros((0, 2), int))) == 0


N = NO_REGION
TRACKING = [  # name, components, ids before, next id, ids after, next id after
    ("first time", [0, 0, 1], [N, N, N], 0, [0, 0, 1], 2),
    ("unchanged", [0, 0, 1], [7, 7, 3], 9, [7, 7, 3], 9),
    ("growth", [0, 0, 0, 1], [4, 4, N, 2], 9, [4, 4, 4, 2], 9),
    ("split: the larger part keeps the id", [0, 1, 1], [4, 4, 4], 9, [9, 4, 4], 10),
    ("even split: the older place keeps the id", [0, 0, 1, 1], [4, 4, 4, 4], 9, [4, 4, 9, 9], 10),
    ("merge: the larger id survives", [0, 0, 0], [2, 5, 5], 9, [5, 5, 5], 9),
    ("even merge: the older id survives", [0, 0], [5, 2], 9, [2, 2], 9),
    ("a place changes sides", [0, 1, 1, 1], [1, 1, 2, 2], 9, [1, 2, 2, 2], 9),
    ("an id follows most of its places, not a remnant", [0, 0, 0, 0, 0, 1], [1, 1, 1, 2, 2, 2], 9, [1] * 5 + [9], 10),
]


@pytest.mark.parametrize("case", TRACKING, ids=[case[0] for case in TRACKING])
def test_track(case):
    _, component, before, next_id, after, next_after = case
    ids, following = track(np.array(component), np.array(before), next_id)
    assert ids.tolist() == after
    assert following == next_after


def test_tracked_ids_are_distinct_and_never_used_again():
    rng = np.random.default_rng(0)
    ids, next_id, dead = np.full(40, NO_REGION), 0, set()
    for _ in range(60):
        alive = set(ids.tolist()) - {NO_REGION}
        component = components(rng.integers(0, 3, 40), np.stack((np.arange(39), np.arange(1, 40)), axis=1))
        ids, next_id = track(component, ids, next_id)
        assert len(set(zip(component.tolist(), ids.tolist(), strict=True))) == len(set(ids.tolist()))
        assert len(set(component.tolist())) == len(set(ids.tolist()))
        dead |= alive - set(ids.tolist())
        assert not dead & set(ids.tolist())


def test_footprint_of_discs():
    one = np.array([(3.3, -2.1, 1.0)])
    assert footprint_m2(one, np.array([1.0]), 0.02) == pytest.approx(np.pi, rel=0.01)
    apart = np.array([(0.0, 0.0, 0.0), (10.0, 3.0, 2.0)])
    assert footprint_m2(apart, np.array([1.0, 0.5]), 0.02) == pytest.approx(1.25 * np.pi, rel=0.01)
    inside = np.array([(0.0, 0.0, 0.0), (0.2, 0.1, 5.0)])
    assert footprint_m2(inside, np.array([1.0, 0.5]), 0.02) == pytest.approx(np.pi, rel=0.01)
    lens = 2 * np.pi / 3 - np.sqrt(3) / 2  # two unit discs whose centres are one radius apart
    overlapping = np.array([(0.0, 0.0, 0.0), (1.0, 0.0, 0.0)])
    assert footprint_m2(overlapping, np.ones(2), 0.02) == pytest.approx(2 * np.pi - lens, rel=0.01)


def test_footprint_of_discs_smaller_than_a_cell():
    assert footprint_m2(np.array([(0.0, 0.0, 0.0)]), np.array([0.0]), 0.1) <= 0.01

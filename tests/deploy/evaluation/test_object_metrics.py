"""Found objects against true ones: cases worked by hand, and all pairings of small random cases."""

import itertools
import math

import numpy as np
import pytest

from prior_sg.deploy.evaluation.object_metrics import (
    NOTHING,
    OBJECT_SCORES,
    OBJECT_SHARES,
    distances_m,
    object_scores,
    pairs,
)
from prior_sg.deploy.truth import TrueObject
from prior_sg.schemas.objects import SceneObject
from prior_sg.schemas.places import VoxelMap

VOXEL_M = 0.1
NAMES = ["chair", "table"]


def true(label, x, y=0.0, side=1.0):
    return TrueObject(label, np.array([x, y, 0.0]), np.array([x + side, y + side, 1.0]))


def found(label, x, y=0.5, number=0):
    return SceneObject(
        id=number,
        label=label,
        probability=0.9,
        known=0.9,
        position_m=(x, y, 0.5),
        min_m=(x - 0.1, y - 0.1, 0.4),
        max_m=(x + 0.1, y + 0.1, 0.6),
        frames=3,
    )


def seeing(objects):
    """A map in which the middle of each object is occupied."""
    middles = [np.floor((item.min_m + item.max_m) / 2 / VOXEL_M) for item in objects]
    occupied = np.array(middles, np.int16).reshape(-1, 3)
    return VoxelMap(robot="r", voxel_m=VOXEL_M, free=np.zeros((0, 3), np.int16), occupied=occupied)


def score(items, truth, seen=None):
    return object_scores(items, truth, NAMES, seeing(truth if seen is None else seen))


def test_distances_count_from_the_true_box():
    items = [found("", 0.5), found("", 1.3), found("", 1.3, 1.4), found("", -0.5)]
    np.testing.assert_allclose(distances_m(items, [true("chair", 0)])[:, 0], [0, 0.3, 0.5, 0.5], atol=1e-12)


def test_place_and_name_are_scored_apart():
    truth = [true("chair", 0), true("table", 5), true("chair", 10)]
    items = [found("chair", 0.5), found("chair", 5.5), found("", 20.0)]
    scores = score(items, truth)
    assert list(scores) == list(OBJECT_SCORES)
    assert scores["objects_precision"] == pytest.approx(2 / 3)  # the third stands nowhere
    assert scores["objects_recall"] == pytest.approx(2 / 3)  # nobody found the second chair
    assert scores["objects_named_precision"] == pytest.approx(1 / 2)  # two claims, one at the table is wrong
    assert scores["objects_named_recall"] == pytest.approx(1 / 3)
    assert (scores["objects_found"], scores["objects_true"], scores["objects_named"]) == (3, 3, 2)


def test_half_a_metre_is_near_and_more_is_not():
    assert score([found("", 1.5)], [true("chair", 0)])["objects_recall"] == 1
    assert score([found("", 1.501)], [true("chair", 0)])["objects_recall"] == 0


def test_centred_pairs_have_their_middles_near():
    truth = [true("table", 0, side=3.0), true("table", 5)]
    scores = score([found("", 0.5), found("", 5.5)], truth)  # both inside, the first at the rim of a large table
    assert scores["objects_precision"] == scores["objects_recall"] == 1
    assert scores["objects_centred_precision"] == scores["objects_centred_recall"] == 0.5


def test_two_pieces_of_one_object_are_one_hit_and_one_error():
    scores = score([found("", 0.3), found("", 0.7)], [true("table", 0)])
    assert (scores["objects_precision"], scores["objects_recall"]) == (0.5, 1.0)


def test_things_that_nobody_asked_for_are_neither_right_nor_wrong():
    truth = [true("chair", 0), true("vase", 5), true("table", 10)]
    items = [found("chair", 0.5), found("", 5.5), found("", 10.5), found("", 5.2)]
    scores = score(items, truth, seen=truth[:2])  # the table was never seen
    assert scores["objects_true"] == 1
    assert scores["objects_ignored"] == 2  # the vase and the table; the second piece of the vase stays wrong
    assert scores["objects_precision"] == pytest.approx(1 / 2)
    assert scores["objects_recall"] == 1


def test_a_wrong_name_is_wrong_even_on_a_thing_that_nobody_asked_for():
    scores = score([found("chair", 5.5)], [true("chair", 0), true("vase", 5)])
    assert scores["objects_named_precision"] == 0
    assert math.isnan(scores["objects_precision"])  # by place it is ignored, so nothing is claimed


def test_a_pair_is_given_up_for_two():
    truth = [true("chair", 0), true("table", 1.6)]
    items = [
        found("", 1.35, number=0),
        found("", 2.0, number=1),
    ]  # the first is 0.25 m from the table, 0.35 from the chair
    assert score(items, truth)["objects_recall"] == 1


def test_shares_of_nothing_are_no_scores():
    scores = score([], [true("vase", 0)])
    assert all(math.isnan(scores[name]) for name in OBJECT_SHARES)
    assert score([], [true("chair", 0)])["objects_recall"] == 0
    assert score([found("", 0.0)], [])["objects_precision"] == 0


def value(columns, distances, wanted):
    """What `pairs` promises to make as large as possible, in this order."""
    chosen = [(row, column) for row, column in enumerate(columns) if column != NOTHING]
    hits = sum(bool(wanted[column]) for _, column in chosen)
    return hits, len(chosen) - hits, -sum(distances[pair] for pair in chosen)


@pytest.mark.parametrize("seed", range(40))
def test_no_pairing_is_better(seed):
    rng = np.random.default_rng(seed)
    rows, columns = rng.integers(1, 5, 2)
    distances = np.where(rng.random((rows, columns)) < 0.6, rng.uniform(0, 0.5, (rows, columns)), np.inf)
    wanted = rng.random(columns) < 0.5
    every = itertools.product(range(NOTHING, columns), repeat=rows)
    valid = [
        option
        for option in every
        if len({c for c in option if c != NOTHING}) == sum(c != NOTHING for c in option)
        and all(c == NOTHING or np.isfinite(distances[r, c]) for r, c in enumerate(option))
    ]
    best = max(value(option, distances, wanted) for option in valid)
    mine = value(pairs(distances, wanted).tolist(), distances, wanted)
    assert mine[:2] == best[:2]
    assert mine[2] == pytest.approx(best[2])

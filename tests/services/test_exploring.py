"""Expected metres of openings against all orders by hand."""

import itertools
import tracemalloc

import numpy as np
import pytest

from prior_sg.services.exploring import DETOUR, chances_per_metre, expected_metres


def metres_in_order(order, distances_m, points_m, chances):
    """Each leg times the chance that it is walked."""
    total, missed, here = 0.0, 1.0, None
    for there in order:
        leg = distances_m[there] if here is None else DETOUR * np.linalg.norm(points_m[here] - points_m[there])
        total += missed * (leg + 3.0)
        missed *= 1 - chances[there]
        here = there
    return total + missed * 40.0


def test_one_opening_is_its_way_and_what_is_missed():
    found = expected_metres(np.array([4.0]), np.zeros((1, 3)), np.array([0.25]), 2.0, 40.0)
    assert found == pytest.approx([4 + 2 + 0.75 * 40])


def test_every_first_opening_is_followed_by_some_order_of_the_others():
    rng = np.random.default_rng(3)
    for _ in range(20):
        count = 4
        points_m, distances_m = rng.uniform(0, 20, (count, 3)), rng.uniform(1, 20, count)
        chances = rng.uniform(0.05, 0.9, count)
        found = expected_metres(distances_m, points_m, chances, 3.0, 40.0)
        for first in range(count):
            rest = [other for other in range(count) if other != first]
            orders = [
                metres_in_order([first, *order], distances_m, points_m, chances)
                for order in itertools.permutations(rest)
            ]
            assert any(found[first] == pytest.approx(order) for order in orders)


def test_a_near_opening_is_passed_by_where_a_far_one_is_surer():
    distances_m, points_m = np.array([2.0, 6.0]), np.array([[2.0, 0, 0], [-6.0, 0, 0]])
    assert expected_metres(distances_m, points_m, np.array([0.05, 0.9]), 3.0, 40.0).argmin() == 1
    assert expected_metres(distances_m, points_m, np.array([0.5, 0.5]), 3.0, 40.0).argmin() == 0


def test_the_chance_by_metre_counts_the_look_behind():
    found = chances_per_metre(np.array([1.0, 5.0, np.inf]), np.array([0.2, 0.9, 1.0]), 1.0)
    assert found == pytest.approx([0.1, 0.15, 0.0])


def test_where_one_stands_and_looks_for_nothing_the_chance_by_metre_is_a_number():
    found = chances_per_metre(np.array([0.0, 0.0, 1.0]), np.array([0.2, 0.9, 1.0]), 0.0)
    assert np.isfinite(found).all() and found.argmax() == 1


def test_what_has_no_chance_comes_by_its_way_alone():
    assert chances_per_metre(np.array([9.0, 4.0]), np.zeros(2), 1.0).argmax() == 1


def test_what_cannot_be_reached_is_never_first():
    distances_m = np.array([np.inf, 50.0])
    found = expected_metres(distances_m, np.zeros((2, 3)), np.array([0.9, 0.1]), 3.0, 40.0)
    assert np.isinf(found[0]) and np.isfinite(found[1])


def test_no_openings_no_metres():
    assert expected_metres(np.zeros(0), np.zeros((0, 3)), np.zeros(0), 3.0, 40.0).shape == (0,)


def test_some_openings_of_thousands_take_the_memory_and_time_of_those():
    rng = np.random.default_rng(5)
    points_m, distances_m, chances = rng.uniform(0, 50, (4000, 3)), rng.uniform(1, 50, 4000), rng.uniform(0, 0.3, 4000)
    few = np.array([17, 3999, 5])
    tracemalloc.start()
    found = expected_metres(distances_m, points_m, chances, 3.0, 40.0, firsts=few)
    _, most_b = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most_b < 2**20, "no matrix of all openings by all"
    assert found == pytest.approx(expected_metres(distances_m, points_m, chances, 3.0, 40.0)[few])

"""Maps find together by what is in them, and are refused when unsure."""

import itertools

import numpy as np
import pytest

from prior_sg.deploy.fleet.core.finding.cliques import maximum_clique
from prior_sg.deploy.fleet.core.finding.config import MatchConfig
from prior_sg.deploy.fleet.core.finding.frames import apart, fitted, level, yaw_of
from prior_sg.deploy.fleet.core.finding.matching import map_of, match, weighed
from prior_sg.deploy.fleet.core.finding.refine import refined
from prior_sg.services.geometry import transform
from tests.help import houses

CFG = MatchConfig()
MOVED = level(2.3, np.array((12.0, -7.0, 0.4)))


def brute(joined):
    """Size of the largest clique, by trying all sets."""
    count = len(joined)
    for size in range(count, 0, -1):
        for nodes in itertools.combinations(range(count), size):
            if all(joined[a, b] for a, b in itertools.combinations(nodes, 2)):
                return size
    return 0


@pytest.mark.parametrize("seed", range(12))
def test_cliques_are_the_largest(seed):
    rng = np.random.default_rng(seed)
    joined = rng.random((10, 10)) < 0.5
    joined |= joined.T
    found = maximum_clique(joined)
    assert found.complete and len(found.nodes) == brute(joined)
    assert all(joined[a, b] for a, b in itertools.combinations(found.nodes, 2))


def test_a_clique_that_took_too_long_is_one_all_the_same():
    joined = np.random.default_rng(0).random((60, 60)) < 0.9
    joined |= joined.T
    found = maximum_clique(joined, most_branches=20)
    assert not found.complete
    assert all(joined[a, b] for a, b in itertools.combinations(found.nodes, 2))


def test_motions_are_fitted_exactly():
    points = np.random.default_rng(1).normal(size=(6, 3))
    assert fitted(points, transform(MOVED, points)) == pytest.approx(MOVED)
    assert yaw_of(MOVED) == pytest.approx(2.3)


def test_parts_of_one_house_find_together():
    one = map_of(houses.scene(rooms=houses.ROOMS[:4], noise_m=0.02))
    other = map_of(houses.scene("r2", MOVED, rooms=houses.ROOMS[1:], offset_m=0.2, noise_m=0.02, seed=1, wrong={2}))
    found = match(one, other, CFG)
    assert found.b_from_a is not None, found.why
    gap_m, gap_rad = apart(found.b_from_a, MOVED, one.shape.centers_m.mean(axis=0))
    assert gap_m < 0.15 and gap_rad < np.radians(2)


def test_fitting_brings_a_wrong_start_nearer():
    one, other = map_of(houses.scene()), map_of(houses.scene("r2", MOVED, offset_m=0.2))
    start = level(0.05, np.array((0.2, -0.15, 0.0))) @ MOVED
    middle_m = one.shape.centers_m.mean(axis=0)
    before, after = (apart(pose, MOVED, middle_m) for pose in (start, refined(start, one.shape, other.shape)))
    assert after[0] < 0.3 * before[0] and after[1] < 0.3 * before[1]


def test_walls_in_anothers_free_space_speak_against_it():
    one, other = map_of(houses.scene()), map_of(houses.scene("r2"))
    right = weighed(np.eye(4), one, other).evidence
    wrong = weighed(level(0.0, np.array((1.5, 0.7, 0.0))), one, other).evidence
    assert right.fitting == 1.0 and right.objects_same == len(houses.THINGS) and not right.objects_gone
    assert wrong.fitting < 0.6 and wrong.objects_same <= 2 and wrong.total < 0.2 * right.total


def test_another_house_is_refused():
    rooms = [
        ("kitchen", 0, 0, 4.2, 3),
        ("hallway", 4.2, 0, 5.6, 6),
        ("bedroom", 0, 3, 4.2, 6),
        ("bathroom", 5.6, 0, 8, 6),
    ]
    things = [("stove", 3.5, 0.4), ("table", 1.5, 1.5), ("bed", 1.0, 5.2), ("toilet", 7.5, 5.5), ("sink", 6.0, 3.0)]
    other = map_of(houses.scene("r2", MOVED, rooms=rooms, things=things))
    assert match(map_of(houses.scene()), other, CFG).b_from_a is None


def test_two_ways_that_are_equally_likely_are_refused():
    """A house that is the same turned by half."""
    turn = level(np.pi, np.array((8.0, 9.0, 0.0)))
    things = [("sofa", 2.0, 2.0), ("table", 1.0, 0.7), ("stove", 3.3, 3.2), ("bed", 2.9, 0.8), ("plant", 4.0, 3.6)]
    things += [(label, *transform(turn, np.array([[x, y, 0.0]]))[0, :2]) for label, x, y in things]
    rooms = [("kitchen", 0.0, 0.0, 8.0, 4.0), ("hallway", 0.0, 4.0, 8.0, 5.0), ("kitchen", 0.0, 5.0, 8.0, 9.0)]
    one = map_of(houses.scene(rooms=rooms, things=things))
    found = match(one, map_of(houses.scene("r2", MOVED, rooms=rooms, things=things)), CFG)
    assert found.b_from_a is None and "nearly as likely" in found.why


def test_small_maps_wait():
    few = houses.scene(rooms=[("hallway", 0.0, 4.0, 2.0, 5.5)])
    found = match(map_of(few), map_of(houses.scene()), CFG)
    assert found.b_from_a is None and "places yet" in found.why


@pytest.mark.parametrize("things", [[], houses.THINGS[:1]])
def test_rooms_alone_never_suffice(things):
    one, other = houses.scene(things=things), houses.scene("r2", MOVED, offset_m=0.2)
    for found in (match(map_of(one), map_of(other), CFG), match(map_of(other), map_of(one), CFG)):
        assert found.b_from_a is None and found.why

"""The light explorer on a plan made by hand, scores on events made by hand, and fitting of what is known."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from prior_sg.deploy.evaluation.foresight.explorer import Explorer, Plan, crossings
from prior_sg.deploy.evaluation.foresight.fitting import fitted, fitted_to_maps, fitted_toward, fitted_within
from prior_sg.deploy.evaluation.foresight.loops import FAR, flooded
from prior_sg.deploy.evaluation.foresight.mapped import behind, covered, ground_of
from prior_sg.deploy.evaluation.foresight.predictors import PREDICTORS
from prior_sg.deploy.evaluation.foresight.scores import chance_figures, figures, judge, search_figures
from prior_sg.deploy.evaluation.foresight.searches import POLICIES, Quest, metres
from prior_sg.deploy.evaluation.foresight.trials import SAME, Moment, Trial, go, ways_left
from prior_sg.deploy.evaluation.worlds.ways import CELL_M, LEVELS, ways_of
from prior_sg.services.segmenter.core.foresight.around import fading
from prior_sg.services.segmenter.core.foresight.beyond import Views, beyond, leads, leads_features
from prior_sg.services.segmenter.core.foresight.config import ForesightConfig
from prior_sg.services.segmenter.core.foresight.expectation import Found, expected
from prior_sg.services.segmenter.core.foresight.openings import Openings
from prior_sg.services.segmenter.core.map.received import ReceivedGraph
from tests.help.foreseen import around
from tests.help.world import prior

LABELS = ["hall", "bath", "kitchen"]
ROOM, HEIGHT = 40, 25  # cells of 0.1 m


def three_rooms():
    """Bath, hall and kitchen in a row from west to east, with doors of 1 m at the middle of the walls between."""
    grid = np.zeros((3 * ROOM + 4, ROOM + 2, HEIGHT), np.uint8)
    grid[:, :, :2] = 1
    for x in (0, ROOM + 1, 2 * ROOM + 2, 3 * ROOM + 3):
        grid[x] = 1
    grid[:, [0, -1]] = 1
    for x in (ROOM + 1, 2 * ROOM + 2):
        grid[x, ROOM // 2 - 5 : ROOM // 2 + 5, 2:22] = 0
    ways = ways_of(grid, np.zeros(3), CELL_M)
    regions = np.full(ways.heights.shape, -1)
    for number, label in ((1, 0), (0, 1), (2, 2)):
        low = number * (ROOM + 1) + 1
        regions[low : low + ROOM, 1:-1] = label
    regions[ways.heights < 0] = -1
    blocked, labels = grid != 0, ("hall", "bath", "kitchen")
    place = (ways.heights, ways.clearance, ways.origin_m, ways.voxel_m)
    return Plan(*place, blocked, regions.reshape(-1), labels, range_cells=30, step=2, eye=14)


PLAN = three_rooms()


def node(x, y):
    """The node on the floor of a cell."""
    level = int(np.flatnonzero(PLAN.heights[x, y] >= 0)[0])
    return (x * PLAN.heights.shape[1] + y) * LEVELS + level


HALL = node(ROOM + 1 + ROOM // 2, ROOM // 2)


def home_trial():
    matrix = np.full((3, 3), 0.5, np.float32)
    np.fill_diagonal(matrix, 1.0)
    labels = np.arange(3)
    nodes = np.flatnonzero((PLAN.clearance.reshape(-1) >= 4) & (PLAN.regions >= 0))
    return Trial("home", 1, PLAN, prior(LABELS, adjacency=matrix), labels, labels, crossings(PLAN), nodes)


def test_an_explorer_sees_its_room_and_what_doors_let_through():
    explorer = Explorer(PLAN, HALL)
    hall_m2, bath_m2, kitchen_m2 = explorer.seen_m2()
    assert hall_m2 > 15 and bath_m2 < 3 and kitchen_m2 < 3
    assert bath_m2 > 0 and bath_m2 == pytest.approx(kitchen_m2, abs=0.3)


def test_doors_are_frontiers_that_reveal_the_rooms_behind():
    explorer = Explorer(PLAN, HALL)
    cost, before = explorer.reach()
    frontiers = explorer.frontiers(cost)
    revealed = {PLAN.labels[explorer.revealed(nodes)] for nodes in frontiers.nodes}
    assert {"bath", "kitchen"} <= revealed
    assert cost[HALL] == 0 and cost[node(3, 3)] == FAR
    at = next(at for at, nodes in enumerate(frontiers.nodes) if PLAN.labels[explorer.revealed(nodes)] == "bath")
    straight_m = np.linalg.norm(PLAN.position_m(frontiers.targets)[at] - PLAN.position_m(np.array([HALL]))[0])
    assert straight_m <= frontiers.steps[at] * CELL_M / 5 < 1.2 * straight_m
    go(explorer, before, frontiers, at)
    assert explorer.walked_m == pytest.approx(frontiers.steps[at] * CELL_M / 5, rel=0.02) or explorer.seen_m2()[1] > 3


def test_following_frontiers_sees_everything_once():
    explorer = Explorer(PLAN, HALL)
    for _ in range(50):
        cost, before = explorer.reach()
        frontiers = explorer.frontiers(cost)
        if not len(frontiers.targets):
            break
        go(explorer, before, frontiers, int(frontiers.steps.argmin()))
    whole_m2 = np.bincount(PLAN.regions[PLAN.regions >= 0]) * CELL_M**2
    assert (explorer.seen_m2() > 0.95 * whole_m2).all()


def test_regions_that_touch_through_a_door_are_found_as_such():
    one = home_trial()
    explorer = Explorer(PLAN, HALL)
    explorer.known[:] = True
    found = one.found(explorer, explorer.seen_m2())
    assert found.regions.tolist() == [1, 1, 1]
    assert found.borders.tolist() == [[0, 1, 1], [1, 0, 0], [1, 0, 0]]


def test_what_an_explorer_has_seen_around_its_openings():
    """From the hall, whose rooms on both sides were seen through doors alone; then the bath is known, too."""
    one, explorer, cfg = home_trial(), Explorer(PLAN, HALL), ForesightConfig()
    explorer.known |= PLAN.regions == 0

    def at_the_kitchen():
        frontiers, seen_m2 = explorer.frontiers(explorer.reach()[0]), explorer.seen_m2()
        views = one.views(explorer, frontiers, one.origins(explorer, frontiers, seen_m2), seen_m2)
        found = views.around.of(frontiers.centers_m[:, 0] > PLAN.position_m(np.array([HALL]))[0, 0])
        assert len(found.touching) == 1
        return found

    before = at_the_kitchen()
    assert before.touching == [2.0] and before.nearby == [0.0]
    assert before.storey_m2[0] == pytest.approx(explorer.known.sum() * CELL_M**2, rel=0.1)
    assert fading(np.array(3.5), cfg.border_m) < before.at_border[0] < 1
    explorer.known |= PLAN.regions == 1
    after = at_the_kitchen()
    assert fading(np.array(8.0), cfg.nearby_m) < after.nearby[0] < fading(np.array(4.0), cfg.nearby_m)
    assert after.at_border == before.at_border


@pytest.mark.parametrize("policy", POLICIES)
def test_every_policy_finds_what_is_there(policy):
    walked_m = metres(Quest(home_trial(), 1, node(3 * ROOM, ROOM // 2)), POLICIES[policy], ForesightConfig())
    assert 4 < walked_m < 40


def test_who_is_told_nothing_goes_to_the_nearest():
    quest = Quest(home_trial(), 1, node(3 * ROOM, ROOM // 2))
    silent = msgspec.structs.replace(ForesightConfig(), told_labels=0, least_toward=1.1)
    told_m, silent_m, nearest_m = (
        metres(quest, POLICIES[name], cfg)
        for name, cfg in (("ours", ForesightConfig()), ("ours", silent), ("nearest", silent))
    )
    assert silent_m == nearest_m != told_m


def moment(outcomes, widths_m=None, label=0, met=None, left=None):
    count = len(outcomes)
    widths_m = np.full(count, 0.9) if widths_m is None else widths_m
    views = Views(np.tile(np.eye(3)[label], (count, 1)), widths_m, np.ones(count), around(count))
    return Moment(
        views,
        Found(np.array([1.0, 0, 0]), np.zeros((3, 3))),
        np.array(outcomes),
        np.zeros((count, 3), bool) if met is None else met,
        np.ones(3, bool) if left is None else left,
    )


@pytest.mark.parametrize("name", PREDICTORS)
def test_predictors_give_distributions(name):
    given = PREDICTORS[name](moment([SAME, 1, 2]), home_trial().prior, ForesightConfig())
    assert given.shape == (3, 4)
    np.testing.assert_allclose(given.sum(axis=1), 1.0)


def test_scores_of_a_uniform_predictor():
    said = judge("home", [moment([SAME, 1]), moment([]), moment([2, 2])], home_trial().prior, ForesightConfig())
    found = figures([said["uniform"]])
    assert found["nll_another"] == pytest.approx(np.log(3)) and found["events"] == 4
    assert found["nll"] == pytest.approx(-np.mean([np.log(1 / 2), *[np.log(1 / 6)] * 3]))
    assert found["top1"] == 0.25 and found["top1_another"] == 0.0 and found["top3_another"] == 1.0


def test_savings_are_paired():
    found = search_figures({"ours": [1.0, 4.0], "nearest": [2.0, 8.0]})
    assert found["saved_against_nearest"] == pytest.approx(0.5) and found["ours_m"] == 2.5


def test_fitting_finds_which_opening_leads_to_what_is_left():
    """Ways drawn from the model with known weights give these back; what lies deep counts less."""
    rng, cfg = np.random.default_rng(6), ForesightConfig()
    true = msgspec.structs.replace(cfg, toward_width=cfg.toward_width + 1.0, toward_touching=cfg.toward_touching - 1.0)
    the_prior, walk = home_trial().prior, []
    for _ in range(800):
        bare = moment([0] * 4, rng.choice([0.9, 5.0], 4))
        views = replace(bare.views, around=around(4, touching=rng.integers(0, 4, 4)))
        said = beyond(views, expected(the_prior, bare.found, true), true).toward
        through = np.array([rng.choice(4, p=column) for column in said.T])
        walk.append(replace(bare, views=views, ways=(through, np.ones(3))))
    found = fitted_toward([(walk, the_prior)], cfg)
    said, wanted = (beyond(views, expected(the_prior, bare.found, one), one).toward for one in (found, true))
    np.testing.assert_allclose(said, wanted, atol=0.06)
    deep = [replace(one, ways=(3 - one.ways[0], np.full(3, 80.0))) for one in walk]
    near = fitted_toward([([*walk, *deep], the_prior)], cfg)
    assert near.toward_width == pytest.approx(found.toward_width, abs=0.05)
    for name in cfg.__struct_fields__:
        assert name.startswith("toward_") or getattr(found, name) == getattr(cfg, name)


def test_one_comes_to_what_is_left_through_the_door_that_is_before_it():
    explorer = Explorer(PLAN, HALL)
    explorer.known |= PLAN.regions == 0
    frontiers = explorer.frontiers(explorer.reach()[0])
    east = frontiers.centers_m[:, 0] > PLAN.position_m(np.array([HALL]))[0, 0]
    through, deep_m = ways_left(explorer, frontiers.nodes, np.array([-1, 1, 2]), 3)
    assert through[0] == -1 and not east[through[1]] and east[through[2]]
    assert np.isinf(deep_m[0]) and (deep_m[1:] < 0.5).all()
    explorer.known |= PLAN.regions == 1  # of the same label, what is farther is come to when the nearer was seen
    through, _ = ways_left(explorer, [frontiers.nodes[int(east.argmax())]], np.array([-1, 1, 1]), 3)
    assert through.tolist() == [-1, 0, -1]


def test_fitting_finds_the_weights_that_made_the_events():
    """Outcomes drawn from the model with known weights give these back."""
    rng, drawn, cfg = np.random.default_rng(4), np.random.default_rng(5), ForesightConfig()
    matrix = np.array([[1, 0.9, 0.1], [0.9, 1, 0.3], [0.1, 0.3, 1]], np.float32)
    the_prior = prior(LABELS, adjacency=matrix)
    true = msgspec.structs.replace(
        cfg,
        adjacency=1.5,
        found_once=-2.0,
        again=-1.0,
        same_by_width=(0, 0, -2.0, 0, 0, 0, 3.0),
        within_bias=1.0,
        within_width=1.5,
        within_once=-2.0,
        missing_sum=2.0,
        missing_once=-1.0,
    )
    walk: list[Moment] = []
    for _ in range(600):
        counts = rng.integers(0, 2, 3).astype(float)
        at, widths_m = int(rng.integers(3)), rng.choice([0.9, 5.0], 4)
        bare = moment([0] * 4, widths_m, at)
        bare = replace(bare, found=Found(counts, np.zeros((3, 3))))
        given = PREDICTORS["ours"](bare, the_prior, true)
        outcomes = [int(rng.choice(4, p=row)) - 1 for row in given]
        said = beyond(bare.views, expected(the_prior, bare.found, true), true)
        met, left = drawn.random(said.within.shape) < said.within, drawn.random(3) < said.missing
        walk.append(replace(bare, outcomes=np.array(outcomes), met=met, left=left))
    found = fitted([(walk, the_prior)], cfg)
    chain, wanted = (
        expected(the_prior, Found(np.array([1.0, 0, 1]), np.zeros((3, 3))), one).next for one in (found, true)
    )
    np.testing.assert_allclose(chain, wanted, atol=0.06)
    same = [PREDICTORS["ours"](moment([0], np.array([width])), the_prior, found)[0, 0] for width in (0.9, 5.0)]
    wanted_same = [PREDICTORS["ours"](moment([0], np.array([width])), the_prior, true)[0, 0] for width in (0.9, 5.0)]
    assert same == pytest.approx(wanted_same, abs=0.1)  # drawn to one half by the ridge
    seen = moment([0, 0], np.array([0.9, 5.0]))
    said, wanted_said = (beyond(seen.views, expected(the_prior, seen.found, one), one) for one in (found, true))
    np.testing.assert_allclose(said.within, wanted_said.within, atol=0.06)
    np.testing.assert_allclose(said.missing, wanted_said.missing, atol=0.1)
    alone = fitted_within([(walk, the_prior)], cfg)
    for name in cfg.__struct_fields__:
        assert getattr(alone, name) == getattr(found if name.startswith("within_") else cfg, name)


def test_what_begins_behind_a_door_is_met_behind_that_door_alone():
    explorer = Explorer(PLAN, HALL)
    explorer.known |= PLAN.regions == 0  # the hall has been seen whole
    frontiers = explorer.frontiers(explorer.reach()[0])
    east = frontiers.centers_m[:, 0] > PLAN.position_m(np.array([HALL]))[0, 0]
    met = [set(explorer.met(nodes).tolist()) - {0} for nodes in frontiers.nodes]
    assert set().union(*(one for one, side in zip(met, east, strict=True) if side)) == {2}
    assert set().union(*(one for one, side in zip(met, east, strict=True) if not side)) == {1}


def opening_of(x_m, direction, width_m=1.0):
    """An opening of the product's at the middle of the plan's length, at the height of a place."""
    position_m = np.array([[x_m, ROOM / 2 * CELL_M, 1.2]])
    return Openings(
        place_ids=np.array([0]),
        positions_m=position_m,
        beyond_m=position_m + np.array([direction, 0, 0]) * (1.0 + ForesightConfig().beyond_m),
        widths_m=np.array([width_m]),
        regions=np.array([0]),
        beliefs=np.eye(3)[:1],
        rises=np.zeros(1),
        unseen=np.ones(1),
    )


def test_behind_the_products_openings_lies_what_its_places_do_not_cover():
    """One sphere in the middle of the hall; it looks east through a door, or at the seen hall's own rest."""
    ground = ground_of(PLAN, home_trial().prior)
    middle_m = PLAN.position_m(np.array([HALL]))[0]
    sphere = ReceivedGraph(np.array([0]), np.array([[*middle_m[:2], 1.2]]), np.array([1.0]))
    known = covered(ground, sphere)
    assert set(PLAN.regions[known]) == {0} and 0.6 < known.sum() * CELL_M**2 / (np.pi * 1.4**2) < 1.05
    new = np.array([False, True, True])
    east = opening_of(middle_m[0] + 0.4, 1.0)
    assert [one.tolist() for one in behind(east, ground, known, new, ForesightConfig())] == [
        [SAME],
        [[False, True, True]],  # around the sphere one comes to the west, too
        [True],
    ]
    known |= PLAN.regions == 0
    outcomes, met, _ = behind(opening_of(middle_m[0] + 1.0, 1.0), ground, known, new, ForesightConfig())
    assert outcomes.tolist() == [2] and met.tolist() == [[False, False, True]]
    blind = opening_of(middle_m[0] - 1.5, 1.0)  # it ends within the hall
    _, met, led = behind(blind, ground, known, new, ForesightConfig())
    assert not met.any() and not led.any()


def test_chances_are_judged_against_how_often_things_happen():
    walk = [moment([SAME], met=np.array([[False, True, False]]), left=np.array([False, True, False]))] * 4
    told = chance_figures([(walk, home_trial().prior)], ForesightConfig())
    assert told["within_brier_rate"] == told["missing_brier_rate"] == pytest.approx(2 / 9)
    said = beyond(walk[0].views, expected(home_trial().prior, walk[0].found, ForesightConfig()), ForesightConfig())
    assert told["within_brier"] == pytest.approx(((said.within[0] - [0, 1, 0]) ** 2).mean())
    assert told["within_nll"] == pytest.approx(-np.log(np.abs(said.within[0] - [1, 0, 1])).mean())
    assert "within_right" not in told and "within_nll_error" not in told


def test_chances_are_judged_by_which_of_two_openings_they_prefer():
    """The kitchen is behind the wide opening in one world, behind the narrow one in the other; the bath behind both."""
    walks = []
    for wide in (True, False):
        met = np.array([[False, True, wide], [False, True, not wide], [False, True, not wide]])
        walks.append(([moment([SAME] * 3, np.array([4.0, 0.7, 0.7]), met=met)], home_trial().prior))
    for walk, right in zip(([walks[0]], [walks[1]], walks), (1.0, 0.0, 0.5), strict=True):
        assert chance_figures(walk, ForesightConfig())["within_right"] == right


def test_fitting_learns_from_maps_which_openings_lead_anywhere():
    """Whether they do is drawn from the model with known weights, and what is missing is never there."""
    rng, cfg, the_prior = np.random.default_rng(6), ForesightConfig(), home_trial().prior
    true = msgspec.structs.replace(cfg, leads_bias=-1.0, leads_rise=-3.0, leads_unseen=2.0, leads_width=2.0)
    walk = []
    for _ in range(400):
        bare = moment([SAME] * 6, rng.uniform(0.4, 3.0, 6), left=np.zeros(3, bool))
        signs = leads_features(bare.views.widths_m, rng.uniform(0, 0.7, 6), rng.uniform(0, 1, 6))
        unsure = replace(bare.views, signs=signs)
        walk.append(replace(bare, views=unsure, led=rng.random(6) < leads(unsure, true)))
    found = fitted_to_maps([(walk, the_prior)], [], cfg)
    np.testing.assert_allclose(leads(walk[0].views, found), leads(walk[0].views, true), atol=0.1)
    said, before = (beyond(walk[0].views, expected(the_prior, walk[0].found, one), one).missing for one in (found, cfg))
    assert said.max() < 0.1 < before.max()
    assert found.within_bias == cfg.within_bias and found.same_by_width == cfg.same_by_width


def test_a_flood_says_how_far_it_came_and_from_where():
    """A corridor of nine cells, known at both ends, wide but in its last unseen cell but one."""
    heights, clearance = np.zeros((9, 1, 1), np.int32), np.full((9, 1, 1), 4, np.int32)
    known = np.isin(np.arange(9), (0, 1, 8))
    nodes = np.array([1, 8])
    found, depths, starts = flooded(heights, clearance, known, nodes, FAR, 1)
    assert (found.tolist(), depths.tolist(), starts.tolist()) == ([2, 7, 3, 6, 4, 5], [1, 1, 2, 2, 3, 3], [0, 1] * 3)
    assert flooded(heights, clearance, known, nodes, 2, 1)[0].tolist() == [2, 7, 3, 6]
    clearance[6] = 1
    assert flooded(heights, clearance, known, nodes, FAR, 1)[0].tolist() == [2, 7, 3, 4, 5]

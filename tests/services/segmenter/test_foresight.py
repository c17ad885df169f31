"""What lies beyond openings: distributions, what moves them, how frontiers merge, and when it is told."""

import msgspec
import numpy as np
import pytest

from prior_sg.schemas.foresight import Foresight
from prior_sg.schemas.priors import RegionPrior
from prior_sg.schemas.regions import Region, RegionDelta, Transition
from prior_sg.schemas.status import Tick
from prior_sg.services.segmenter.core import update
from prior_sg.services.segmenter.core.config import Config
from prior_sg.services.segmenter.core.foresight.around import around_of, fading
from prior_sg.services.segmenter.core.foresight.beyond import Views, beyond, leads, leads_features
from prior_sg.services.segmenter.core.foresight.config import ForesightConfig
from prior_sg.services.segmenter.core.foresight.expectation import Found, expected
from prior_sg.services.segmenter.core.foresight.fan import unseen_shares
from prior_sg.services.segmenter.core.foresight.openings import openings_of
from prior_sg.services.segmenter.core.foresight.telling import differs, foresight
from prior_sg.services.segmenter.core.map.frontiers import Frontiers
from prior_sg.services.segmenter.core.map.received import ReceivedGraph
from prior_sg.services.segmenter.core.map.table import Places
from prior_sg.services.segmenter.core.report import snapshot
from prior_sg.services.segmenter.core.state import empty
from tests.help.foreseen import around
from tests.help.world import ROBOT, place_delta, place_grid, prior, task, text, walk

CFG = ForesightConfig()
LABELS = ["hall", "bath", "kitchen", "bedroom"]


def home(**adjacency):
    """A prior of four regions; adjacency by pairs such as hall_bath."""
    matrix = np.full((4, 4), 0.1, np.float32)
    np.fill_diagonal(matrix, 1.0)
    for pair, value in adjacency.items():
        a, b = (LABELS.index(name) for name in pair.split("_"))
        matrix[a, b] = matrix[b, a] = value
    return prior(LABELS, adjacency=matrix)


def found(**counts):
    regions = np.zeros(4)
    for name, count in counts.items():
        regions[LABELS.index(name)] = count
    return Found(regions, np.zeros((4, 4)))


def views(label="hall", width_m=0.9, area_m2=8.0, **columns):
    beliefs = np.eye(4)[[LABELS.index(label)]]
    return Views(beliefs, np.array([width_m]), np.array([area_m2]), around(1, **columns))


def foreseen(the_prior, the_found, the_views=None, cfg=CFG):
    return beyond(the_views or views(), expected(the_prior, the_found, cfg), cfg)


def random_case(seed):
    rng = np.random.default_rng(seed)
    adjacency = rng.uniform(0.01, 1, (4, 4))
    existence = rng.dirichlet(np.ones(4))
    regions = [
        RegionPrior(name=name, phrases=["x"], existence=float(share))
        for name, share in zip(LABELS, existence, strict=True)
    ]
    the_prior = prior(LABELS, adjacency=((adjacency + adjacency.T) / 2).astype(np.float32), regions=regions)
    borders = rng.integers(0, 3, (4, 4)).astype(float)
    the_found = Found(rng.integers(0, 4, 4).astype(float), borders + borders.T)
    many = Views(rng.dirichlet(np.ones(4), 7), rng.uniform(0.3, 6, 7), rng.uniform(0, 60, 7), around(7))
    return the_prior, the_found, many


@pytest.mark.parametrize("seed", range(12))
def test_what_is_expected_is_a_distribution_and_chances_are_chances(seed):
    the_prior, the_found, many = random_case(seed)
    result = foreseen(the_prior, the_found, many)
    np.testing.assert_allclose(result.same + result.next.sum(axis=1), 1.0)
    assert (result.next >= 0).all()
    assert ((result.within > 0) & (result.within < 1)).all() and ((result.missing > 0) & (result.missing < 1)).all()
    np.testing.assert_allclose(expected(the_prior, the_found, CFG).next.sum(axis=1), 1.0)


def test_a_corridor_leads_to_more_than_a_room_at_its_end():
    """A hall touches everything, a bath the hall alone."""
    the_prior = home(hall_bath=0.9, hall_kitchen=0.9, hall_bedroom=0.9)
    corridor, end = (foreseen(the_prior, found(), views(label)).within[0] for label in ("hall", "bath"))
    assert corridor[3] > 2 * end[3]


@pytest.mark.parametrize("seed", range(6))
def test_what_is_left_is_come_to_through_one_opening(seed):
    the_prior, the_found, many = random_case(seed)
    result = foreseen(the_prior, the_found, many)
    np.testing.assert_allclose(result.toward.sum(axis=0), 1.0)
    assert (result.toward > 0).all()


def test_what_leads_deep_counts_more_for_a_search_than_for_what_begins_behind():
    """Of two openings behind which a bath begins alike, one is of a region that touches many."""
    two = Views(np.eye(4)[[0, 0]], np.full(2, 0.9), np.full(2, 8.0), around(2, touching=np.array([1.0, 9.0])))
    cfg = msgspec.structs.replace(CFG, within_touching=0.0)
    result = foreseen(home(), found(), two, cfg)
    assert result.within[0, 1] == result.within[1, 1] and result.toward[1, 1] > 2 * result.toward[0, 1]


def test_nobody_comes_to_anything_through_a_shadow():
    the_prior, the_found = home(), found()
    signs = looking([1.2, 1.2], [0, 0.6], [0.9, 0.1])
    result = foreseen(the_prior, the_found, signs)
    chance = leads(signs, CFG)
    np.testing.assert_allclose(result.toward[0] / result.toward[1], chance[0] / chance[1])


def test_many_openings_do_not_make_sure_what_one_does_not():
    """Openings of one map lead to the same rooms: fourteen make a third bath likelier, not certain."""
    many = Views(np.tile(np.eye(4)[0], (14, 1)), np.full(14, 0.9), np.full(14, 8.0), around(14))
    one, all_of_them = (foreseen(home(), found(bath=2), some).missing[1] for some in (views(), many))
    assert one < all_of_them < 0.5
    assert foreseen(home(), found(), Views(np.zeros((0, 4)), np.zeros(0), np.zeros(0), around(0))).missing.max() == 0


def test_what_is_not_expected_at_all_is_not_missing():
    the_prior, _, many = random_case(3)
    result = foreseen(the_prior, found(), many)
    assert result.missing.argmin() == np.argmin([one.existence for one in the_prior.regions])


def test_what_usually_touches_is_likelier():
    near, far = (foreseen(home(hall_bath=value), found()).next[0, 1] for value in (0.9, 0.1))
    assert near > 2 * far


def test_what_is_there_once_is_less_likely_again():
    assert foreseen(home(), found(bath=1)).next[0, 1] < foreseen(home(), found()).next[0, 1]


def test_narrow_openings_lead_elsewhere_and_wide_ones_show_more_of_the_same():
    door, hall = (foreseen(home(), found(), views(width_m=width)).same[0] for width in (0.9, 6.0))
    assert door < hall


def looking(widths_m, rises, unseen):
    """Openings out of a hall of 8 m2, of which it is not known whether they lead anywhere."""
    count = len(widths_m)
    areas_m2 = np.full(count, 8.0)
    signs = leads_features(np.array(widths_m), np.array(rises), np.array(unseen))
    return Views(np.tile(np.eye(4)[0], (count, 1)), np.array(widths_m), areas_m2, around(count), signs)


def test_shadows_ceilings_and_cracks_seldom_lead_anywhere():
    door, crack, ceiling, shadow = leads(looking([1.2, 0.4, 1.2, 1.2], [0, 0, 0.6, 0], [0.9, 0.9, 0.9, 0.1]), CFG)
    assert max(crack, ceiling, shadow) < 0.7 * door
    assert leads(views(), CFG) == [1.0]


@pytest.mark.parametrize("seed", range(6))
def test_what_may_lead_nowhere_says_less_of_all_that_may_be_behind(seed):
    the_prior, the_found, many = random_case(seed)
    rng = np.random.default_rng(seed)
    signs = leads_features(many.widths_m, rng.uniform(0, 0.7, 7), rng.uniform(0, 1, 7))
    unsure = Views(many.beliefs, many.widths_m, many.areas_m2, many.around, signs)
    sure, result = foreseen(the_prior, the_found, many), foreseen(the_prior, the_found, unsure)
    chance = leads(unsure, CFG)
    np.testing.assert_allclose(result.same + result.next.sum(axis=1), 1.0)
    np.testing.assert_allclose(result.next, chance[:, None] * sure.next)
    assert (result.within <= chance[:, None]).all()


def test_a_fan_is_unseen_where_no_sphere_covers_it():
    """Two large places 2 m apart: one looks at the other, one away, one along the gap between."""
    graph = ReceivedGraph(np.arange(2), np.array([[0, 0, 1.0], [2.0, 0, 1.0]]), np.full(2, 1.2))
    outward = np.array([[1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0]])
    towards, away, beside = unseen_shares(graph, graph.positions_m[[0, 0, 0]] + 1.2 * outward, outward, CFG)
    assert towards < 0.3 and away > 0.8 and towards < beside
    assert unseen_shares(graph, np.zeros((0, 3)), np.zeros((0, 3)), CFG).shape == (0,)


def a_map():
    """A row of five places 1 m apart: a hall of four and a bath; frontiers north of 0 and 1, south of 1, up from 2."""
    graph = ReceivedGraph(
        ids=np.arange(5) * 10,
        positions_m=np.column_stack((np.arange(5.0), np.zeros(5), np.ones(5))),
        radii_m=np.full(5, 0.5),
        edges=np.array([(0, 1), (1, 2), (2, 3), (3, 4)]),
        clearances_m=np.full(4, 0.5),
    )
    places = Places.none()
    places.regions = np.array([7, 7, 7, 7, 8])
    places.posteriors = np.array([[0.8, 0.1, 0.1, 0.0]] * 4 + [[0.1, 0.9, 0.0, 0.0]])
    return graph, places


def opened(*rows):
    frontiers = Frontiers()
    frontiers.held = {place: np.array([*direction, area]) for place, direction, area in rows}
    return frontiers


def test_neighbouring_frontiers_that_look_the_same_way_are_one_opening():
    graph, places = a_map()
    north, south, up = (0, 1, 0), (0, -1, 0), (0, 0, 1)
    result = openings_of(graph, places, opened((0, north, 1.0), (10, north, 2.0), (20, up, 3.0)), CFG)
    assert result.place_ids.tolist() == [10]
    assert result.widths_m == pytest.approx([1.5])
    assert result.beyond_m[0] == pytest.approx([1.0, 0.5 + CFG.beyond_m, 1.0])
    assert result.beliefs[0] == pytest.approx([0.8, 0.1, 0.1, 0.0])
    assert result.rises == pytest.approx([0.0]) and result.unseen[0] > 0.8
    slanted = openings_of(graph, places, opened((10, (0, 0.8, 0.6), 2.0), (20, (0.8, -0.6, 0), 2.0)), CFG)
    assert slanted.rises == pytest.approx([0.6, 0.0]) and slanted.unseen[1] < 0.8  # along the row of places
    assert openings_of(graph, places, opened((0, north, 1.0), (10, south, 2.0)), CFG).place_ids.tolist() == [10, 0]
    assert openings_of(graph, places, opened((30, north, 1.0), (40, north, 1.0)), CFG).regions.tolist() == [7, 8]


@pytest.mark.parametrize("rows", [[], [(99, (0, 1, 0), 1.0)], [(0, (0, 1, 0), 0.1)]])
def test_no_openings_foresee_nothing(rows):
    graph, places = a_map()
    result = foresight(openings_of(graph, places, opened(*rows), CFG), {}, home(), CFG)
    assert result.openings == [] and result.missing == []


def test_frontiers_follow_deltas():
    frontiers, none = Frontiers(), np.zeros(0, np.int64)
    positions, edges = place_grid(1)
    told = place_delta(positions, edges, **columns((1, 0.5), (2, 0.7)))
    frontiers.follow(told, none, replaces=True)
    frontiers.follow(place_delta(positions, edges, **columns((2, 0.0), (3, 0.2))), np.array([1]), replaces=False)
    assert frontiers.columns()[0].tolist() == [3]


def columns(*rows):
    return {
        "frontier_ids": np.array([place for place, _ in rows], np.int64),
        "frontier_directions": np.tile(np.array([1, 0, 0], np.float32), (len(rows), 1)),
        "frontier_areas_m2": np.array([area for _, area in rows], np.float32),
    }


def test_only_what_changes_visibly_is_news():
    graph, places = a_map()
    state_of = {7: region(7, "hall"), 8: region(8, "bath")}
    openings = openings_of(graph, places, opened((0, (0, 1, 0), 2.0)), CFG)
    now = foresight(openings, state_of, home(), CFG)
    assert differs(None, now, CFG) and not differs(now, now, CFG) and differs(now, Foresight(), CFG)
    assert not differs(None, Foresight(), CFG)
    moved = [msgspec.structs.replace(now.openings[0], same=now.openings[0].same - shift) for shift in (0.01, 0.2)]
    assert [differs(now, msgspec.structs.replace(now, openings=[one]), CFG) for one in moved] == [False, True]


@pytest.mark.parametrize("field", ["within", "toward"])
def test_what_planners_choose_an_opening_by_is_news_when_it_changes(field):
    graph, places = a_map()
    state_of = {7: region(7, "hall"), 8: region(8, "bath")}
    now = foresight(openings_of(graph, places, opened((0, (0, 1, 0), 2.0)), CFG), state_of, home(), CFG)
    (opening,) = now.openings
    for shift, news in ((0.01, False), (0.2, True)):
        chance = getattr(opening.labels[0], field)
        first = msgspec.structs.replace(opening.labels[0], **{field: chance + (shift if chance < 0.5 else -shift)})
        moved = msgspec.structs.replace(opening, labels=[first, *opening.labels[1:]])
        assert differs(now, msgspec.structs.replace(now, openings=[moved]), CFG) is news


def test_an_opening_tells_all_labels_that_it_leads_to():
    """Searches would pass it by; what it hardly leads to is told where it is among the likeliest."""
    graph, places = a_map()
    openings = openings_of(graph, places, opened((10, (0, 1, 0), 2.0), (40, (0, -1, 0), 2.0)), CFG)
    state_of = {7: region(7, "hall"), 8: region(8, "bath")}

    def told(**fields):
        cfg = msgspec.structs.replace(CFG, told_labels=1, **fields)
        openings_told = foresight(openings, state_of, home(), cfg).openings
        assert all(one.labels == sorted(one.labels, key=lambda entry: -entry.within) for one in openings_told)
        return [len(one.labels) for one in openings_told]

    assert told(least_toward=0.01) == [4, 4]
    assert told(least_toward=0.5) != [4, 4] and sum(told(least_toward=0.5)) >= 4
    assert told(least_toward=1.1) == [1, 1]
    assert told(least_toward=1.1, least_within=1.0) == [0, 0]


def region(number, label, neighbours=(), **fields):
    usual = {"place_count": 9, "probability": 0.9, "position_m": (0, 0, 0), "area_m2": 9.0}
    return Region(id=number, label=label, neighbour_ids=list(neighbours), **(usual | fields))


def square(x_m, y_m, side_m=3.0):
    return [(x_m, y_m), (x_m + side_m, y_m), (x_m + side_m, y_m + side_m), (x_m, y_m + side_m)]


def test_what_the_map_holds_around_an_opening():
    """One looks north out of region 7, over (1, 0.5, 1) to (1, 1.5, 1): regions that were found count as they are near,
    its own and pieces do not, and one above it is far and on another storey."""
    graph, places = a_map()
    openings = openings_of(graph, places, opened((10, (0, 1, 0), 2.0)), CFG)
    np.testing.assert_allclose(openings.beyond_m, [[1.0, 0.5 + CFG.beyond_m, 1.0]])
    way = Transition(region=8, edge=(0, 1), position_m=(1.0, 3.5, 1.0), clearance_m=0.4, door=True)
    held = {
        7: region(7, "hall", [8, 9], hull_m=square(0, 0), position_m=(1, 0, 1), transitions=[way]),
        8: region(8, "bath", [7], hull_m=[(3, 0), *square(3, 0)], position_m=(4, 1, 1), area_m2=4.0),
        9: region(9, "bath", [7], hull_m=square(1, 1), position_m=(1, 1, 1), place_count=1),
        10: region(10, "kitchen", hull_m=square(0, 0), position_m=(1, 1, 4)),
    }
    result = around_of(openings, held, CFG)
    assert result.touching == [2.0] and result.storey_m2 == [13.0]
    assert result.nearby == pytest.approx([fading(np.array((2.0, 3 * CFG.steepness)), CFG.nearby_m).sum()])
    assert result.at_border == pytest.approx(fading(np.array([3.0]), CFG.border_m))
    alone = around_of(openings, {7: region(7, "hall")}, CFG)
    assert (alone.nearby, alone.at_border, alone.storey_m2) == ([0.0], [0.0], [0.0])


@pytest.mark.parametrize(("what", "more"), [("touching", True), ("nearby", False), ("storey_m2", False)])
def test_more_begins_behind_regions_that_touch_many_and_less_amid_what_was_found(what, more):
    few, many = (foreseen(home(), found(), views(**{what: value})).within for value in (1.0, 9.0))
    assert ((many > 1.2 * few) if more else (few > 1.2 * many)).all()


def test_beside_a_border_what_the_region_touches_says_less():
    near, far = (
        [foreseen(home(hall_bath=value), found(), views(at_border=border)).within[0, 1] for value in (0.9, 0.1)]
        for border in (1.0, 0.0)
    )
    assert near[0] / near[1] < 0.8 * far[0] / far[1]


def test_regions_and_borders_are_counted_by_label():
    regions = [region(1, "hall", [2, 3]), region(2, "bath", [1]), region(3, "hall", [1])]
    counted = Found.of(regions, LABELS, least_places=3)
    assert counted.regions.tolist() == [2, 1, 0, 0]
    assert counted.borders.tolist() == [[1, 1, 0, 0], [1, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]]
    assert Found.of(regions, LABELS, least_places=10).regions.sum() == 0


def run(*messages, cfg=Config()):
    """Deltas of a segmenter; texts are those of rooms' basis vectors."""
    state, deltas = empty(cfg, ROBOT, 1), []
    waiting = list(messages)
    while waiting:
        for output in update.update(state, waiting.pop(0), cfg):
            if type(output).__name__ == "TextRequest":
                waiting.insert(0, text(np.eye(3)[: len(output.concepts)]))
            elif isinstance(output, RegionDelta):
                deltas.append(output)
    return state, deltas


def test_a_segmenter_tells_what_it_foresees_once():
    positions, edges = place_grid(2)
    rooms = prior(["kitchen", "hall"])
    delta = place_delta(positions, edges, **columns((30, 2.0)))
    state, deltas = run(delta, task(), rooms, *walk(2), Tick(stamp_ns=1), Tick(stamp_ns=2))
    told = [one.foresight for one in deltas if one.foresight is not None]
    assert [opening.place_id for opening in told[-1].openings] == [30]
    assert snapshot(state).foresight == told[-1]
    closed = place_delta(positions[:0], edges[:0], revision=1, **columns((30, 0.0)))
    after = [output for message in (closed, Tick(stamp_ns=3)) for output in update.update(state, message, Config())]
    assert [one.foresight for one in after if isinstance(one, RegionDelta)][-1] == Foresight(
        look_m=CFG.look_m, elsewhere_m=CFG.elsewhere_m
    )


def test_foresight_can_be_switched_off():
    positions, edges = place_grid(2)
    cfg = Config(foresight=ForesightConfig(enabled=False))
    delta = place_delta(positions, edges, **columns((30, 2.0)))
    _, deltas = run(delta, task(), prior(["kitchen", "hall"]), *walk(2), Tick(stamp_ns=1), cfg=cfg)
    assert deltas and all(one.foresight is None for one in deltas)

"""Sizes: boxes measured from cells, floors from places, likelihoods worked by hand, and what they decide in a home."""

import math

import msgspec
import numpy as np
import pytest

from prior_sg.schemas.priors import ObjectPrior, Task
from prior_sg.services.prior_gateway.core.config import Config
from prior_sg.services.prior_gateway.outside import library
from prior_sg.services.segmenter.core.map.received import ReceivedGraph, apply
from prior_sg.services.segmenter.core.objects import names, sizes
from prior_sg.services.segmenter.core.objects.cells import packed
from prior_sg.services.segmenter.core.objects.sizes import Boxes, SizeConfig
from prior_sg.services.segmenter.core.objects.track import Track, TrackingConfig
from tests.help.world import place_delta

CELL_M = 0.15
CFG = SizeConfig(weight=1.0)
HOME = library.load().answer(
    Task(robot="r", stamp_ns=1, environment="residential home", task="real-estate listing"), Config()
)


def block(*counts):
    return np.stack(np.meshgrid(*[np.arange(count) for count in counts], indexing="ij"), axis=-1).reshape(-1, 3)


def graph_of(places, edges=(), **changes):
    positions_m = np.array([place[:3] for place in places], np.float32)
    radii_m = np.array([place[3] for place in places], np.float32)
    delta = place_delta(positions_m, np.array(edges, np.int64).reshape(-1, 2), radii_m=radii_m, **changes)
    return apply(ReceivedGraph(), delta, replaces=True).graph


def boxes(*rows):
    """Each row: longest, shortest, height, lower edge above the floor."""
    table = np.array(rows, float)
    return Boxes(table[:, :3], table[:, 3], CELL_M)


def fit(name, row, cfg=CFG):
    item = next(item for item in HOME.objects if item.name == name)
    return float(sizes.log_ratios(boxes(row), [item], cfg)[0, 0])


def test_sides_of_a_block_whichever_way_it_lies():
    assert sizes.sides(block(7, 3, 2)).tolist() == [7, 3, 2]
    assert sizes.sides(block(3, 7, 2) + np.array((-50, 4, 9))).tolist() == [7, 3, 2]


@pytest.mark.parametrize("degrees", [20, 30, 45, 75])
def test_a_turned_thing_keeps_its_sides_within_a_cell(degrees):
    """15.8 by 6.8 cells, and one more for the cells at the edges; along the axes, 45 degrees give 17 by 17."""
    u, v = np.meshgrid(np.arange(0, 16, 0.2), np.arange(0, 7, 0.2))
    cos, sin = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    flat = np.stack((u * cos - v * sin, u * sin + v * cos, np.zeros_like(u)), axis=-1).reshape(-1, 3)
    longest, shortest, height = sizes.sides(np.unique(np.floor(flat).astype(int), axis=0))
    assert longest == pytest.approx(16.8, abs=1.25) and shortest == pytest.approx(7.8, abs=1.25) and height == 1


def test_the_floor_is_where_the_lowest_sphere_nearby_rests():
    """A free sphere may end above the floor; it never ends below it."""
    ground = [(0, 0, 1.0, 0.6), (1, 0, 1.0, 1.0), (2, 0, 1.2, 0.3)]
    upper = [(0, 0, 4.0, 0.9), (1, 0, 4.0, 0.4)]
    graph = graph_of(ground + upper, [(0, 1), (1, 2), (3, 4)])
    points_m = np.array([(2, 0, 0.5), (0, 0, 0.2), (1, 0, 3.6)])
    assert sizes.floor_below(points_m, graph, 1) == pytest.approx([0.0, 0.0, 3.1])
    assert sizes.floor_below(points_m, graph, 0) == pytest.approx([0.9, 0.4, 3.6])
    assert np.isnan(sizes.floor_below(points_m, ReceivedGraph(), 3)).all()


def test_places_on_the_ground_tell_the_floor_themselves():
    """Their radii lie along it."""
    flat = {
        "surface_ids": np.array([0]),
        "ellipses": np.ones((1, 3), np.float32),
        "hull_counts": np.array([3]),
        "hulls_m": np.eye(3, 2, dtype=np.float32),
    }
    graph = graph_of([(0, 0, 0.05, 1.5)], **flat)
    assert sizes.floor_below(np.zeros((1, 3)), graph, 3) == pytest.approx([0.05])
    later = place_delta(np.zeros((0, 3)), np.zeros((0, 2)), revision=1)
    assert (
        apply(graph, later, replaces=False).graph.on_ground and not apply(graph, later, replaces=True).graph.on_ground
    )


def test_measures_of_a_track_in_a_room():
    cells = packed(block(14, 6, 5) + np.array((0, 0, 2)))
    track = Track(0, cells, np.ones_like(cells), [], set(), {})
    tracking = TrackingConfig(cell_m=CELL_M)
    found = sizes.measured([track], tracking, graph_of([(1, 3, 1.0, 0.85)]), CFG)
    assert found.sides_m[0] == pytest.approx((2.1, 0.9, 0.75))
    assert found.bottoms_m == pytest.approx([0.3 - 0.15])
    assert sizes.measured([track], tracking, graph_of([(1, 3, 1.0, 0.2)]), CFG).bottoms_m.tolist() == [0.0]


def test_likelihood_by_hand():
    """A box as expected, one cell larger than the thing and half a cell higher; then one with a thing on it."""
    item = ObjectPrior(name="x", phrases=["x"], size_m=(1.85, 0.85, 0.6), size_spread=0.3, bottom_m=0.5)
    plain = SizeConfig(
        weight=1.0, misfit=0.0, skew=2.0, side_m=(0.1, 10.0), reach_m=2.0, bottom_spread_m=0.2, hung_spread=0.4
    )
    rows = boxes((2.0, 1.0, 0.675, 0.5), (2.0, 1.0, 1.175, 0.5), (2.0, 1.0, 0.75, float("nan")))
    found = sizes.log_ratios(rows, [item], plain)[:, 0]

    def peak(sigma, width):
        return math.log(math.sqrt(2 / math.pi) / (3 * sigma) * width)

    sides = [peak(math.hypot(0.3, 0.075 / seen), math.log(100)) for seen in (2.0, 1.0)]
    upper = math.sqrt(0.2**2 + (0.15 * 0.6) ** 2 + 0.075**2)
    assert found[0] == pytest.approx(sum(sides) + peak(0.4, 2.0) + peak(upper, 2.0))
    assert found[1] == pytest.approx(found[0] - 0.5 * (0.5 / (2 * upper)) ** 2)
    assert found[2] == pytest.approx(sum(sides) + peak(math.hypot(0.15, 0.075 / 0.75), math.log(100)))


def test_a_side_seen_in_part_costs_less_than_one_too_long():
    whole = fit("sofa", (2.1, 1.05, 1.0, 0.0))
    assert whole > fit("sofa", (1.05, 1.05, 1.0, 0.0)) > fit("sofa", (4.2, 1.05, 1.0, 0.0))


def test_no_misfit_vetoes_and_what_is_not_known_says_nothing():
    absurd = fit("sofa", (100.0, 0.001, 50.0, 20.0))
    assert absurd == pytest.approx(4 * math.log(CFG.misfit), abs=1e-3)
    row = (2.1, 1.05, 1.0, 2.0)
    bare = [ObjectPrior(name="x", phrases=["x"]), ObjectPrior(name="y", phrases=["y"], size_m=(2.0, 1.0, 0.9))]
    ratios = sizes.log_ratios(boxes(row, (*row[:3], 0.0)), bare, CFG)
    assert (ratios[:, 0] == 0.0).all() and ratios[0, 1] == ratios[1, 1] > 0.0, "nobody said where its lower edge is"
    assert (sizes.log_ratios(boxes(row), HOME.objects, SizeConfig(weight=0.0)) == 0.0).all()


@pytest.mark.parametrize(
    ("row", "is_it", "not_that"),
    [
        ((1.95, 1.05, 0.9, 0.1), "sofa", "nightstand"),
        ((0.6, 0.6, 0.6, 0.1), "nightstand", "sofa"),
        ((0.6, 0.15, 0.75, 1.4), "picture frame", "television"),
        ((1.2, 0.3, 0.75, 0.7), "television", "picture frame"),
        ((0.75, 0.75, 1.8, 0.1), "refrigerator", "washing machine"),
        ((0.45, 0.45, 1.65, 0.0), "floor lamp", "table lamp"),
        ((1.2, 0.75, 0.6, 0.0), "coffee table", "dining table"),
    ],
)
def test_boxes_tell_things_of_a_home_apart(row, is_it, not_that):
    assert fit(is_it, row) > fit(not_that, row) + 1.0


def test_odd_boxes_are_nothing_that_the_prior_has():
    """Without a word from the encoder: walls with what stands before them, and a usual sofa."""
    odd = boxes((9.0, 5.0, 2.7, 0.0), (5.0, 3.0, 1.2, 1.2), (2.1, 1.05, 1.0, 0.0))
    fits = sizes.log_ratios(odd, HOME.objects, SizeConfig())
    known = (names.commonness(HOME) * np.exp(fits)).sum(axis=1)
    known /= 1 + known
    assert known[0] < 0.3 and known[1] < 0.3 and known[2] > 0.5


@pytest.mark.parametrize("change", [{"misfit": 1.0}, {"skew": 0.5}, {"side_m": (2.0, 1.0)}, {"reach_m": 0.0}])
def test_settings_out_of_range_are_refused(change):
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert(change, SizeConfig)

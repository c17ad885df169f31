"""Where printed markers are, and ways to them."""

import msgspec
import pytest

from prior_sg.schemas import queries as q
from prior_sg.services.scene_store.core.queries.answering import answer
from prior_sg.services.scene_store.core.queries.index import Index
from tests.help.homes import home, marked_home, printed

INDEX = Index(marked_home())


def test_a_marker_is_in_the_region_in_front_of_its_paper():
    (found,) = answer(INDEX, q.MarkersOf(id=7)).markers
    assert found.marker == INDEX.scene.markers[0]
    assert found.region is not None and (found.region.id, found.region.label) == (3, "kitchen")
    turned = [printed(7, (4.45, 1.0, 1.5), (1.0, 0.0, 0.0))]
    (other,) = answer(Index(_with(turned)), q.MarkersOf(id=7)).markers
    assert other.region is not None and other.region.label == "bedroom"


def _with(markers):
    return msgspec.structs.replace(marked_home(), markers=markers)


def test_all_are_listed_by_dictionary_and_number_with_their_doubts():
    found = answer(INDEX, q.MarkersOf())
    assert [one.marker.id for one in found.markers] == [7, 9] and found.total == 2
    assert [bool(one.marker.doubt) for one in found.markers] == [False, True]
    assert len(answer(INDEX, q.MarkersOf(limit=1)).markers) == 1


def test_one_number_of_two_dictionaries_is_two_markers():
    other = printed(7, (1.0, 0.0, 1.5), (0.0, 1.0, 0.0), dictionary="4x4_50")
    index = Index(_with([other, *INDEX.scene.markers]))
    assert len(answer(index, q.MarkersOf(id=7)).markers) == 2
    (found,) = answer(index, q.MarkersOf(id=7, dictionary="4X4_50")).markers
    assert found.marker == other


@pytest.mark.parametrize(
    ("question", "reason"),
    [
        (q.MarkersOf(id=8), "there is no marker 8; the scene has marker 7 (apriltag_36h11), marker 9 (apriltag_36h11)"),
        (q.MarkersOf(dictionary="4x4_50"), "there is no marker of the dictionary '4x4_50'; the scene has marker 7"),
    ],
)
def test_those_that_are_not_there_are_told(question, reason):
    assert answer(INDEX, question).reason.startswith(reason)


def test_without_any_it_says_what_makes_them_be_looked_for():
    assert "feature_pyramid.markers.dictionary" in answer(Index(home()), q.MarkersOf(id=7)).reason


def way(goal, index=INDEX):
    return answer(index, q.RouteBetween(start=q.Spot(what="place", id=10), goal=goal))


def test_a_way_to_a_marker_ends_in_front_of_it():
    found = way(q.Spot(what="marker", id=7))
    assert found.found and found.place_ids == [10, 12, 14] and found.goal is None
    assert found.goal_gap_m == pytest.approx((1.45**2 + 0.5**2) ** 0.5)
    assert way(q.Spot(point_m=(4.45, 1.0, 1.5))).place_ids[-1] == 16, "a point has no front"


@pytest.mark.parametrize(
    ("goal", "reason"),
    [
        (
            q.Spot(what="marker", id=9),
            "nobody knows where marker 9 (apriltag_36h11) is, for it has been seen at 2 spots",
        ),
        (q.Spot(what="marker", id=1), "the goal: there is no marker 1"),
        (q.Spot(what="marker"), "the goal is a marker without a number"),
    ],
)
def test_no_way_leads_to_a_marker_in_doubt_or_to_none(goal, reason):
    found = way(goal)
    assert not found.found and reason in found.reason

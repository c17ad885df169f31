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


def test_of_many_markers_a_few_are_named():
    many = [printed(number, (4.45, 1.0, 1.5), (-1.0, 0.0, 0.0)) for number in range(587)]
    told = answer(Index(_with(many)), q.MarkersOf(id=999)).reason
    assert told.endswith("marker 29 (apriltag_36h11) and 557 others") and len(told) < 1000
    assert way(q.Spot(what="marker", id=999), Index(_with(many))).reason == f"the goal: {told}"


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


def test_of_one_number_in_two_dictionaries_the_one_that_is_named_is_gone_to():
    other = printed(7, (8.0, 1.0, 1.5), (-1.0, 0.0, 0.0), dictionary="4x4_50")
    index = Index(_with([other, *INDEX.scene.markers]))
    ends = {name: way(q.Spot(what="marker", id=7, dictionary=name), index).place_ids[-1] for name in ("", "4X4_50")}
    assert ends == {"": 14, "4X4_50": 18}
    missing = way(q.Spot(what="marker", id=7, dictionary="5x5"), index).reason
    assert "there is no marker 7 of the dictionary '5x5'" in missing

import numpy as np
import pytest

from prior_sg.deploy.viewing import ways, words
from prior_sg.deploy.viewing.ways import Trip
from prior_sg.schemas.queries import Spot
from prior_sg.services.scene_store.core.queries.index import Index
from tests.help.homes import joined_home, marked_home, region

BED, FAR_CORNER = Spot(what="object", id=2), Spot(what="place", id=10)
LINE, INK = (255, 0, 0), (0, 0, 0)


def joined(**changes) -> Index:
    return Index(joined_home(**changes))


def test_a_way_begins_at_the_robot_unless_a_start_was_chosen() -> None:
    index = joined(trajectory=np.array([(6, 1, 1.2), (2.1, 1, 1.2)], np.float32))
    assert ways.way(index, Trip(BED)).route.place_ids == [12, 14, 16, 18]
    assert ways.way(index, Trip(BED, FAR_CORNER)).route.place_ids == [10, 12, 14, 16, 18]
    lost = ways.way(joined(trajectory=np.zeros((0, 3), np.float32)), Trip(BED))
    assert not lost.route.found and "camera was last" in words.way_story(lost)


def test_the_line_goes_over_the_places_and_dashes_over_what_nobody_has_checked() -> None:
    drawn = ways.picture(ways.way(joined(), Trip(BED, FAR_CORNER)), LINE, INK)
    assert drawn["/way/line"].points_m[:, :, 0].tolist() == [[1, 2], [2, 3], [3, 5.5], [5.5, 6.5]]
    gaps_m = drawn["/way/gaps"].points_m  # only to the bed: the chosen start is a place
    assert np.allclose(gaps_m[..., 0], 6.5) and gaps_m[0, 0, 1] < gaps_m[-1, 1, 1] < 2.0
    arrows = drawn["/way/arrows"].points_m
    assert len(arrows) == 5 and np.allclose(arrows[:, 0, 1], 1.0) and (np.diff(arrows, axis=1)[..., 0] > 0).all()
    named = {shape.text: shape.position_m[0] for name, shape in drawn.items() if name.startswith("/way/names")}
    assert named == {"goal, 5.5 m": 6.5, "1 bedroom": 5.5, "start": 1.0}


def test_a_way_within_one_place_has_ends_and_no_line() -> None:
    drawn = ways.picture(ways.way(joined(), Trip(FAR_CORNER, FAR_CORNER)), LINE, INK)
    assert "/way/ends" in drawn and "/way/line" not in drawn


def test_a_way_to_a_marker_is_called_so_and_ends_at_it() -> None:
    index = Index(marked_home())
    way = ways.way(index, Trip(Spot(what="marker", id=7), FAR_CORNER))
    assert "Way to marker 7" in words.way_story(way) and way.goal_m == (4.45, 1.0, 1.5)
    back = ways.way(index, Trip(FAR_CORNER, Spot(what="marker", id=7)))
    assert "from marker 7" in words.way_story(back)
    doubted = words.way_story(ways.way(index, Trip(Spot(what="marker", id=9), FAR_CORNER)))
    assert "No way to marker 9" in doubted and "2 spots" in doubted


def test_the_panel_tells_length_room_and_what_is_passed() -> None:
    told = words.way_story(ways.way(joined(), Trip(BED, FAR_CORNER)))
    for part in ("Way to bed", "5.5 m", "from kitchen (place 10)", "0.30 m", "kitchen → 1 bedroom", "0.8 m at its end"):
        assert part in told
    assert "within kitchen" in words.way_story(ways.way(joined(), Trip(Spot(what="place", id=12), FAR_CORNER)))


@pytest.mark.parametrize(
    ("goal", "told"),
    [
        (Spot(what="place", id=11), "No way to kitchen"),
        (Spot(what="region", id=99), "there is no region 99; the scene has regions 3, 7"),
    ],
)
def test_no_way_is_told_and_draws_nothing(goal: Spot, told: str) -> None:
    none = ways.way(joined(), Trip(goal))
    assert told in words.way_story(none) and ways.picture(none, LINE, INK) == {}


def test_names_from_outside_are_text() -> None:
    evil = region(3, "<b>x", 0.9, (2.0, 1.5, 1.0))
    told = words.way_story(ways.way(joined(regions=[evil]), Trip(Spot(what="region", id=3), FAR_CORNER)))
    assert "&lt;b&gt;x" in told and "<b>x" not in told

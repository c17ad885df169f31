"""Maps that share no objects find together by printed markers, unless these or the walls contradict it."""

import msgspec
import numpy as np
import pytest

from prior_sg.deploy.fleet.core.finding.config import MatchConfig
from prior_sg.deploy.fleet.core.finding.frames import apart, level
from prior_sg.deploy.fleet.core.finding.marking import by_markers, pose_of
from prior_sg.deploy.fleet.core.finding.matching import again, map_of, match
from prior_sg.deploy.fleet.core.marks import GONE
from prior_sg.deploy.fleet.core.update import Config
from prior_sg.deploy.showing.export import scene_json
from prior_sg.deploy.showing.scene_reading import scene_of_json
from prior_sg.schemas.objects import ObjectDelta
from prior_sg.schemas.places import PlaceDelta
from prior_sg.schemas.topics import topic_of
from tests.deploy.fleet.test_bridge import CFG, MOVED, Fleet
from tests.help import houses
from tests.help.markers import on_wall

BARE = {"things": []}
HALL, BEDROOM = on_wall((5.0, 5.45, 1.4), -np.pi / 2), on_wall((0.05, 7.0, 1.4), 0.0)
MATCH = MatchConfig()


def turned(marker, radians):
    """The same spot, the paper tilted by a wrong angle about the vertical."""
    pose = marker.copy()
    pose[:3, :3] = level(radians, np.zeros(3))[:3, :3] @ marker[:3, :3]
    return pose


def two(markers_a, markers_b, **changes):
    first = houses.scene(rooms=houses.ROOMS[:4], markers=markers_a, **(BARE | changes))
    return first, houses.scene("r2", MOVED, rooms=houses.ROOMS[2:], markers=markers_b, **(BARE | changes))


def events(told):
    return next((message.event for message in told if isinstance(message, PlaceDelta)), "")


def found(first, second, cfg=MATCH):
    return match(map_of(first), map_of(second), cfg)


def test_without_markers_bare_houses_do_not_find_together():
    assert found(*two([], [])).b_from_a is None


def test_one_marker_gives_the_motion_and_walls_mend_its_heading():
    """Its heading is 4 degrees off in the second map, which is 35 cm at the far end of the house."""
    answer = found(*two([(7, HALL)], [(7, turned(HALL, 0.07))]))
    assert answer.b_from_a is not None and answer.by_markers
    gap_m, gap_rad = apart(answer.b_from_a, MOVED, np.array((4.0, 4.0, 1.0)))
    assert gap_m < 0.1 and gap_rad < np.radians(1)


def test_a_relation_by_markers_lasts_where_maps_share_hardly_any_floor():
    first = houses.scene(rooms=houses.ROOMS[:2], markers=[(7, HALL)], **BARE)
    second = houses.scene("r2", MOVED, rooms=houses.ROOMS[2:], markers=[(7, HALL)], **BARE)
    held = again(MOVED, map_of(first), map_of(second), MATCH)
    assert held.b_from_a == pytest.approx(MOVED) and held.by_markers
    bare = again(MOVED, map_of(first), map_of(msgspec.structs.replace(second, markers=[])), MATCH)
    assert bare.b_from_a is None and "they share only 0 m2" in bare.why


def test_a_marker_on_the_floor_tells_the_heading_too():
    flat = np.eye(4)
    flat[:3, 3] = 5.0, 4.8, 0.0
    said = by_markers(*two([(3, flat)], [(3, flat)]), MATCH)
    assert said.b_from_a == pytest.approx(MOVED)


def test_markers_that_disagree_are_refused_in_a_sentence():
    moved = BEDROOM.copy()
    moved[:3, 3] += (1.5, 0.0, 0.0)
    answer = found(*two([(7, HALL), (8, BEDROOM)], [(7, HALL), (8, moved)]))
    assert answer.b_from_a is None
    assert answer.why.startswith("marker 7 (apriltag_36h11) and marker 8 (apriltag_36h11) disagree: marker ")
    assert answer.why.endswith("from where r2 has it")
    turn = found(*two([(7, HALL), (8, BEDROOM)], [(7, HALL), (8, turned(BEDROOM, 1.0))]))
    assert turn.b_from_a is None and "would be turned by" in turn.why


def test_the_same_marker_in_another_house_is_refused_by_the_walls():
    other = houses.scene(
        "r2", MOVED, rooms=[(name, 1.3 * x, y, 1.3 * u, v) for name, y, x, v, u in houses.ROOMS], **BARE
    )
    other = msgspec.structs.replace(other, markers=[houses.marker(7, MOVED @ on_wall((3.0, 2.0, 1.4), 0.0))])
    answer = found(houses.scene(markers=[(7, HALL)], **BARE), other)
    assert answer.b_from_a is None and "of the walls would stand in what the other map knows as free" in answer.why


def test_other_dictionaries_are_other_markers():
    first, second = two([(7, HALL)], [(7, HALL)])
    second = msgspec.structs.replace(second, markers=[msgspec.structs.replace(second.markers[0], dictionary="4x4_50")])
    assert by_markers(first, second, MATCH) is None


def test_a_marker_that_hangs_twice_says_nothing_and_that_is_said():
    first, second = two([(7, HALL)], [(7, HALL)])
    doubted = [houses.marker(7, MOVED @ HALL, "it has been seen at 2 spots, up to 3.0 m from each other")]
    answer = found(first, msgspec.structs.replace(second, markers=doubted))
    assert answer.b_from_a is None
    assert answer.why.startswith("marker 7 (apriltag_36h11) says nothing, for in r2 it has been seen at 2 spots")


def test_markers_beyond_all_numbers_are_not_shared():
    first, second = two([(7, HALL)], [(7, HALL)])
    beyond = msgspec.structs.replace(second.markers[0], position_m=(1e300, 0.0, 0.0))
    assert found(first, msgspec.structs.replace(second, markers=[beyond])).b_from_a is None


def test_they_can_be_left_out():
    first, second = two([(7, HALL)], [(7, HALL)])
    assert found(first, second, MatchConfig(markers=False)).b_from_a is None


def test_two_robots_without_objects_make_one_map_and_follow_a_correction():
    """The second sees the marker when its map is complete; later a loop closure turns its map about itself."""
    fleet = Fleet()
    first, second = two([(7, HALL)], [(7, HALL)])
    fleet.tell(first)
    fleet.tick()
    fleet.tell(msgspec.structs.replace(second, markers=[]))
    fleet.tick()
    assert len(fleet.scene().regions) == 4
    _, _, objects = houses.deltas(second)
    late = msgspec.structs.replace(objects, revision=1, snapshot=False)
    fleet.pipeline.publish(topic_of(ObjectDelta), late)
    assert "r2 has been found in the map of home by markers" in events(fleet.tick())
    scene = fleet.scene()
    assert sorted(region.label for region in scene.regions) == houses.LABELS
    assert pose_of(scene.markers[0]) == pytest.approx(HALL, abs=0.02)
    turned_house = houses.scene("r2", level(1.0, np.array((3.0, 0.0, 0.0))) @ MOVED, rooms=houses.ROOMS[2:],
                                markers=[(7, HALL)], **BARE)  # fmt: skip
    for delta in houses.deltas(turned_house):
        fleet.pipeline.publish(topic_of(type(delta)), msgspec.structs.replace(delta, revision=5))
    for _ in range(12):
        fleet.tick()
    bathroom = next(region for region in fleet.scene().regions if region.label == "bathroom")
    assert np.linalg.norm(np.array(bathroom.position_m[:2]) - (6.3, 7.3)) < 0.5


def test_a_refusal_is_told_once_and_the_flag_mends_it():
    moved = BEDROOM.copy()
    moved[:3, 3] += (1.5, 0.0, 0.0)
    first = houses.scene(rooms=houses.ROOMS[:4], markers=[(7, HALL), (8, BEDROOM)])
    second = houses.scene("r2", MOVED, rooms=houses.ROOMS[1:], markers=[(7, HALL), (8, moved)])
    fleet, without = Fleet(), Fleet(msgspec.structs.replace(CFG, match=MatchConfig(markers=False)))
    told = []
    for one in (fleet, without):
        one.tell(first)
        one.tick()
        one.tell(second)
        told.append(events(one.tick()))
    assert "r2 is not merged: marker 7" in told[0] and "disagree" in told[0]
    assert "r2 has been found in the map of home" in told[1]
    assert fleet.tick() == []


def test_a_marker_that_two_related_maps_have_elsewhere_is_doubted_in_the_merged_one():
    fleet = Fleet(Config(robots=("r1", "r2"), transforms={"r1": (0, 0, 0, 0), "r2": (0, 0, 0, 0)}))
    fleet.tell(houses.scene(markers=[(7, HALL)]))
    fleet.tell(houses.scene("r2", markers=[(7, BEDROOM)]))
    fleet.tick()
    (marker,) = fleet.scene().markers
    assert marker.doubt == "r1 and r2 have it 5.2 m from each other"


def test_a_marker_that_two_related_maps_have_at_one_spot_is_one_with_the_keyframes_of_both():
    fleet = Fleet(Config(robots=("r1", "r2"), transforms={"r1": (0, 0, 0, 0), "r2": (0, 0, 0, 0)}))
    one, two = houses.scene(markers=[(7, HALL)]), houses.scene("r2", markers=[(7, HALL)])
    fleet.tell(one)
    fleet.tell(two)
    fleet.tick()
    (marker,) = fleet.scene().markers
    assert marker.frames == one.markers[0].frames + two.markers[0].frames and not marker.doubt


@pytest.mark.parametrize("doubting", ["r1", "r2"])
def test_a_marker_that_one_of_the_maps_doubts_is_doubted_and_the_map_is_named(doubting):
    fleet = Fleet(Config(robots=("r1", "r2"), transforms={"r1": (0, 0, 0, 0), "r2": (0, 0, 0, 0)}))
    for robot in ("r1", "r2"):
        scene = houses.scene(robot, markers=[(7, HALL)])
        doubted = [msgspec.structs.replace(scene.markers[0], doubt="it moved" if robot == doubting else "")]
        fleet.tell(msgspec.structs.replace(scene, markers=doubted))
    fleet.tick()
    assert [marker.doubt for marker in fleet.scene().markers] == [f"in {doubting} it moved"]


def test_a_marker_of_a_map_that_is_taken_out_is_doubted():
    fleet = Fleet()
    fleet.tell(houses.scene(markers=[(7, HALL)], **BARE))
    fleet.tick()
    fleet.tell(houses.scene(**BARE), epoch=2)
    told = [message for message in fleet.tick() if isinstance(message, ObjectDelta)]
    assert [marker.doubt for delta in told for marker in delta.markers] == [GONE]


def test_markers_are_in_the_file_of_a_scene():
    scene = msgspec.structs.replace(houses.scene(markers=[(7, HALL)]), merged_of=["r1", "r2"])
    found = scene_of_json(scene_json(scene))
    assert found.markers == scene.markers and found.merged_of == scene.merged_of

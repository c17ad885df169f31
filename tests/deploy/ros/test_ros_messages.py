"""Scenes as messages: worked by hand, by the rules of RViz and Nav2, and byte for byte as ROS itself writes them."""

import json
import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest

from prior_sg.deploy.ros import grids, masks, messages, parameters
from prior_sg.deploy.ros.bridge import bridge_types
from prior_sg.deploy.ros.grids import FREE, UNKNOWN, CellValues, ground_of
from prior_sg.deploy.ros.markers import ARRAY, marker_array, place_of, with_barbs
from prior_sg.deploy.ros.parameters import Parameters
from prior_sg.deploy.ros.rules import Look, check_rules, rule_of
from prior_sg.deploy.ros.topics import Teller
from prior_sg.deploy.viewing.drawing import Painter
from prior_sg.deploy.viewing.shapes import Lines
from prior_sg.schemas.regions import NO_REGION
from tests.help.homes import home

RULES = tuple(map(rule_of, ("Kitchen=slow:50", "bedroom=keepout")))
TYPES = bridge_types()
CLASSES = TYPES.store.types


def teller():
    return Teller(CLASSES, Look(rules=RULES))


def told(scene, by=None):
    return dict((by or teller()).about(scene))


def without_bedroom():
    scene = home()
    owners = np.where(scene.place_regions == 7, NO_REGION, scene.place_regions)
    return msgspec.structs.replace(scene, regions=scene.regions[:1], place_regions=owners)


class Shown:
    """What RViz shows after some arrays, by the actions that its MarkerCommon knows."""

    def __init__(self):
        self.markers = {}

    def take(self, array):
        for marker in array.markers:
            if marker.action == marker.DELETEALL:
                self.markers.clear()
            elif marker.action == marker.DELETE:
                self.markers.pop((marker.ns, marker.id), None)
            else:
                self.markers[marker.ns, marker.id] = marker
        return self.markers


def test_regions_that_are_gone_are_gone_also_for_those_who_missed_an_array():
    by, faithful, late = teller(), Shown(), Shown()
    first, second, third = (told(scene, by)["markers"] for scene in (home(), without_bedroom(), home()))
    faithful.take(first)
    assert {("regions/floor", 3), ("regions/floor", 7), ("regions/name", 7)} <= set(faithful.markers)
    faithful.take(second)
    late.take(second)
    assert set(faithful.markers) == set(late.markers) and ("regions/floor", 3) in late.markers
    assert not {key for key in faithful.markers if key[1] == 7}
    assert faithful.take(third).keys() == Shown().take(first).keys()
    for array in (first, second, third):
        names = [(marker.ns, marker.id) for marker in array.markers]
        assert len(names) == len(set(names))  # else RViz shows an error


def test_colours_are_those_of_the_live_page_and_stay():
    by, page = teller(), Painter()
    for scene in (home(), without_bedroom(), home()):
        colors = page.label_colors(scene)
        shown = Shown().take(told(scene, by)["markers"])
        for region in scene.regions:
            tint = shown["regions/floor", region.id].color
            assert tuple(round(255 * part) for part in (tint.r, tint.g, tint.b)) == colors[region.label]
            assert shown["regions/name", region.id].text == f"{region.label} {100 * region.probability:.0f} %"


def test_places_edges_objects_and_frontiers_are_batches():
    scene = home()
    shown = Shown().take(told(scene)["markers"])
    places, edges, boxes = shown["places", 0], shown["edges", 0], shown["objects/boxes", 0]
    assert places.type == places.SPHERE_LIST and len(places.points) == len(places.colors) == 10
    assert (places.points[4].x, places.points[4].y, places.points[4].z) == tuple(scene.positions_m[4].tolist())
    assert edges.type == edges.LINE_LIST and len(edges.points) == 2 * len(scene.edges)
    assert len(boxes.points) == 2 * 12 * 2  # edges of two named boxes
    assert {shown["objects/names", number].text for number in (1, 2)} == {"stove", "bed"}
    arrow = shown["frontiers/arrows", 0].points
    assert len(arrow) == 6 and arrow[1].y > arrow[0].y == 2.0


def test_barbs_point_back_on_both_sides():
    (_, shaft_end), (tip, left), (_, right) = with_barbs(np.array([[(0, 0, 0), (1, 0, 0)]], np.float32))
    assert shaft_end == pytest.approx(tip) and left[0] == pytest.approx(right[0]) and left[0] < 1
    assert left[1] == pytest.approx(-right[1]) and left[1] > 0.1


def test_nothing_that_rviz_calls_an_error():
    empty = Lines(np.zeros((0, 2, 3), np.float32), np.array((1, 2, 3), np.uint8), 1.0)
    assert len(marker_array(CLASSES, {"/regions/3/outline": empty}, "map").markers) == 1
    assert place_of("/regions/4294967299/floor") == ("regions/floor", 3)  # an id is an int32


def cell(grid, x_m, y_m):
    about = grid.info
    column = int((x_m - about.origin.position.x) / about.resolution)
    row = int((y_m - about.origin.position.y) / about.resolution)
    return int(grid.data[row * about.width + column])


def test_grids_say_whose_a_spot_is_and_where_it_is_free():
    by_topic = told(home())
    regions, free = by_topic["region_grid"], by_topic["free_grid"]
    table = json.loads(by_topic["regions"].data)
    values = {one["label"]: one["grid_value"] for one in table["regions"]}
    assert sorted(values.values()) == [1, 2]
    assert cell(regions, 2.0, 1.5) == values["kitchen"] and cell(regions, 6.0, 1.5) == values["bedroom"]
    assert cell(regions, 2.0, 3.4) == UNKNOWN and cell(free, 2.0, 3.4) == UNKNOWN
    assert cell(free, 2.0, 2.97) == FREE  # just within a sphere of radius 1 at y = 2
    assert cell(free, 2.0, 3.08) == UNKNOWN and cell(regions, 2.0, 3.08) == values["kitchen"]  # just outside it
    assert set(np.unique(free.data)) == {FREE, UNKNOWN}
    assert (regions.info.width, regions.info.height) == (200, 120)  # -2..8 and -2..4 m at 5 cm


def test_a_cell_is_free_where_its_middle_lies_in_a_sphere():
    scene, grid = home(), told(home())["free_grid"]
    about = grid.info
    turn = about.origin.orientation
    assert (turn.x, turn.y, turn.z, turn.w) == (0, 0, 0, 1)
    rows, columns = np.mgrid[: about.height, : about.width] + 0.5
    x_m, y_m = about.origin.position.x + columns * 0.05, about.origin.position.y + rows * 0.05
    away_m = np.hypot(x_m[..., None] - scene.positions_m[:, 0], y_m[..., None] - scene.positions_m[:, 1])
    reach_m = (scene.radii_m - away_m).max(axis=-1)
    clear = np.abs(reach_m) > 1e-4
    assert ((grid.data.reshape(rows.shape) == FREE) == (reach_m > 0))[clear].all()


def test_places_of_no_region_are_free_and_nobodys():
    grid = told(without_bedroom())["region_grid"]
    assert cell(grid, 6.0, 1.5) == FREE and cell(grid, 2.0, 1.5) == 1


def test_grids_stay_bounded_and_an_empty_scene_has_one():
    scene = home()
    far = scene.positions_m.copy()
    far[0] = (90_000.0, -70_000.0, 1.0)
    layout = ground_of(msgspec.structs.replace(scene, positions_m=far), 0.05).layout
    assert np.prod(layout.shape) <= grids.MOST_CELLS and layout.cell_m == 0.05 * 2 ** round(
        np.log2(layout.cell_m / 0.05)
    )
    nothing = msgspec.structs.replace(
        scene,
        regions=[],
        place_ids=scene.place_ids[:0],
        positions_m=scene.positions_m[:0],
        radii_m=scene.radii_m[:0],
        basis_points=scene.basis_points[:0],
        place_regions=scene.place_regions[:0],
        posteriors=scene.posteriors[:0],
        unknown=scene.unknown[:0],
        edges=scene.edges[:0],
        clearances_m=scene.clearances_m[:0],
        frontier_ids=scene.frontier_ids[:0],
        frontier_directions=scene.frontier_directions[:0],
        frontier_areas_m2=scene.frontier_areas_m2[:0],
    )
    assert told(nothing)["region_grid"].data.tolist() == [UNKNOWN]


def test_one_storey_can_be_asked_for():
    scene = home()
    above = scene.positions_m.copy()
    above[6:] = scene.positions_m[:4] + np.array((0, 0, 3))
    scene = msgspec.structs.replace(scene, positions_m=above)
    low = Teller(CLASSES, Look(heights_m=(0.0, 2.0)))
    grid = told(scene, low)["region_grid"]
    assert set(np.unique(grid.data)) == {UNKNOWN, low.values.of([3, 7])[3]}


def test_values_are_kept_for_life_and_taken_again_last():
    values = CellValues()
    assert values.of([7, 3]) == {7: 1, 3: 2}
    assert values.of([3, 9]) == {3: 2, 9: 3}
    assert values.of([3, 9, 11]) == {3: 2, 9: 3, 11: 4}  # not 1, which was another's
    many = CellValues().of(list(range(150)))
    assert sorted(many.values()) == list(range(1, 101)) and list(many) == list(range(100))


@pytest.mark.parametrize(
    ("written", "said"),
    [
        ("ward", "is no mask"),
        ("ward=slow", "1 to 100"),
        ("ward=slow:0", "1 to 100"),
        ("ward=slow:101", "1 to 100"),
        ("ward=slow:5.5", "1 to 100"),
        ("ward=stop", "is no mask"),
        ("=keepout", "is empty"),
        ("a\x1bb=keepout", "control characters"),
    ],
)
def test_masks_that_cannot_be_are_told(written, said):
    with pytest.raises(ValueError, match=said):
        rule_of(written)


def test_rules_that_contradict_each_other_are_told():
    assert len(check_rules([*RULES, RULES[0], rule_of("kitchen=keepout")])) == 3
    with pytest.raises(ValueError, match="two masks"):
        check_rules([rule_of("ward=slow:50"), rule_of("Ward=slow:30")])


def test_masks_say_what_nav2_understands():
    by = teller()
    by_topic = told(home(), by)
    speed, keepout = by_topic["speed_mask"], by_topic["keepout_mask"]
    assert cell(speed, 2.0, 1.5) == 50 and cell(speed, 6.0, 1.5) == 0
    assert set(np.unique(speed.data)) == {0, 50}  # -1 is an error to Nav2's speed filter
    assert cell(keepout, 6.0, 1.5) == 100 and cell(keepout, 2.0, 1.5) == UNKNOWN
    assert set(np.unique(keepout.data)) == {UNKNOWN, 100}  # 0 would make free what the costmap does not know
    assert cell(speed, -6.0, -6.0) == 0 and cell(speed, 11.0, 7.0) == 0  # outside a mask the last limit would stay
    infos = {name: (one.type, one.filter_mask_topic, one.base, one.multiplier) for name, one in by.filter_infos()}
    assert infos == {
        "keepout_info": (0, "/prior_sg/keepout_mask", 0.0, 1.0),
        "speed_info": (1, "/prior_sg/speed_mask", 0.0, 1.0),
    }
    assert masks.without_region([*RULES, rule_of("ward=keepout")], home().regions) == ["ward"]
    plain = dict(Teller(CLASSES, Look()).about(home()))
    assert not {name for name in plain if "mask" in name}


def test_an_equal_scene_has_equal_bytes():
    by = teller()
    first, second = ({name: TYPES.encode(one) for name, one in by.about(home())} for _ in range(2))
    assert first == second
    later = {name: TYPES.encode(one) for name, one in by.about(home(stamp_ns=5, revision=9))}
    assert {name for name, data in later.items() if data != first[name]} == {"regions", "scene"}


def test_frames_stand_in_the_middle_of_regions():
    kitchen, bedroom = teller().tf(home(), 1_500_000_000).transforms
    assert (kitchen.header.frame_id, kitchen.child_frame_id) == ("map", "prior_sg/region_3")
    assert (kitchen.header.stamp.sec, kitchen.header.stamp.nanosec) == (1, 500_000_000)
    at = bedroom.transform.translation
    assert (at.x, at.y, at.z) == (6.0, 1.5, 1.0) and bedroom.transform.rotation.w == 1.0


def parameter(name, text, kind=parameters.STRING):
    value = Parameters(CLASSES, lambda: {"task": text}, lambda task: "")._value("task")
    value.type = kind
    return CLASSES["rcl_interfaces/msg/Parameter"](name, value)


def ask(service, *fields, give=lambda task: ""):
    force = {"task": "tidy up", "environment": "home", "robot": "ada"}
    request = CLASSES[f"{parameters.type_of(service)}_Request"](*fields)
    reply = Parameters(CLASSES, lambda: force, give).answer(service, request)
    return TYPES.decode(TYPES.encode(reply), f"{parameters.type_of(service)}_Response")


def test_parameters_are_listed_read_and_described():
    assert ask("list_parameters", [], 0).result.names == ["task", "environment", "robot"]
    found = ask("get_parameters", ["robot", "task", "gone"]).values
    assert [value.string_value for value in found] == ["ada", "tidy up", ""]
    assert ask("get_parameter_types", ["task", "gone"]).types.tolist() == [4, 0]
    task, robot = ask("describe_parameters", ["task", "robot"]).descriptors
    assert (task.read_only, robot.read_only) == (False, True) and "what the robot is to do" in task.description
    with pytest.raises(ValueError, match="at most 100"):
        ask("get_parameters", ["task"] * 101)


@pytest.mark.parametrize(
    ("name", "text", "kind", "reason"),
    [
        ("robot", "bob", 4, "for reading"),
        ("speed", "1", 4, "no parameter"),
        ("task", "x", 2, "is a text"),
        ("task", " \t ", 4, "is empty"),
        ("task", "a\x1b[2J", 4, "control characters"),
        ("task", "x" * 2001, 4, "longer than 2000"),
    ],
)
def test_what_cannot_be_set_is_told(name, text, kind, reason):
    asked = []
    (result,) = ask("set_parameters", [parameter(name, text, kind)], give=asked.append).results
    assert not result.successful and reason in result.reason and asked == []


def test_a_task_is_set_once_or_not_at_all():
    asked = []

    def give(task):
        asked.append(task)
        return "busy" if task == "later" else ""

    (result,) = ask("set_parameters", [parameter("task", " tidy  up ")], give=give).results
    assert result.successful and asked == ["tidy up"]
    result = ask("set_parameters_atomically", [parameter("task", "later")], give=give).result
    assert (result.successful, result.reason) == (False, "busy")
    both = [parameter("task", "a"), parameter("task", "b")]
    assert "twice" in ask("set_parameters_atomically", both, give=give).result.reason
    assert asked == ["tidy up", "later"]


def messages_by_ros():
    """All messages that are written whose packages there are, with ROS's own classes."""
    from geometry_msgs.msg import TransformStamped
    from nav_msgs.msg import OccupancyGrid
    from rcl_interfaces import srv
    from std_msgs.msg import String
    from visualization_msgs.msg import MarkerArray

    classes = {"MarkerArray": MarkerArray, "OccupancyGrid": OccupancyGrid, "String": String}
    found = dict(teller().about(home()))
    for name, message in found.items():
        yield name, message, classes[message.__msgtype__.rpartition("/")[2]]
    yield "other letters", messages.text(CLASSES, "Küche ☕"), String
    yield "tf", teller().tf(home(), 1_500_000_000).transforms[0], TransformStamped
    replies = {
        "get_parameters": (["task", "gone"],),
        "get_parameter_types": (["task"],),
        "describe_parameters": (["task"],),
        "list_parameters": ([], 0),
        "set_parameters": ([parameter("robot", "bob")],),
        "set_parameters_atomically": ([parameter("task", "tidy")],),
    }
    for service, fields in replies.items():
        yield service, ask(service, *fields), getattr(srv, parameters.SERVICES[service][0]).Response


def test_bytes_are_those_of_ros_itself():
    """But for what ROS leaves as it was in memory: between fields that are aligned, and a little behind the end."""
    serialization = pytest.importorskip("rclpy.serialization")
    names = []
    for name, message, of_ros in messages_by_ros():
        ours = TYPES.encode(message)
        theirs = serialization.serialize_message(serialization.deserialize_message(ours, of_ros))
        assert 0 <= len(theirs) - len(ours) < 16, name
        theirs = theirs[: len(ours)]
        differ = np.frombuffer(ours, np.uint8) != np.frombuffer(theirs, np.uint8)
        assert not np.frombuffer(ours, np.uint8)[differ].any(), name
        assert TYPES.encode(TYPES.decode(theirs, message.__msgtype__)) == ours, name
        names.append(name)
    assert len(names) == 15


def test_hashes_are_those_of_ros_itself():
    pytest.importorskip("rclpy")
    names = {ARRAY, grids.GRID, "std_msgs/msg/String", *map(parameters.type_of, parameters.SERVICES)}
    for name in sorted(names):
        described = json.loads(Path(sys.prefix, "share", f"{name}.json").read_text())
        theirs = {one["type_name"]: one["hash_string"] for one in described["type_hashes"]}
        assert TYPES.hash(name) == theirs[name]

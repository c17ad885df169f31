import msgspec
import numpy as np
import pytest

from prior_sg.deploy.api.client import Health
from prior_sg.deploy.showing.colors import PALETTE, LabelColors
from prior_sg.deploy.viewing import drawing
from prior_sg.deploy.viewing.cloud import Cloud, points_of
from prior_sg.deploy.viewing.drawing import BLOCK, Lit, Painter, marker_root
from prior_sg.deploy.viewing.footprint import Footprint, footprints
from prior_sg.deploy.viewing.picking import PickedMarker, pick, typical_place
from prior_sg.deploy.viewing.search import find
from prior_sg.deploy.viewing.shapes import Mesh, difference
from prior_sg.deploy.viewing.sources import Likeness
from prior_sg.deploy.viewing.ways import Trip, way
from prior_sg.deploy.viewing.words import headline, health_table, legend, place_story, region_story
from prior_sg.schemas.queries import Spot
from prior_sg.schemas.status import Loss, ServiceStatus
from prior_sg.services.scene_store.core.queries.index import Index
from tests.help.examples import EXAMPLES
from tests.help.foreseen import foresight
from tests.help.homes import home, keyframe, marked_home, region, two_floors


def area_m2(ground: Footprint) -> float:
    a, b, c = (ground.vertices[ground.faces[:, corner], :2].astype(float) for corner in range(3))
    return float(np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]).sum() / 2)


def test_footprint_of_a_single_place_is_its_disc() -> None:
    scene = home()
    alone = msgspec.structs.replace(scene, place_regions=np.array([3] + [-1] * 9))
    ground = footprints(alone)[3]
    assert area_m2(ground) == pytest.approx(np.pi * 1.14**2, rel=0.04)
    radii = np.linalg.norm(ground.outline[..., :2].reshape(-1, 2) - (1.0, 1.0), axis=1)
    assert np.abs(radii - 1.14).max() < 0.05
    assert ground.vertices[:, 2] == pytest.approx(0.0, abs=1e-6)


def test_footprints_of_neighbours_touch_and_never_overlap() -> None:
    ground = footprints(home())
    kitchen, bedroom = ground[3], ground[7]
    assert kitchen.vertices[:, 0].max() < 4.35 and bedroom.vertices[:, 0].min() > 4.15
    assert kitchen.vertices[:, 0].max() <= bedroom.vertices[:, 0].min() + 0.06


def test_expected_regions_are_faint_discs_with_a_name() -> None:
    scene = home()
    label = scene.regions[0].label
    picture = Painter().draw(msgspec.structs.replace(scene, foresight=foresight(scene, 2, label, 0.8)))
    root = f"/foreseen/{int(scene.place_ids[2])}"
    assert {name for name in picture if name.startswith("/foreseen/")} == {
        f"{root}/{part}" for part in ("disc", "way", "name")
    }
    disc, name = picture[f"{root}/disc"], picture[f"{root}/name"]
    assert (
        disc.opacity == drawing.PREDICTED_OPACITY
        and disc.color == picture[f"/regions/{scene.regions[0].id}/floor"].color
    )
    assert name.text.endswith("40 %, expected")
    faint = Painter().draw(msgspec.structs.replace(scene, foresight=foresight(scene, 2, label, 0.1)))
    assert not [name for name in faint if name.startswith("/foreseen/")]


def test_a_region_under_another_has_a_name_and_no_ground() -> None:
    scene = home()
    radii_m = scene.radii_m.copy()
    radii_m[0] = 0.2
    owners = scene.place_regions.copy()
    owners[0] = 5
    positions_m = scene.positions_m.copy()
    positions_m[0] = positions_m[1] + np.array((0.0, 0.0, 0.5))
    lost = region(5, "niche", 0.4, (1.0, 1.0, 1.0))
    picture = Painter().draw(
        msgspec.structs.replace(
            scene, radii_m=radii_m, place_regions=owners, positions_m=positions_m, regions=[*scene.regions, lost]
        )
    )
    assert [name for name in picture if name.startswith("/regions/5/")] == ["/regions/5/name"]


def test_storeys_do_not_compete() -> None:
    scene = home()
    above = scene.positions_m.copy()
    above[6:] = scene.positions_m[:4] + np.array((0, 0, 3))
    ground = footprints(msgspec.structs.replace(scene, positions_m=above))
    assert area_m2(ground[7]) == pytest.approx(area_m2(footprints(msgspec.structs.replace(scene))[7]), rel=0.1)
    assert float(ground[7].vertices[0, 2]) == pytest.approx(3.0)


def test_nothing_is_sent_for_an_equal_scene_and_little_for_a_small_change() -> None:
    painter, scene = Painter(), home()
    before = painter.draw(scene)
    assert difference(before, painter.draw(home())).changed == {}
    renamed = msgspec.structs.replace(scene.regions[0], probability=0.5)
    after = painter.draw(msgspec.structs.replace(scene, regions=[renamed, scene.regions[1]]))
    assert list(difference(before, after).changed) == ["/regions/3/name"]
    gone = painter.draw(msgspec.structs.replace(scene, objects=scene.objects[:1]))
    assert set(difference(before, gone).removed) == {"/objects/names/2", "/unnamed/boxes/0"}


def test_only_the_block_of_a_new_place_is_sent() -> None:
    ids = np.array([*range(10, 19), BLOCK + 1])
    painter, edges = Painter(), np.array([(10, 11), (18, BLOCK + 1)])
    scene = home(place_ids=ids, edges=edges, clearances_m=np.ones(2, np.float32), frontier_ids=ids[:1])
    moved = scene.positions_m.copy()
    moved[-1] += 0.01
    changed = difference(painter.draw(scene), painter.draw(msgspec.structs.replace(scene, positions_m=moved))).changed
    assert {name for name in changed if name.startswith(("/places", "/edges"))} == {"/places/1", "/edges/1"}


def test_a_label_keeps_its_colour_while_regions_come_and_go() -> None:
    painter, scene = Painter(), home()
    kitchen = painter.draw(scene)["/regions/3/floor"]
    many = [region(20 + k, f"room {k}", 0.5, (2.0, 1.5, 1.0)) for k in range(30)]
    assert len(set(painter.label_colors(home(regions=[*scene.regions, *many])).values())) == 32
    again = painter.draw(scene)["/regions/3/floor"]
    assert isinstance(kitchen, Mesh) and isinstance(again, Mesh)
    assert kitchen.color == again.color


def test_colours_of_labels_that_left_are_used_again() -> None:
    colors = LabelColors()
    colors.of(f"old {k}" for k in range(len(PALETTE)))
    assert set(colors.of(f"new {k}" for k in range(len(PALETTE))).values()) == set(PALETTE)


def test_predicted_regions_are_faint_and_dashed_and_say_so() -> None:
    scene, painter = home(), Painter()
    plain = painter.draw(scene)
    predicted = msgspec.structs.replace(scene.regions[0], predicted=True)
    faint = painter.draw(msgspec.structs.replace(scene, regions=[predicted, scene.regions[1]]))
    assert faint["/regions/3/floor"].opacity < plain["/regions/3/floor"].opacity / 2
    assert len(faint["/regions/3/outline"].points_m) < 0.7 * len(plain["/regions/3/outline"].points_m)
    assert faint["/regions/3/name"].text == "kitchen 90 %, predicted"


def test_unknown_places_are_grey() -> None:
    unknown = np.zeros(10, np.float16)
    unknown[0] = 1.0
    colors = Painter().draw(home(unknown=unknown))["/places/0"].colors.astype(int)
    assert np.ptp(colors[0]) < 15 < np.ptp(colors[1])


def test_answers_are_lit_and_the_rest_is_dimmed() -> None:
    scene, painter = home(), Painter()
    found = find(Index(scene), "stove")
    assert found.hits[0][:3] == ("object", 1, "stove") and found.lit.objects == {1}
    lit = painter.draw(scene, found.lit)
    assert "/answers/objects" in lit and "/answers/names/1" in lit
    assert lit["/regions/7/floor"].opacity < painter.draw(scene)["/regions/7/floor"].opacity / 2
    assert find(Index(scene), "bedr").lit == Lit(regions=frozenset({7}))
    assert find(Index(scene), "").lit == Lit()
    assert "nothing" in find(Index(scene), "submarine").said


def test_what_a_text_means_comes_before_its_words_and_doubts_are_said() -> None:
    scene = home()
    meant = find(Index(scene), "somewhere to sleep", Likeness({"bedroom": 0.9, "kitchen": 0.05}, {"bed": 0.8}))
    assert meant.hits[0][:3] == ("region", 7, "bedroom") and meant.lit.regions == {7} and meant.said == ""
    doubted = find(Index(scene), "somewhere to sleep", Likeness({"bedroom": 0.3, "kitchen": 0.2}, {}))
    assert "for sure" in doubted.said
    assert "no worker" in find(Index(scene), "stove", Likeness({}, {}, "no worker embeds it")).said


def test_what_the_page_leaves_out_is_counted() -> None:
    many = [msgspec.structs.replace(home().objects[0], id=number) for number in range(30)]
    index = Index(home(objects=many))
    for text, more in (("stove", 27), ("sto", 25)):  # a word, with the regions that hold some; the beginning of one
        found = find(index, text)
        assert len(found.hits) == 5 and f"{more} more: write more of what you look for" in found.said
    assert len(find(index, "stove").lit.objects) == 30
    assert "write more" not in find(Index(home()), "stove").said
    labels = [f"room {number}" for number in range(9)]
    scene = home(labels=labels, posteriors=np.full((len(home().place_ids), 9), 0.1, np.float16))
    told = region_story(scene, msgspec.structs.replace(scene.regions[0], label=labels[0]))
    assert "6 other labels: prior-sg query region 3" in told
    assert "4 other labels: prior-sg query place 10" in place_story(scene, 10)
    assert "other label" not in region_story(home(), home().regions[0])


def test_further_losses_of_a_process_are_counted() -> None:
    status = next(one for one in EXAMPLES if isinstance(one, ServiceStatus))
    losses = [Loss(what=f"what {number}", reason="r", count=1, example="e") for number in range(4)]
    told = health_table(Health([msgspec.structs.replace(status, losses=losses)], {}))
    assert "1 what 1" in told and "what 2" not in told and "and 2 other losses: prior-sg health" in told


@pytest.mark.parametrize(
    ("above", "place", "region_", "itself"),
    [((2.0, 1.0), 12, 3, True), ((2.5, 1.4), 12, 3, False), ((6.2, 1.4), 18, 7, False), ((20.0, 20.0), None, 0, False)],
)
def test_a_click_means_the_dot_under_it_or_the_region(above: tuple, place: int, region_: int, itself: bool) -> None:
    scene = home()
    picked = pick(scene, footprints(scene), np.array((*above, 9.0)), np.array((0.0, 0.0, -1.0)), dots=True)
    if place is None:
        assert picked is None
        return
    assert picked is not None
    assert (picked.region, picked.itself) == (region_, itself)
    assert picked.place == place or not itself


def test_without_dots_a_click_means_the_region() -> None:
    scene = home()
    picked = pick(scene, footprints(scene), np.array((2.0, 1.0, 9.0)), np.array((0.0, 0.0, -1.0)), dots=False)
    assert picked is not None and not picked.itself and typical_place(scene, picked.region) in (12, 13)


def test_printed_markers_are_sheets_with_a_name_and_those_in_doubt_are_outlines() -> None:
    picture = Painter().draw(marked_home())
    sure, doubted = ("/markers/7/in_apriltag_36h11", "/markers/9/in_apriltag_36h11")
    parts = {name for name in picture if name.startswith("/markers/")}
    assert parts == {f"{sure}/{part}" for part in ("sheet", "outline", "name")} | {
        f"{doubted}/{part}" for part in ("outline", "name")
    }
    corners_m = picture[f"{sure}/sheet"].vertices_m
    assert corners_m[:, 0] == pytest.approx(4.45) and np.ptp(corners_m[:, 1:], axis=0) == pytest.approx((0.16, 0.16))
    assert picture[f"{sure}/name"].text == "marker 7" and "in doubt" in picture[f"{doubted}/name"].text
    hostile = msgspec.structs.replace(marked_home().markers[0], dictionary="a/../b<")
    assert marker_root(hostile) == "/markers/7/in_a____b_"


@pytest.mark.parametrize(
    ("off_m", "markers", "number"), [(0.0, True, 7), (0.07, True, 7), (0.3, True, None), (0.0, False, None)]
)
def test_a_click_on_a_marker_means_it_while_it_is_shown(off_m: float, markers: bool, number: int | None) -> None:
    scene = marked_home()
    eye, at = np.array((1.0, 1.0, 4.0)), np.array((4.45, 1.0 + off_m, 1.5))
    picked = pick(scene, footprints(scene), eye, at - eye, dots=False, markers=markers)
    assert (picked.key.id if isinstance(picked, PickedMarker) else None) == number


def test_the_name_of_a_marker_finds_it_and_what_is_doubtful_is_said() -> None:
    index = Index(marked_home())
    assert [(hit.what, hit.id) for hit in find(index, " Marker 7").hits] == [("marker", 7)]
    assert "in doubt" in find(index, "marker #9").said and "no marker 8" in find(index, "marker 8").said
    assert find(index, "marker 7 is beside the bed").hits[0].label == "bed", "a sentence is a sentence"


def test_a_merged_map_without_a_task_says_whose_it_is_and_what_to_do() -> None:
    bare = home(task="", regions=[], robot="home", merged_of=["robot1", "robot2"])
    told = headline(bare, "live")
    assert "merged map of robot1, robot2: give it a task" in told and "no task yet" not in told
    assert "a task of robot1 or robot2" in legend(bare, {})
    assert "home, merged map of robot1, robot2" in headline(home(robot="home", merged_of=["robot1", "robot2"]), "live")
    assert "no task: residential home as it is" in headline(home(task=""), "live")
    assert "no task yet" in headline(home(task="", regions=[]), "live") and "merged" not in headline(home(), "live")


def test_points_lie_where_the_depth_says_and_are_sent_once() -> None:
    frame = keyframe()
    points_m, colors = points_of(frame)
    assert len(points_m) == len(colors) > 0
    assert points_m[:, 0] == pytest.approx(3.0, abs=1e-5)
    left = points_m[:, 1] > 1.0
    assert (colors[left] == (255, 0, 0)).all() and (colors[~left] == (0, 0, 255)).all()
    cloud = Cloud()
    cloud.add(frame)
    before = cloud.picture()
    cloud.add(msgspec.structs.replace(frame, frame_id=frame.frame_id + 100))  # sees nothing new
    assert difference(before, cloud.picture()).changed == {}
    moved = frame.world_from_camera.copy()
    moved[:3, 3] += (1.0, 0.0, 0.0)
    cloud.move({frame.frame_id: moved})
    shifted = cloud.picture()[next(iter(before))].points_m - before[next(iter(before))].points_m
    assert shifted == pytest.approx(np.tile((1.0, 0.0, 0.0), (len(shifted), 1)), abs=1e-4)


def test_points_above_the_cut_and_later_ones_are_left_out() -> None:
    frame = keyframe()
    cloud = Cloud()
    cloud.add(frame)
    heights = np.concatenate([shape.points_m[:, 2] for shape in cloud.picture().values()])
    middle_m = float(np.median(heights))
    low = np.concatenate([shape.points_m[:, 2] for shape in cloud.picture(middle_m).values()])
    assert low.max() <= middle_m and len(low) < len(heights)
    assert cloud.picture(until_ns=frame.stamp_ns - 1) == {}


def test_of_very_many_edges_some_are_drawn_and_the_page_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = home()
    assert len(Painter().draw(scene)["/edges/0"].points_m) == 3
    assert "edges" not in headline(scene, "test")
    monkeypatch.setattr(drawing, "MOST_EDGES", 2)
    fewer = home(edges=np.array([(10, 11), (10, 12), (11, 12)]))
    assert len(Painter().draw(fewer)["/edges/0"].points_m) == 1  # the one whose ids have an even sum
    assert "one of 2 edges is drawn" in headline(scene, "test")


def test_where_the_robot_has_been_is_dashed_and_named() -> None:
    drawn = Painter().draw(home())
    dashes = drawn["/trajectory/0"].points_m
    lengths_m = np.linalg.norm(dashes[:, 1] - dashes[:, 0], axis=1)
    assert lengths_m.max() < 0.13 and lengths_m.sum() == pytest.approx(5.508 / 2, abs=0.01)
    assert drawn["/trajectory/robot"].text == "robot" and drawn["/trajectory/robot"].position_m[0] == 6.0


def test_of_one_number_in_two_dictionaries_each_is_named_clicked_and_gone_to_by_itself() -> None:
    one = marked_home().markers[0]
    other = msgspec.structs.replace(one, dictionary="4x4_50", position_m=(8.0, 1.0, 1.5))
    scene = msgspec.structs.replace(marked_home(), markers=[other, one])
    hits = find(Index(scene), "marker 7").hits
    assert [hit.label for hit in hits] == ["marker 7 (4x4_50)", "marker 7 (apriltag_36h11)"]
    ends = [way(Index(scene), Trip(hit.spot, Spot(what="place", id=10))).goal_m for hit in hits]
    assert ends == [other.position_m, one.position_m]
    assert [PickedMarker(marker.key).spot for marker in scene.markers] == [hit.spot for hit in hits]


def test_a_click_means_what_it_meets_first() -> None:
    """Of a marker, a place's dot and the ground in one line of sight, the nearest: the others are behind it."""
    place = home().positions_m[2]  # place 12, at (2, 1)
    marker = marked_home().markers[0]

    def clicked(marker_m, eye, **seen):
        scene = home(markers=[msgspec.structs.replace(marker, position_m=tuple(map(float, marker_m)))])
        eye = np.array(eye, float)
        return pick(scene, footprints(scene), eye, place - eye, **({"dots": True, "markers": True} | seen))

    eye = place + np.array((-3.0, 0.0, 2.0))
    beyond, before = place + np.array((0.3, 0.0, -0.2)), place + np.array((-0.3, 0.0, 0.2))
    assert clicked(beyond, eye).spot == Spot(what="place", id=12)
    assert clicked(before, eye).spot.what == "marker"
    assert clicked(beyond, eye, dots=False).spot.what == "marker"
    assert clicked(place + np.array((6.0, 0.0, -4.0)), eye, dots=False).spot == Spot(what="region", id=3), (
        "under the floor"
    )
    assert clicked(place * (1, 1, 0), place + np.array((0, 0, 5)), dots=False).spot.what == "marker", (
        "it lies on the floor"
    )


def test_a_dot_of_the_storey_below_is_not_clicked_through_the_floor() -> None:
    scene = two_floors()
    eye, place = np.array((2.0, 1.0, 9.0)), scene.positions_m[2]
    below = msgspec.structs.replace(scene, positions_m=scene.positions_m.copy())
    below.positions_m[2] = place + np.array((0.5, 0.4, 0.0))
    picked = pick(below, footprints(scene), eye, below.positions_m[2] - eye, dots=True)
    assert picked is not None and not picked.itself and picked.region != 3

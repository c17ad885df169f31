"""Levels of the merged map: storeys, floors and buildings of its geometry, zones of a robot's prior, ids that last."""

import json

import msgspec
import numpy as np
import pytest

from prior_sg.deploy.evaluation.priors import library_prior
from prior_sg.deploy.fleet.core.finding.frames import level
from prior_sg.deploy.fleet.core.ids import Name
from prior_sg.deploy.fleet.core.levels import in_force, names_levels
from prior_sg.deploy.fleet.core.merging import Memory, Source, levelled, merged
from prior_sg.deploy.showing.dsg import save_spark_dsg
from prior_sg.deploy.showing.dsg_reading import load_spark_dsg
from prior_sg.deploy.showing.export import scene_json
from prior_sg.deploy.showing.scene_reading import scene_of_json
from prior_sg.deploy.viewing.drawing import Painter
from prior_sg.schemas.levels import LevelNode, regions_in
from prior_sg.services.geometry import inverse
from prior_sg.services.segmenter.core.layers.layer_map import LayerMap
from tests.help import houses

ONE, TWO = Name("r1", 0), Name("r2", 0)
MOVED = level(2.3, np.array((12.0, -7.0, 0.4)))
PRIOR = library_prior("residential home", "find the rooms; which part of the home are they in?", houses.LABELS)
HALLWAY = [room for room in houses.ROOMS if room[0] == "hallway"]


def below_and_above():
    """The first robot sees the ground floor and the hallway above, the second what is above."""
    first = houses.tall(above=HALLWAY)
    second = houses.tall("r2", MOVED, below=HALLWAY)
    return [Source(ONE, first, np.eye(4)), Source(TWO, second, inverse(MOVED))]


def found(sources, memory, prior=None):
    return levelled(merged("home", sources, memory), memory, prior).scene


def by_label(scene, name):
    return {node.label: node for node in scene.nodes if node.level == name}


def test_no_region_spans_storeys_and_each_storey_is_a_floor():
    scene = found(below_and_above(), Memory())
    floors, buildings = by_label(scene, "floor"), by_label(scene, "building")
    assert set(floors) == {"floor 0", "floor 1"} and list(buildings) == ["building"]
    assert sum(region.label == "hallway" for region in scene.regions) == 2  # though an edge leads from one to the other
    on = regions_in(scene.nodes, "floor")
    upstairs = {number: height_m > houses.STOREY_M for number, height_m in _heights_m(scene).items()}
    assert {number: node == floors["floor 1"].id for number, node in on.items()} == upstairs
    assert {*floors["floor 0"].member_ids, *floors["floor 1"].member_ids} == {region.id for region in scene.regions}
    assert {floor.parent_id for floor in floors.values()} == {buildings["building"].id}


def _heights_m(scene):
    """Of the lowest place of each region."""
    return {r.id: float(scene.positions_m[scene.place_regions == r.id, 2].min()) for r in scene.regions}


def test_maps_that_no_way_joins_are_one_building_where_they_stand_upon_each_other():
    first, second = houses.tall(above=[]), houses.tall("r2", MOVED, below=[])
    scene = found([Source(ONE, first, np.eye(4)), Source(TWO, second, inverse(MOVED))], Memory())
    up = np.isin(scene.edges, scene.place_ids[scene.positions_m[:, 2] > houses.STOREY_M])
    assert (up[:, 0] == up[:, 1]).all()
    assert set(by_label(scene, "floor")) == {"floor 0", "floor 1"} and len(by_label(scene, "building")) == 1


def test_zones_follow_the_prior_and_regions_name_theirs():
    memory = Memory()
    assert not by_label(found(below_and_above(), memory), "zone")
    scene = found(below_and_above(), memory, PRIOR)
    zones = by_label(scene, "zone")
    assert {"living quarters", "sleeping quarters"} <= set(zones)
    held = {region.id: region for region in scene.regions}
    for label, zone in zones.items():
        assert {held[number].parent for number in zone.member_ids} == {label}
    living = {held[number].label for number in zones["living quarters"].member_ids}
    assert {"kitchen", "living room"} <= living and "bedroom" not in living


def test_a_label_that_the_prior_does_not_know_says_nothing_of_zones():
    known = {region.name: row for region, row in zip(PRIOR.regions, PRIOR.levels_above[0].parents, strict=True)}
    zones = in_force(PRIOR, ["bedroom", "kitchen", "vault"])["zone"].prior
    assert np.array_equal(zones.parents[:2], [known["bedroom"], known["kitchen"]])
    assert zones.parents[2] == pytest.approx([entry.existence for entry in zones.entries])
    assert in_force(None, houses.LABELS) == {}


def test_ids_last_when_a_robot_leaves_and_comes_back():
    memory, sources = Memory(), below_and_above()
    before = found(sources, memory, PRIOR)
    alone = found(sources[:1], memory, PRIOR)
    assert by_label(alone, "floor")["floor 0"].id == by_label(before, "floor")["floor 0"].id
    swapped = found(sources[1:], memory, PRIOR)  # of what the second robot sees, most is above
    assert by_label(before, "floor")["floor 1"].id in {node.id for node in swapped.nodes if node.level == "floor"}
    back = found(sources, memory, PRIOR)
    assert [(node.level, node.id, node.label) for node in back.nodes] == [
        (node.level, node.id, node.label) for node in before.nodes
    ]


def test_levels_are_found_again_only_where_a_region_has_changed(monkeypatch):
    asked = []
    renew = LayerMap.renew

    def counted(self, *ground, changed, **others):
        asked.append(changed)
        renew(self, *ground, changed=changed, **others)

    monkeypatch.setattr(LayerMap, "renew", counted)
    memory, sources = Memory(), below_and_above()
    scene = found(sources, memory, PRIOR)
    assert found(sources, memory, PRIOR).nodes == scene.nodes and asked == [None]
    first = sources[0].scene
    bedroom = next(region.id for region in first.regions if region.label == "bedroom")
    other = first.posteriors.copy()  # the region is described as before, but its next likely label is another
    for label, value in (("bathroom", 0.03), ("kitchen", 0.01)):
        other[first.place_regions == bedroom, houses.LABELS.index(label)] = value
    sources[0] = sources[0]._replace(scene=msgspec.structs.replace(first, posteriors=other))
    again = found(sources, memory, PRIOR)
    (changed,) = asked[1:]
    assert {region.label for region in again.regions if region.id in changed} == {"bedroom"}
    assert again.nodes == found(sources, Memory(), PRIOR).nodes  # as when all of it is found at once


def test_files_and_the_page_know_the_levels_of_a_merged_map(tmp_path):
    scene = found(below_and_above(), Memory(), PRIOR)
    told = json.loads(json.dumps(scene_json(scene)))
    assert [level["label"] for level in told["levels"] if level["level"] == "floor"] == ["floor 0", "floor 1"]
    assert scene_of_json(told).nodes == scene.nodes
    save_spark_dsg(scene, tmp_path / "dsg.json")
    assert load_spark_dsg(tmp_path / "dsg.json").nodes == scene.nodes
    drawn = Painter().draw(scene)
    assert {f"/floors/{node.id}/name" for node in scene.nodes if node.level == "floor"} <= drawn.keys()


@pytest.mark.parametrize(
    ("level", "label", "named"),
    [
        ("floor", "floor 0", False),
        ("building", "building", False),
        ("building", "outdoors", True),
        ("zone", "ward", True),
        ("district", "old town", True),
    ],
)
def test_a_map_tells_whether_its_prior_names_levels(level, label, named):
    assert names_levels([LevelNode(level=level, id=0, label=label, probability=1.0, member_ids=[0])]) is named
    assert not names_levels([])

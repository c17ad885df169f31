"""What `prior-sg bench merge` counts, on small houses."""

from pathlib import Path

import msgspec
import numpy as np
import pytest

from prior_sg.deploy.benches import main, merge
from prior_sg.deploy.evaluation.errors import EvaluationError
from prior_sg.deploy.evaluation.levels import TASKS
from prior_sg.deploy.evaluation.partial_walks import PartialMap, drifting, moved
from prior_sg.deploy.evaluation.priors import library_prior
from prior_sg.deploy.fleet.core.finding.frames import level
from prior_sg.deploy.fleet.core.finding.matching import map_of
from prior_sg.deploy.truth import GroundTruth, TrueNode, TrueRegion
from prior_sg.schemas.places import VoxelMap
from prior_sg.services.geometry import inverse
from tests.help import houses

MOVED = level(2.3, np.array((12.0, -7.0, 0.4)))
OTHER = [("kitchen", 0, 0, 4.2, 3), ("hallway", 4.2, 0, 5.6, 6), ("bedroom", 0, 3, 4.2, 6), ("bathroom", 5.6, 0, 8, 6)]


def two(seed, first, second, pose=MOVED):
    parts = PartialMap(first, np.eye(4), None), PartialMap(second, pose, None)
    return merge.Two(seed, (map_of(first), map_of(second)), parts)


@pytest.fixture(scope="module")
def house():
    return two(1, houses.scene(rooms=houses.ROOMS[:4]), houses.scene("r2", MOVED, rooms=houses.ROOMS[1:]))


def test_right_answers_are_right_and_wrong_ones_wrong(house):
    outcome = merge.outcome_of(house)
    assert outcome.right and outcome.gap_m < 0.1
    lying = two(1, house.parts[0].scene, house.parts[1].scene, level(0.3, np.zeros(3)) @ MOVED)
    wrong = merge.outcome_of(lying)
    assert wrong.found is not None and not wrong.right
    figures = merge.figures([outcome, wrong])
    assert figures["success"] == 0.5 and figures["wrong_transforms"] == 1
    assert sum(figures[name] for name in figures if name.startswith("homes_overlap")) == 2


def test_another_home_counts_as_tried_and_one_home_under_two_names_as_false(house):
    things = [("stove", 3.5, 0.4), ("bed", 1.0, 5.2), ("toilet", 7.5, 5.5)]
    another = houses.scene("r2", rooms=OTHER, things=things)
    different = two(2, another, another, np.eye(4))
    assert merge.false_accepts([house, different], 10) == (4, [])
    tried, accepted = merge.false_accepts([house, house], 10)
    assert tried == 4 and set(accepted) == {(1, 1)}


def test_the_next_day_keeps_numbers(house):
    figures = merge.resumed([merge.outcome_of(house)])
    assert figures["resumed_regions_kept"] == 1.0 and figures["resumed_objects_kept"] == 1.0
    assert figures["resumed_wrong_changes_per_home"] == 0.0


def test_walks_are_moved_and_drift():
    rng = np.random.default_rng(0)
    pose = moved(rng)
    assert pose[:3, :3] @ pose[:3, :3].T == pytest.approx(np.eye(3)) and pose[2, 2] > np.cos(np.radians(1.5))
    told = drifting([pose] * 50, rng)
    gaps_m = [np.linalg.norm((inverse(pose) @ one)[:3, 3]) for one in told]
    assert 0.01 < max(gaps_m) < 0.4


class Walks:
    """A whole walk that takes the bathroom for a kitchen; with drift, for a hallway, and the bedroom, too."""

    def part(self, seed, part):
        wrong = {4: "kitchen"} if part == merge.FULL else {3: "hallway", 4: "hallway"}
        scene = houses.scene()
        regions = [msgspec.structs.replace(one, label=wrong.get(one.id, one.label)) for one in scene.regions]
        x, y = np.meshgrid(np.arange(40), np.arange(45))
        free = np.column_stack((x.ravel(), y.ravel(), np.full(x.size, 4))).astype(np.int16)
        voxels = VoxelMap(robot="r1", voxel_m=0.2, free=free, occupied=free[:0])
        return PartialMap(msgspec.structs.replace(scene, regions=regions), np.eye(4), voxels)

    def prior(self, seed):
        return library_prior("residential home", TASKS["house"], houses.LABELS)

    def truth(self, seed):
        corners = [((x0, y0), (x1, y0), (x1, y1), (x0, y1)) for _, x0, y0, x1, y1 in houses.ROOMS]
        rooms = zip(houses.ROOMS, corners, strict=True)
        regions = [TrueRegion(n, room[0], np.array(polygon), 0.0, 2.0) for n, (room, polygon) in enumerate(rooms)]
        floor = TrueNode("floor", "floor 0", tuple(range(len(regions))))
        living = tuple(n for n, room in enumerate(houses.ROOMS) if room[0] in ("kitchen", "living room"))
        return GroundTruth(tuple(regions), (TrueNode("zone", "living quarters", living), floor))


def test_a_merged_map_is_judged_beside_whole_walks_and_where_each_part_was(house):
    scores = merge.worth(Walks(), merge.outcome_of(house))
    assert scores["f1_s_merged"] == pytest.approx(1.0, abs=0.02)
    assert scores["f1_s_full"] == pytest.approx(0.8, abs=0.03) and scores["f1_s_full_drifting"] < 0.7
    assert scores["f1_s_where_a_part_was_part"] == pytest.approx(1.0, abs=0.02)
    assert 0.7 < scores["f1_s_where_a_part_was_full"] < 0.95
    assert scores["f1_s_floor_merged"] == pytest.approx(1.0, abs=0.02) and scores["f1_s_floor_full"] == 0.0
    assert scores["f1_s_zone_merged"] > 0.9 and scores["f1_g_zone_merged"] >= scores["f1_s_zone_merged"]
    worse = {name: value - 0.1 if name == "f1_s_merged" else value for name, value in scores.items()}
    found = merge.means([scores, worse])
    assert found["gain_on_full"] == pytest.approx(scores["f1_s_merged"] - scores["f1_s_full"] - 0.05)
    assert found["gain_floor_on_full"] == pytest.approx(scores["f1_s_floor_merged"])
    assert found["gain_on_full_sem"] == pytest.approx(0.05) and found["gain_on_part_sem"] == pytest.approx(0.0)


def test_worlds_are_of_one_kind():
    with pytest.raises(EvaluationError, match="one kind"):
        main.merge(main.Asked(paths=[Path("world:home:80"), Path("world:office:1-2")]))

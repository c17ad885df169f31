"""Merged scenes: numbers that last, places and objects that are one, beliefs that settle conflicts."""

from types import SimpleNamespace

import msgspec
import numpy as np
import pytest

from prior_sg.deploy.fleet.core.finding.frames import level
from prior_sg.deploy.fleet.core.fusing import Placed, fused, lens_m
from prior_sg.deploy.fleet.core.ids import Ids, Name
from prior_sg.deploy.fleet.core.merging import Memory, Source, merged
from prior_sg.deploy.fleet.core.sessions import Present, remembered, said
from prior_sg.schemas.members import MapMember
from prior_sg.services.geometry import inverse
from tests.help import houses

ONE, TWO = Name("r1", 0), Name("r2", 0)
MOVED = level(2.3, np.array((12.0, -7.0, 0.4)))


def both(memory=None, **changes):
    """Two robots' maps of one house that overlap in hallway and bedroom."""
    first = houses.scene(rooms=houses.ROOMS[:4])
    second = houses.scene("r2", MOVED, rooms=houses.ROOMS[2:], **changes)
    sources = [Source(ONE, first, np.eye(4)), Source(TWO, second, inverse(MOVED))]
    return merged("home", sources, memory or Memory()), first, second


def test_numbers_are_given_once():
    ids = Ids()
    assert ids.of("place", ONE, [7, 9]).tolist() == [0, 1]
    assert ids.of("place", TWO, [7]).tolist() == [2]
    assert ids.of("place", ONE, [9, 8]).tolist() == [1, 3]
    assert ids.of("object", ONE, [7]).tolist() == [0]
    ids.adopt("object", TWO, 4, 6)
    assert ids.of("object", TWO, [4, 5]).tolist() == [6, 7]


def test_what_both_saw_is_there_once():
    found, first, second = both()
    scene = found.scene
    shared = int((second.place_regions < 2).sum()) - 1  # the bathroom's doorway counts to the hallway
    assert len(scene.place_ids) == len(first.place_ids) + len(second.place_ids) - shared
    assert sorted(item.label for item in scene.objects) == sorted(thing[0] for thing in houses.THINGS)
    assert sorted(region.label for region in scene.regions) == houses.LABELS
    assert len(np.unique(scene.edges, axis=0)) == len(scene.edges) and np.isin(scene.edges, scene.place_ids).all()
    bedroom = next(region for region in scene.regions if region.label == "bedroom")
    assert bedroom.members == [MapMember(robot="r1", id=3), MapMember(robot="r2", id=1)]
    bed = next(item for item in scene.objects if item.label == "bed")
    beds = [next(item.id for item in one.objects if item.label == "bed") for one in (first, second)]
    assert bed.members == [MapMember(robot=robot, id=own) for robot, own in zip(("r1", "r2"), beds, strict=True)]


def aimed(robot, pose, task):
    """A map that follows a task; of an empty one, none and no prior."""
    aim = {"task": task, "environment": "home" if task else "", "prior_digest": task}
    return msgspec.structs.replace(houses.scene(robot, pose), **aim)


@pytest.mark.parametrize(
    ("tasks", "told"),
    [
        (("tidy up", "tidy up"), "tidy up"),
        (("tidy up", "serve drinks"), "tidy up (r1); serve drinks (r2)"),
        (("tidy up", ""), "tidy up"),
        (("", "serve drinks"), "serve drinks"),
        (("", ""), ""),
    ],
)
def test_a_merged_map_has_the_tasks_of_its_robots(tasks, told):
    first, second = aimed("r1", np.eye(4), tasks[0]), aimed("r2", MOVED, tasks[1])
    scene = merged("home", [Source(ONE, first, np.eye(4)), Source(TWO, second, inverse(MOVED))], Memory()).scene
    assert scene.task == told
    assert scene.environment == ("home" if told else "") and bool(scene.prior_digest) == bool(told)


def test_of_two_sessions_of_a_robot_the_present_ones_task_counts_whatever_its_stamps():
    former, now = aimed("r1", np.eye(4), "tidy up"), aimed("r1", MOVED, "serve drinks")
    former = msgspec.structs.replace(former, stamp_ns=now.stamp_ns + 1)
    sources = [Source(Name("r1", 1), now, inverse(MOVED)), Source(ONE, former, np.eye(4))]
    scene = merged("home", sources, Memory()).scene
    assert scene.task == "serve drinks"


def test_every_region_of_a_robot_is_in_one_and_every_merged_one_has_members():
    """Also where a robot's region has only two places, or two of them share a merged one."""
    first, second = houses.scene(), houses.scene("r2", MOVED)
    kitchen = np.flatnonzero(second.place_regions == 0)
    split = second.place_regions.copy()
    split[kitchen[:2]] = 8  # beside others that stay
    split[kitchen[2:12]] = 9
    regions = [*second.regions, *(msgspec.structs.replace(second.regions[0], id=number) for number in (8, 9))]
    second = msgspec.structs.replace(second, place_regions=split, regions=regions)
    scene = merged("home", [Source(ONE, first, np.eye(4)), Source(TWO, second, inverse(MOVED))], Memory()).scene
    assert sorted(region.label for region in scene.regions) == houses.LABELS
    kitchen = next(region for region in scene.regions if region.label == "kitchen")
    assert [(one.robot, one.id) for one in kitchen.members] == [("r1", 0), ("r2", 0), ("r2", 8), ("r2", 9)]
    held = {(one.robot, one.id) for region in scene.regions for one in region.members}
    assert held == {("r1", region.id) for region in first.regions} | {("r2", region.id) for region in regions}


def test_a_region_that_only_touches_another_by_a_place_is_no_member_of_it():
    found, first, second = both()
    hallway = next(region for region in found.scene.regions if region.label == "hallway")
    stray = first.place_regions.copy()
    stray[np.flatnonzero(stray == 2)[:2]] = 3  # two places of the hallway are the bedroom's, the first robot says
    first = msgspec.structs.replace(first, place_regions=stray)
    sources = [Source(ONE, first, np.eye(4)), Source(TWO, second, inverse(MOVED))]
    again = next(r for r in merged("home", sources, Memory()).scene.regions if r.label == "hallway")
    assert again.place_count == hallway.place_count and again.members == hallway.members


def test_what_lies_apart_stays_connected():
    """Places of the second map that the first has not seen are reached through those that are one."""
    scene = both()[0].scene
    rows = np.searchsorted(scene.place_ids, scene.edges)
    reached, waiting = {0}, [0]
    while waiting:
        here = waiting.pop()
        for other in rows[(rows == here).any(axis=1)].ravel().tolist():
            if other not in reached:
                reached.add(other)
                waiting.append(other)
    assert len(reached) == len(scene.place_ids)


def test_numbers_stay_when_a_frame_is_corrected_or_a_robot_leaves():
    memory = Memory()
    found, first, second = both(memory)
    before = {region.label: region.id for region in found.scene.regions}
    off = level(0.0, np.array((0.1, 0.05, 0.0))) @ inverse(MOVED)
    again = merged("home", [Source(ONE, first, np.eye(4)), Source(TWO, second, off)], memory).scene
    assert {region.label: region.id for region in again.regions} == before
    alone = merged("home", [Source(TWO, second, inverse(MOVED))], memory).scene
    assert set(alone.place_ids.tolist()) & set(found.scene.place_ids.tolist())
    assert {region.label: region.id for region in alone.regions if region.label == "bathroom"} == {
        "bathroom": before["bathroom"]
    }
    back = merged("home", [Source(ONE, first, np.eye(4)), Source(TWO, second, inverse(MOVED))], memory).scene
    assert back.place_ids.tolist() == found.scene.place_ids.tolist()


def test_the_surer_robot_names_the_room():
    first = houses.scene(rooms=houses.ROOMS[:4])
    second = houses.scene("r2", MOVED, rooms=houses.ROOMS[2:])
    bedroom = second.place_regions == 1
    wrong = second.posteriors.copy()
    wrong[bedroom] = 0.15
    wrong[bedroom, houses.LABELS.index("kitchen")] = 0.4
    regions = [msgspec.structs.replace(r, label="kitchen") if r.id == 1 else r for r in second.regions]
    second = msgspec.structs.replace(second, posteriors=wrong, regions=regions)
    sources = [Source(TWO, second, np.eye(4)), Source(ONE, first, MOVED)]
    scene = merged("home", sources, Memory()).scene
    assert sorted(region.label for region in scene.regions) == houses.LABELS


def test_two_looks_at_the_same_are_no_two_witnesses():
    """A map merged with itself is believed as firmly as it was, under the same labels."""
    one = houses.scene()
    alone = merged("home", [Source(ONE, one, np.eye(4))], Memory()).scene
    twice = merged("home", [Source(ONE, one, np.eye(4)), Source(TWO, one, np.eye(4))], Memory()).scene
    assert twice.posteriors == pytest.approx(alone.posteriors, abs=0.01)
    assert twice.place_regions.tolist() == alone.place_regions.tolist()


def test_who_has_hardly_looked_has_hardly_a_say():
    first, second = houses.scene(), houses.scene("r2", MOVED)
    bedroom = second.place_regions == 3
    posteriors, unknown = second.posteriors.copy(), second.unknown.copy()
    posteriors[bedroom] = 0.001
    posteriors[bedroom, houses.LABELS.index("kitchen")] = 0.99
    regions = [msgspec.structs.replace(r, label="kitchen") if r.id == 3 else r for r in second.regions]
    unknown[bedroom] = 0.95

    def bedrooms(unknown):
        lying = msgspec.structs.replace(second, posteriors=posteriors, regions=regions, unknown=unknown)
        sources = [Source(TWO, lying, inverse(MOVED)), Source(ONE, first, np.eye(4))]
        return [r for r in merged("home", sources, Memory()).scene.regions if r.label == "bedroom"]

    assert bedrooms(unknown) and not bedrooms(second.unknown)


def test_a_few_places_that_waver_are_no_region():
    """Where no robot has a region of its own for good reason, the merged map has none either."""
    first, second = houses.scene(), houses.scene("r2", MOVED)
    inside = np.linalg.norm(first.positions_m[:, :2] - np.array((5.5, 2.0)), axis=1) < 0.6
    posteriors = first.posteriors.copy()
    posteriors[inside] = 0.15
    posteriors[inside, houses.LABELS.index("bathroom")] = 0.4
    wavering = np.where(inside, 9, first.place_regions)
    regions = [*first.regions, msgspec.structs.replace(first.regions[4], id=9)]
    first = msgspec.structs.replace(first, posteriors=posteriors, place_regions=wavering, regions=regions)
    second = msgspec.structs.replace(second, posteriors=posteriors, place_regions=wavering, regions=regions)
    scene = merged("home", [Source(ONE, first, np.eye(4)), Source(TWO, second, inverse(MOVED))], Memory()).scene
    assert inside.sum() > 3 and sorted(region.label for region in scene.regions) == houses.LABELS


def test_openings_that_another_map_closes_are_none():
    first = houses.scene(rooms=houses.ROOMS[:1])
    spot = int(np.argmax(first.positions_m[:, 1]))
    fields = {
        "frontier_ids": np.array([0, spot]),
        "frontier_directions": np.array([(-1.0, 0, 0), (0, 1.0, 0)], np.float32),
        "frontier_areas_m2": np.array([1.0, 1.0], np.float32),
    }
    first = msgspec.structs.replace(first, **fields)
    second = houses.scene("r2", rooms=houses.ROOMS[:1])
    alone = merged("home", [Source(ONE, first, np.eye(4))], Memory()).scene
    assert alone.frontier_ids.tolist() == [0, spot]
    moved = level(0.0, np.array((0.0, 1.0, 0.0)))  # the other's kitchen reaches a metre farther
    scene = merged("home", [Source(ONE, first, np.eye(4)), Source(TWO, second, moved)], Memory()).scene
    assert scene.frontier_ids.tolist() == [0]


def test_the_circle_in_which_balls_meet():
    gaps, one, other = np.array([1.0, 3.0, 0.2]), np.array([1.0, 1.0, 1.0]), np.array([1.0, 1.0, 0.5])
    assert lens_m(gaps, one, other) == pytest.approx([np.sqrt(0.75), 0.0, 0.5])


def test_a_former_session_is_forgotten_where_it_is_seen_otherwise():
    former = houses.scene()
    things = [thing if thing[0] != "sofa" else ("sofa", 2.9, 8.2) for thing in houses.THINGS if thing[0] != "table"]
    things = [thing for thing in things if thing[0] != "plant"] + [("plant", 7.5, 3.6)]
    now = houses.scene("r1", MOVED, things=things)
    kept, changes = remembered(former, MOVED, [Present(now, np.eye(4))])
    labels = {change.label: change for change in changes}
    assert set(labels) == {"table", "sofa"} and labels["table"].to_m is None
    scene = merged("home", [Source(Name("r1", 1), now, inverse(MOVED)), Source(ONE, kept, np.eye(4))], Memory()).scene
    unmoved = [change._replace(from_m=_back(change.from_m), to_m=_back(change.to_m)) for change in changes]
    assert sorted(said(change, scene) for change in unmoved) == [
        "sofa moved from living room to bedroom",
        "table is gone from kitchen",
    ]
    assert sorted(item.label for item in scene.objects) == sorted(thing[0] for thing in things)


def _back(spot_m):
    return None if spot_m is None else (inverse(MOVED) @ np.append(spot_m, 1.0))[:3]


def test_what_is_not_seen_again_is_remembered():
    former, now = houses.scene(), houses.scene("r1", rooms=houses.ROOMS[:2])
    kept, changes = remembered(former, np.eye(4), [Present(now, np.eye(4))])
    assert not changes and len(kept.objects) == len(former.objects)
    assert np.isin(former.place_ids[former.place_regions >= 2], kept.place_ids).all()


def test_balls_that_meet_in_a_slab_are_not_joined():
    none = np.zeros((0, 2), np.int64)

    def joined(rise_m, away_m):
        """Whether a place of each of two maps, so far apart, are joined."""
        maps = []
        for number, center_m in enumerate(((0.0, 0.0, 1.2), (away_m, 0.0, 1.2 + rise_m))):
            scene = SimpleNamespace(
                place_ids=np.array([number]),
                positions_m=np.array([center_m]),
                radii_m=np.ones(1),
                basis_points=np.full(1, 2),
                edges=none,
                clearances_m=np.zeros(0),
            )
            maps.append(Placed(Name(f"r{number}", 0), scene, np.eye(4), scene.place_ids))
        return len(fused(maps).edges) == 1

    assert joined(0.1, 1.5) and joined(0.9, 1.2)  # side by side, and up some steps
    assert not joined(1.7, 0.0)

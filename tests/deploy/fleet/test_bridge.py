"""The bridge beside the store: several robots' deltas become those of one map, which the store keeps as any robot's."""

import asyncio
import json
from pathlib import Path

import msgspec
import numpy as np
import pytest

from prior_sg.deploy.cli.fleet import transforms_of
from prior_sg.deploy.cli.main import main
from prior_sg.deploy.errors import UserError
from prior_sg.deploy.evaluation.priors import library_prior
from prior_sg.deploy.fleet.bridge import KEEP_NUMBERS, SERVICE
from prior_sg.deploy.fleet.core.finding.frames import level
from prior_sg.deploy.fleet.core.ids import Name
from prior_sg.deploy.fleet.core.update import ASK_TICKS, MOST_FORMER, Config, KeepNumbers, NumbersKept
from prior_sg.deploy.fleet.keeping import keep
from prior_sg.deploy.showing.export import scene_json
from prior_sg.schemas.levels import LevelNode
from prior_sg.schemas.members import MapMember
from prior_sg.schemas.places import PlaceDelta, SnapshotRequest
from prior_sg.schemas.priors import PriorList
from prior_sg.schemas.queries import ById, ByLabel, NodesOf, SceneQuery, Spot, WhereToLook
from prior_sg.schemas.regions import RegionDelta
from prior_sg.schemas.scene import SceneRequest
from prior_sg.schemas.status import Tick
from prior_sg.schemas.topics import (
    OBJECT_SNAPSHOT,
    PLACE_SNAPSHOT,
    PRIORS,
    REGION_SNAPSHOT,
    SCENE,
    SCENE_QUERY,
    topic_of,
)
from prior_sg.services.refusals import InputRefused
from prior_sg.services.registry import BY_NAME
from prior_sg.services.runtime.runner import Pipeline, Runner
from prior_sg.services.runtime.service import Identity, ServiceError
from prior_sg.services.scene_store.core.config import Config as StoreConfig
from tests.help import houses

MOVED = level(2.3, np.array((12.0, -7.0, 0.4)))
CFG = Config(robots=("r1", "r2"))
TICK = Tick(stamp_ns=10**18)


class Fleet:
    """A bridge and a store, joined as on a bus."""

    def __init__(self, cfg=CFG, epoch=5, store=StoreConfig(path=":memory:")):
        self.kept = []
        answers = {KEEP_NUMBERS: self.keep}
        self.bridge = Runner(SERVICE, cfg, Identity("home", "fleet", epoch), answers, wire=True)
        self.store = Runner(BY_NAME["scene_store"], store, Identity("*", "store", 1), wire=True)
        self.pipeline = Pipeline((self.bridge, self.store))

    def keep(self, request):
        self.kept.append(request.content)
        return NumbersKept(robot=request.robot)

    def tell(self, scene, epoch=1):
        for delta in houses.deltas(scene, epoch):
            self.pipeline.publish(topic_of(type(delta)), delta)

    def tick(self):
        return [message for _, message in self.pipeline.feed(self.bridge, TICK)]

    def scene(self, robot="home", revision=None):
        return self.store.answer(SCENE, SceneRequest(robot=robot, revision=revision))


def first(**changes):
    return houses.scene(rooms=houses.ROOMS[:4], **changes)


def second(**changes):
    return houses.scene("r2", MOVED, rooms=houses.ROOMS[1:], **changes)


def test_whose_map_it_will_be_is_told_before_anything_is_in_it_and_nothing_stored_is_lost(tmp_path):
    store = StoreConfig(path=str(tmp_path / "scene.sqlite"))
    fleet = Fleet(store=store)
    fleet.tick()
    assert fleet.scene().merged_of == ["r1", "r2"] and not len(fleet.scene().place_ids)
    fleet.tell(first())
    fleet.tick()
    known = fleet.scene()
    assert len(known.place_ids) and known.merged_of == ["r1", "r2"]
    fleet.store.close()
    again = Fleet(epoch=6, store=store)
    again.tick()
    assert again.scene().place_ids.tolist() == known.place_ids.tolist() and again.scene().merged_of == ["r1", "r2"]


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["r1", "--as", "r1"], "r1 is one of the robots: give the merged map another name"),
        (["r1", "r2", "r1", "--as", "home"], "r1 is named twice: name each robot once"),
        (["r1", "--as", "my/home"], "holds '/'"),
    ],
)
def test_what_cannot_be_merged_is_said_before_a_router_is_looked_for(words, says, capsys):
    assert main(["fleet", *words]) == 2
    assert says in " ".join(capsys.readouterr().err.split())


def test_another_task_of_a_robot_is_told_though_its_regions_stay():
    fleet = Fleet()
    fleet.tell(msgspec.structs.replace(first(), task="tidy up"))
    fleet.tick()
    assert fleet.scene().task == "tidy up"
    (now,) = (one for one in houses.deltas(first()) if isinstance(one, RegionDelta))
    now = msgspec.structs.replace(now, revision=1, task="serve drinks")
    fleet.pipeline.publish(topic_of(RegionDelta), now)
    fleet.tick()
    assert fleet.scene().task == "serve drinks"


def test_two_robots_make_one_map():
    fleet = Fleet()
    fleet.tell(first())
    fleet.tick()
    assert sorted(region.label for region in fleet.scene().regions) == sorted(room[0] for room in houses.ROOMS[:4])
    before = {region.label: region.id for region in fleet.scene().regions}
    fleet.tell(second())
    told = fleet.tick()
    assert "r2 has been found in the map of home" in next(m for m in told if isinstance(m, PlaceDelta)).event
    scene = fleet.scene()
    assert sorted(region.label for region in scene.regions) == houses.LABELS
    after = {region.label: region.id for region in scene.regions}
    assert {label: after[label] for label in before} == before
    assert len(scene.objects) == len(houses.THINGS) and len(scene.trajectory) == 2
    assert fleet.tick() == []


def test_the_store_knows_what_is_made_of_what_at_every_revision(tmp_path):
    fleet = Fleet(store=StoreConfig(path=str(tmp_path / "scene.sqlite")))
    fleet.tell(first())
    fleet.tick()
    alone = fleet.scene()
    assert [region.members for region in alone.regions] == [[MapMember(robot="r1", id=n)] for n in range(4)]
    fleet.tell(second())
    told = fleet.tick()
    fleet.store.close()
    again = Fleet(store=StoreConfig(path=str(tmp_path / "scene.sqlite")))
    scene, former = again.scene(), again.scene(revision=alone.revision)
    assert former == alone and scene.revision > alone.revision
    hallway = next(region for region in scene.regions if region.label == "hallway")
    assert hallway.members == [MapMember(robot="r1", id=2), MapMember(robot="r2", id=1)]
    assert hallway in next(m for m in told if isinstance(m, RegionDelta)).regions
    question = SceneQuery(robot="home", questions=[ById(what="region", id=hallway.id), ByLabel(label="shelf")])
    details, shelves = again.store.answer(SCENE_QUERY, question).answers
    assert details.region.members == hallway.members
    shelf = next(item for item in scene.objects if item.id == shelves.things[0].id)
    owners = [(one.robot, again.scene(one.robot).objects[one.id].label) for one in shelf.members]
    assert owners == [("r1", "shelf"), ("r2", "shelf")]


def test_the_store_holds_what_snapshots_say():
    fleet = Fleet()
    fleet.tell(first())
    fleet.tell(second())
    fleet.tick()
    late = Runner(BY_NAME["scene_store"], StoreConfig(path=":memory:"), Identity("*", "late", 1), wire=True)
    request = SnapshotRequest(robot="home")
    late.feed(*(fleet.bridge.answer(q, request) for q in (PLACE_SNAPSHOT, REGION_SNAPSHOT, OBJECT_SNAPSHOT)))
    told = late.answer(SCENE, SceneRequest(robot="home"))
    assert told.unnumbered() == fleet.scene().unnumbered()


def test_robots_are_not_found_where_they_are_not():
    fleet = Fleet()
    fleet.tell(first())
    fleet.tick()
    alone = fleet.scene()
    rooms = [("kitchen", 0, 0, 4.2, 3), ("hallway", 4.2, 0, 5.6, 6), ("bedroom", 0, 3, 4.2, 6)]
    fleet.tell(houses.scene("r2", MOVED, rooms=rooms, things=[("bed", 1.0, 5.2), ("stove", 3.0, 1.0)]))
    fleet.tick()
    assert fleet.scene().place_ids.tolist() == alone.place_ids.tolist()
    assert SERVICE.figures(fleet.bridge.state) == {"maps": 2, "maps_related": 1}


def test_frames_that_are_given_need_nothing_in_common():
    x, y, z = (-(MOVED[:3, :3].T @ MOVED[:3, 3])).tolist()
    cfg = msgspec.structs.replace(CFG, transforms={"r1": (0.0, 0.0, 0.0, 0.0), "r2": (x, y, z, -2.3)})
    fleet = Fleet(cfg)
    fleet.tell(houses.scene(rooms=houses.ROOMS[:2], things=[]))
    fleet.tell(houses.scene("r2", MOVED, rooms=houses.ROOMS[3:], things=[]))
    fleet.tick()
    scene = fleet.scene()
    assert sorted(region.label for region in scene.regions) == ["bathroom", "bedroom", "kitchen", "living room"]
    bedroom = next(region for region in scene.regions if region.label == "bedroom")
    assert bedroom.position_m[:2] == pytest.approx((2.2, 7.2), abs=0.3)


def test_a_late_loop_closure_is_followed():
    fleet = Fleet()
    fleet.tell(first())
    fleet.tell(second())
    fleet.tick()
    ids = fleet.scene().place_ids.tolist()
    shift = level(0.15, np.array((0.6, 0.3, 0.0)))
    moved = houses.scene("r2", shift @ MOVED, rooms=houses.ROOMS[1:])
    for delta in houses.deltas(moved):
        later = msgspec.structs.replace(delta, revision=1, snapshot=False)
        fleet.pipeline.publish(topic_of(type(delta)), later)
    before = fleet.scene()
    for _ in range(6):
        fleet.tick()
    after = fleet.scene()
    assert after.place_ids.tolist() == ids
    assert np.abs(after.positions_m - before.positions_m).max() < 0.1  # in the frame of home nothing has moved


def test_a_map_that_comes_to_contradict_is_taken_out():
    fleet = Fleet()
    fleet.tell(first())
    fleet.tell(second())
    fleet.tick()
    alone = Fleet()
    alone.tell(first())
    alone.tick()
    rooms = [("kitchen", 0, 0, 4.2, 3), ("hallway", 4.2, 0, 5.6, 6), ("bedroom", 0, 3, 4.2, 6)]
    other = houses.scene("r2", MOVED, rooms=rooms, things=[("bed", 1.0, 5.2), ("stove", 3.0, 1.0)])
    for delta in houses.deltas(other):
        fleet.pipeline.publish(topic_of(type(delta)), msgspec.structs.replace(delta, revision=1))
    told = [message for _ in range(6) for message in fleet.tick()]
    assert any("r2 fits no longer" in m.event for m in told if isinstance(m, PlaceDelta))
    assert fleet.scene().place_ids.tolist() == alone.scene().place_ids.tolist()


def test_a_gap_is_asked_for():
    fleet = Fleet()
    (places, *_) = houses.deltas(first())
    fleet.bridge.feed(msgspec.structs.replace(places, revision=3, snapshot=False))
    assert [ask.query for ask in fleet.bridge.asks] == [PLACE_SNAPSHOT]
    assert fleet.bridge.asks[0].request.robot == "r1"


def test_the_next_day_goes_on_with_the_same_numbers():
    fleet = Fleet(Config(robots=("r1",)))
    fleet.tell(houses.scene())
    fleet.tick()
    before = fleet.scene()
    things = [thing if thing[0] != "sofa" else ("sofa", 2.9, 8.2) for thing in houses.THINGS]
    fleet.tell(houses.scene("r1", MOVED, rooms=houses.ROOMS[1:], things=things), epoch=2)
    told = fleet.tick()
    event = next(m for m in told if isinstance(m, PlaceDelta)).event
    assert "r1 has begun a new session" in event and "sofa moved from living room to bedroom" in event
    after = fleet.scene()
    assert {r.label: r.id for r in after.regions} == {r.label: r.id for r in before.regions}
    numbers = [{i.label: i.id for i in scene.objects if i.label != "sofa"} for scene in (before, after)]
    assert numbers[0] == numbers[1]
    bedroom = next(region for region in after.regions if region.label == "bedroom")
    assert {(one.session, one.id) for one in bedroom.members} == {(0, 3), (1, 2)}
    assert len(after.place_ids) == len(before.place_ids)


def merged_and_kept(cfg):
    """Both maps made one, and what lasts of that in the file of the settings."""
    fleet = Fleet(cfg)
    fleet.tell(first())
    fleet.tell(second())
    fleet.tick()
    keep(cfg.memory, fleet.kept[-1])
    return fleet


def test_numbers_live_on_in_a_file(tmp_path):
    path = str(tmp_path / "fleet" / "home.msgpack")
    cfg = msgspec.structs.replace(CFG, memory=path)
    fleet = merged_and_kept(cfg)
    again = Fleet(cfg, epoch=6)
    again.tell(second())
    again.tell(first())
    again.tick()
    assert again.scene().place_ids.tolist() == fleet.scene().place_ids.tolist()
    assert {r.label: r.id for r in again.scene().regions} == {r.label: r.id for r in fleet.scene().regions}
    (tmp_path / "broken").write_bytes(b"no")
    with pytest.raises(ServiceError, match="holds no numbers"):
        Fleet(msgspec.structs.replace(CFG, memory=str(tmp_path / "broken")))


def test_numbers_that_cannot_be_kept_are_told_once_and_kept_when_they_can(tmp_path, caplog):
    (tmp_path / "folder").write_text("in the way")
    cfg = msgspec.structs.replace(CFG, memory=str(tmp_path / "folder" / "home.msgpack"))
    keeps = KEEP_NUMBERS.open(cfg, Identity("home", "fleet", 5))
    for content in (b"one", b"two"):
        assert asyncio.run(keeps(KeepNumbers(robot="home", content=content))) == NumbersKept(robot="home")
    assert [entry.levelname for entry in caplog.records] == ["WARNING"]
    assert "home.msgpack cannot be written (File exists)" in caplog.text
    (tmp_path / "folder").unlink()
    asyncio.run(keeps(KeepNumbers(robot="home", content=b"three")))
    assert Path(cfg.memory).read_bytes() == b"three" and len(caplog.records) == 1


def test_the_frame_lives_on_in_that_file_for_maps_that_go_on(tmp_path):
    path = str(tmp_path / "home.msgpack")
    cfg = msgspec.structs.replace(CFG, memory=path)
    fleet = merged_and_kept(cfg)
    before_m = fleet.scene().positions_m

    def gaps_m(epoch):
        again = Fleet(cfg, epoch=6)
        again.tell(second(), epoch)
        again.tick()
        return np.linalg.norm(again.scene().positions_m[:, None] - before_m, axis=2).min(axis=1)

    assert gaps_m(epoch=1).max() < 0.1  # r2 alone, in the frame that r1 gave
    assert gaps_m(epoch=2).min() > 1.0  # another writer may map from another place


def sessions_named(scene):
    """Of the members of all regions."""
    return {(one.robot, one.session) for region in scene.regions for one in region.members}


def started(cfg, *told):
    """A bridge that begins, hears scenes and the epochs of their writers, and keeps its numbers."""
    fleet = Fleet(cfg, epoch=9)
    for scene, epoch in told:
        fleet.tell(scene, epoch)
        fleet.tick()
    if fleet.kept:
        keep(cfg.memory, fleet.kept[-1])
    return fleet


@pytest.mark.parametrize("stored", [False, True])
def test_of_many_former_sessions_the_smallest_are_forgotten_but_what_was_stored_or_holds_the_frame(stored, tmp_path):
    path = tmp_path / "scene.json"
    path.write_text(json.dumps(scene_json(houses.scene(rooms=houses.ROOMS[:1]))))
    fleet = Fleet(Config(robots=("r1",), stored=(f"r1={path}",) if stored else ()))
    fleet.tell(houses.scene("r1", MOVED, rooms=houses.ROOMS[:1]))  # holds the frame, unless the stored one does
    fleet.tick()
    state, events = fleet.bridge.state, []
    for epoch in range(2, MOST_FORMER + 5):
        away = level(0.0, np.array((100.0 * epoch, 0.0, 0.0)))
        fleet.tell(houses.scene("r1", away, rooms=houses.ROOMS[: 1 if epoch == 4 else 2]), epoch)
        events += state.events
        fleet.tick()
    forgotten = [said.partition(" of r1")[0] for said in events if "is forgotten, the smallest of many" in said]
    numbers = [1, 4, 2] if stored else [3, 1]  # of equal ones, the oldest
    assert forgotten == [f"session {number}" for number in numbers]
    last = MOST_FORMER + 3 + stored
    assert [one.name.session for one in state.former] == [one for one in range(last) if one not in numbers]


def test_a_session_keeps_its_number_when_the_bridge_starts_again(tmp_path):
    cfg = Config(robots=("r1",), memory=str(tmp_path / "home.msgpack"))
    next_day = houses.scene("r1", MOVED, rooms=houses.ROOMS[1:])
    before = started(cfg, (houses.scene(), 1), (next_day, 2))
    assert sessions_named(before.scene()) == {("r1", 0), ("r1", 1)}
    elsewhere = houses.scene("r1", level(0.2, np.array((1.0, 0.5, 0.0))) @ MOVED, rooms=houses.ROOMS[1:])
    again = started(cfg, (elsewhere, 2))  # its writer has closed a loop since
    assert sessions_named(again.scene()) == {("r1", 1)}
    assert np.isin(again.scene().place_ids, before.bridge.state.memory.ids.of("place", Name("r1", 1), range(999))).all()
    third = started(cfg, (houses.scene("r1", level(0.4, np.array((50.0, 3.0, 0.0)))), 3))
    assert sessions_named(third.scene()) == {("r1", 2)}  # none of the former ones: its ids mean other places
    assert not np.isin(third.scene().place_ids, before.scene().place_ids).any()


def test_a_map_whose_writer_began_anew_while_nobody_followed_goes_on(tmp_path):
    """Its places are where they were, under their ids."""
    cfg = Config(robots=("r1",), memory=str(tmp_path / "home.msgpack"))
    before = started(cfg, (houses.scene(), 1))
    again = started(cfg, (houses.scene(), 2))
    assert sessions_named(again.scene()) == {("r1", 0)}
    assert again.scene().place_ids.tolist() == before.scene().place_ids.tolist()
    assert [r.id for r in again.scene().regions] == [r.id for r in before.scene().regions]


def test_stored_sessions_keep_their_numbers_whatever_is_stored_beside_them(tmp_path):
    paths = []
    for day, scene in enumerate((houses.scene(), houses.scene("r1", MOVED))):
        paths.append(f"r1={tmp_path / f'{day}.sqlite'}")
        with Runner(BY_NAME["scene_store"], StoreConfig(path=paths[-1][3:]), Identity("*", "store", 1)) as store:
            store.feed(*houses.deltas(scene))
    cfg = Config(robots=("r1",), memory=str(tmp_path / "home.msgpack"), stored=(paths[1],))
    now = houses.scene("r1", level(0.7, np.array((3.0, 30.0, 0.0))))

    def numbers(fleet):
        return [one.name.session for one in fleet.bridge.state.members()]

    assert numbers(started(cfg, (now, 7))) == [1, 0]
    both = msgspec.structs.replace(cfg, stored=(paths[0], paths[1]))
    assert numbers(started(both, (now, 7))) == [1, 0, 2]  # the present one, then the newest of those that are stored
    # A stored map under which the robot goes on is followed once: what is told live is then another session.
    assert numbers(started(cfg, (houses.scene("r1", MOVED), 8))) == [3, 0]


def test_files_from_before_sessions_and_levels_were_kept_are_read(tmp_path):
    path = str(tmp_path / "home.msgpack")
    cfg = msgspec.structs.replace(CFG, memory=path)
    fleet = merged_and_kept(cfg)
    told = msgspec.msgpack.decode(fleet.kept[-1])
    assert {"sessions", "node_of", "next_nodes"} <= told.keys()
    keep(path, msgspec.msgpack.encode({name: told[name] for name in ("given", "region_of", "next_region", "frames")}))
    again = Fleet(cfg, epoch=6)
    again.tell(first())
    again.tell(second(), epoch=2)  # of this writer, such a file knows nothing
    again.tick()
    assert sessions_named(again.scene()) == {("r1", 0), ("r2", 1)}
    assert np.isin(fleet.scene().place_ids[:10], again.scene().place_ids).all()


def tall_house():
    """Two robots in one house of two storeys whose frames are known, and the prior that they follow."""
    prior = library_prior("residential home", "which part of the home are the rooms in?", houses.LABELS)
    zone = LevelNode(level="zone", id=0, label="living quarters", probability=0.9, member_ids=[0])
    hallway = houses.ROOMS[2:3]
    robots = houses.tall(above=hallway), houses.tall("r2", below=hallway)
    return [msgspec.structs.replace(one, prior_digest=prior.digest(), nodes=[zone]) for one in robots], prior


def in_one_frame(tmp_path):
    return msgspec.structs.replace(
        CFG, transforms=dict.fromkeys(("r1", "r2"), (0.0,) * 4), memory=str(tmp_path / "home.msgpack")
    )


def test_levels_of_the_merged_map_are_told_and_asked_for(tmp_path):
    robots, prior = tall_house()
    fleet = Fleet(in_one_frame(tmp_path))
    for scene in robots:
        fleet.tell(scene)
    told = [message for _ in range(3) for message in fleet.tick()]
    assert [ask.request.digest for ask in fleet.bridge.asks if ask.query is PRIORS] == [prior.digest()]
    nodes = [(node.level, node.label) for node in fleet.scene().nodes]
    assert nodes == [("floor", "floor 0"), ("floor", "floor 1"), ("building", "building")]  # nobody has answered yet
    assert [node for m in told if isinstance(m, RegionDelta) for node in m.nodes] == fleet.scene().nodes
    fleet.bridge.feed(PriorList(priors=[]))  # a gateway that does not know it, either
    assert fleet.tick() == []
    fleet.bridge.feed(PriorList(priors=[prior]))
    fleet.tick()
    scene = fleet.scene()
    zones = [node for node in scene.nodes if node.level == "zone"]
    assert {"living quarters", "sleeping quarters"} <= {node.label for node in zones}
    assert {region.parent for region in scene.regions} == {node.label for node in zones}
    questions = [NodesOf(level="floor"), NodesOf(region=next(r.id for r in scene.regions if r.label == "kitchen"))]
    floors, above = fleet.store.answer(SCENE_QUERY, SceneQuery(robot="home", questions=questions)).answers
    assert [(one.node.label, len(one.regions)) for one in floors.nodes] == [("floor 0", 5), ("floor 1", 5)]
    assert [one.node.label for one in above.nodes] == ["living quarters", "floor 0", "building"]
    assert fleet.bridge.answer(REGION_SNAPSHOT, SnapshotRequest(robot="home")).nodes == scene.nodes
    assert fleet.tick() == []


def opened(scene, *spots_m):
    """A map whose places nearest to these spots (x, y, dx, dy) of the world open that way, wide enough for a door."""
    spots, ways = np.array(spots_m, float)[:, :2], np.array(spots_m, float)[:, 2:]
    gaps_m = np.linalg.norm(scene.positions_m[None, :, :2] - spots[:, None], axis=2)
    directions = np.column_stack((ways, np.zeros(len(ways)))).astype(np.float32)
    return msgspec.structs.replace(
        scene,
        frontier_ids=scene.place_ids[gaps_m.argmin(axis=1)],
        frontier_directions=directions,
        frontier_areas_m2=np.full(len(ways), 2.0, np.float32),
    )


def test_what_lies_beyond_the_openings_of_a_merged_map_is_foreseen(tmp_path):
    """One robot knows all but the bathroom, the other all but the kitchen: an opening into the kitchen is none, one to
    the east is foreseen with the regions of both, and all of it follows the one prior."""
    prior = library_prior("residential home", "tidy up", houses.LABELS)
    first_m, second_m = houses.scene(rooms=houses.ROOMS[:4]), houses.scene("r2", rooms=houses.ROOMS[1:])
    east, into_kitchen = (7.6, 2.0, 1.0, 0.0), (3.4, 2.0, -1.0, 0.0)
    robots = [
        msgspec.structs.replace(opened(one, *spots), prior_digest=prior.digest())
        for one, spots in ((first_m, [east]), (second_m, [into_kitchen]))
    ]
    fleet = Fleet(in_one_frame(tmp_path))
    fleet.bridge.answers[PRIORS] = lambda request: PriorList(priors=[prior])
    for scene in robots:
        fleet.tell(scene)
    for _ in range(3):
        fleet.tick()
    scene = fleet.scene()
    (opening,) = scene.foresight.openings
    assert opening.beyond_m[0] > 8.0 and opening.beyond_m[1] == pytest.approx(2.0, abs=0.5)
    holder = next(region for region in scene.regions if region.id == opening.region)
    assert holder.label == "living room"
    found = {entry.label: entry.found for entry in scene.foresight.missing}
    assert found["bathroom"] == 1, "which the other robot has seen"
    question = WhereToLook(label="bathroom", start=Spot(here=True))
    (outlook,) = fleet.store.answer(SCENE_QUERY, SceneQuery(robot="home", questions=[question])).answers
    assert outlook.prospects and not outlook.reason
    assert fleet.bridge.answer(REGION_SNAPSHOT, SnapshotRequest(robot="home")).foresight == scene.foresight
    assert fleet.tick() == []
    fleet.tell(msgspec.structs.replace(robots[1], prior_digest="another"), epoch=2)
    fleet.tick()
    assert fleet.scene().foresight.openings == [], "robots that follow several tasks foresee nothing together"


def test_a_stored_map_of_another_prior_takes_no_foresight_from_present_robots(tmp_path):
    """The stored one names zones, which present maps do not; theirs is the prior that counts."""
    prior = library_prior("residential home", "tidy up", houses.LABELS)
    zone = LevelNode(level="zone", id=0, label="living quarters", probability=0.9, member_ids=[0])
    former = msgspec.structs.replace(houses.scene(rooms=houses.ROOMS[:4]), prior_digest="older", nodes=[zone])
    (tmp_path / "scene.json").write_text(json.dumps(scene_json(former)))
    fleet = Fleet(Config(robots=("r1",), stored=(f"r1={tmp_path / 'scene.json'}",)))
    fleet.bridge.answers[PRIORS] = lambda request: PriorList(priors=[prior])
    now = opened(houses.scene(rooms=houses.ROOMS[:4]), (7.6, 2.0, 1.0, 0.0))
    fleet.tell(msgspec.structs.replace(now, prior_digest=prior.digest()), epoch=2)
    for _ in range(3):
        fleet.tick()
    assert len(fleet.scene().foresight.openings) == 1


def test_a_prior_that_nobody_knew_is_asked_for_again(tmp_path):
    robots, prior = tall_house()
    asked = []

    def gateway(request):
        asked.append(request.digest)
        return PriorList(priors=[] if len(asked) < 2 else [prior])

    fleet = Fleet(in_one_frame(tmp_path))
    fleet.bridge.answers[PRIORS] = gateway
    fleet.tell(robots[0])
    for _ in range(ASK_TICKS + 5):
        fleet.tick()
    assert asked == [prior.digest()] * 2
    assert any(node.level == "zone" for node in fleet.scene().nodes)


def test_ids_of_levels_live_on_in_the_file(tmp_path):
    robots, prior = tall_house()
    cfg = in_one_frame(tmp_path)

    def nodes(*told):
        fleet = Fleet(cfg)
        fleet.bridge.answers[PRIORS] = lambda request: PriorList(priors=[prior])
        for scenes in told:
            for scene in scenes:
                fleet.tell(scene)
            for _ in range(3):
                fleet.tick()
        keep(cfg.memory, fleet.kept[-1])
        return [(node.level, node.label, node.id, node.member_ids) for node in fleet.scene().nodes]

    before = nodes(robots[1:], robots)  # most of what is above was there first
    assert nodes(robots) == before
    (tmp_path / "home.msgpack").unlink()
    assert nodes(robots) != before


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"robots": ("r1", "r1")}, "twice"),
        ({"robots": ("fleet",)}, "reserved"),
        ({"robots": tuple(f"r{number}" for number in range(257))}, "at most 256"),
        ({"robots": ("r1",), "transforms": {"r2": (0.0, 0.0, 0.0, 0.0)}}, "name it, too"),
    ],
)
def test_absurd_fleets_are_refused(changes, why):
    with pytest.raises(ValueError, match=why):
        Config(**changes)


def test_a_fleet_bears_no_robots_name():
    with pytest.raises(ServiceError, match="another name"):
        SERVICE.init(Config(robots=("home",)), Identity("home", "fleet", 1))


def test_transforms_are_read():
    assert transforms_of(["r2=1,2,0,180"], ["r1", "r2"], False) == {"r2": (1.0, 2.0, 0.0, np.pi)}
    assert transforms_of([], ["r1"], True) == {"r1": (0.0, 0.0, 0.0, 0.0)}
    for text in ("r2=1,2,3", "r2", "r2=1,2,x,4", "r2=1,2,3,inf"):
        with pytest.raises(UserError, match="no transform"):
            transforms_of([text], ["r2"], False)


def test_a_stored_scene_is_gone_on_in(tmp_path):
    path = tmp_path / "scene.sqlite"
    with Runner(BY_NAME["scene_store"], StoreConfig(path=str(path)), Identity("*", "store", 1)) as store:
        store.feed(*houses.deltas(houses.scene()))
    fleet = Fleet(Config(robots=("r1",), stored=(f"r1={path}",)))
    fleet.tell(houses.scene("r1", MOVED, rooms=houses.ROOMS[1:]), epoch=2)
    fleet.tick()
    scene = fleet.scene()
    assert sorted(region.label for region in scene.regions) == houses.LABELS  # the kitchen is remembered
    assert len(scene.objects) == len(houses.THINGS)
    kitchen = next(region for region in scene.regions if region.label == "kitchen")
    assert kitchen.position_m[:2] == pytest.approx((1.5, 2.0), abs=0.3)  # in the stored frame


@pytest.mark.parametrize(("stored", "why"), [("r1", "ROBOT=PATH"), ("r1=/nowhere/scene.json", "does not exist")])
def test_scenes_that_are_not_there_are_refused(stored, why):
    with pytest.raises(ServiceError, match=why):
        Fleet(Config(robots=("r1",), stored=(stored,)))


def absurd(delta):
    """Deltas as this one that no robot can mean, with what is said of each."""
    far = delta.positions_m.copy() if isinstance(delta, PlaceDelta) else None
    if far is None:
        gone = [msgspec.structs.replace(item, position_m=(1e200, 0.0, 0.0)) for item in delta.objects]
        return [(msgspec.structs.replace(delta, objects=gone), r"1e\+200 m away")]
    far[3] = 3e38
    wide, hollow = np.full_like(delta.radii_m, 1e30), np.full_like(delta.radii_m, -1)
    one_hollow = np.where(np.arange(len(delta.radii_m)) == 1, np.float32(-1), delta.radii_m)
    return [
        (msgspec.structs.replace(delta, positions_m=far), r"3e\+38 m away"),
        (msgspec.structs.replace(delta, radii_m=wide), r"1e\+30 m of free space"),
        (msgspec.structs.replace(delta, radii_m=hollow), "-1 m of free space"),
        (msgspec.structs.replace(delta, radii_m=one_hollow), "-1 m of free space"),
        (msgspec.structs.replace(delta, camera_m=(0.0, -1e9, 0.0)), r"1e\+09 m away"),
    ]


def test_a_robot_that_tells_what_cannot_be_does_not_end_the_map_of_the_others():
    fleet = Fleet(Config(robots=("r1", "r2", "r3"), transforms=dict.fromkeys(("r1", "r3"), (0.0, 0.0, 0.0, 0.0))))
    fleet.tell(first())
    fleet.tick()
    before = fleet.scene()
    places, regions, objects = houses.deltas(houses.scene("r3"))
    for wrong, said in [*absurd(places), *absurd(objects)]:
        with pytest.raises(InputRefused, match=f"r3 tells of .*{said}"):
            fleet.pipeline.publish(topic_of(type(wrong)), wrong)
        fleet.tick()
        assert np.array_equal(fleet.scene().place_ids, before.place_ids)
    for delta in (places, regions, objects):
        fleet.pipeline.publish(topic_of(type(delta)), delta)
    fleet.tick()
    assert len(fleet.scene().place_ids) > len(before.place_ids)


def test_a_map_with_places_kilometres_apart_and_wide_ones_is_merged_in_bounded_memory():
    fleet = Fleet(Config(robots=("r1", "r2"), transforms={"r1": (0.0, 0.0, 0.0, 0.0)}))
    fleet.tell(first())
    fleet.tick()
    held = second()
    positions_m, radii_m = held.positions_m.copy(), held.radii_m.copy()
    positions_m[0], radii_m[1:9] = (9e5, -9e5, 1.0), 99.0
    fleet.tell(msgspec.structs.replace(held, positions_m=positions_m, radii_m=radii_m))
    fleet.tick()
    alone = Fleet(Config(robots=("r2",)))
    alone.tell(msgspec.structs.replace(held, positions_m=positions_m, radii_m=radii_m))
    alone.tick()
    assert max(region.area_m2 for region in alone.scene().regions) > 2e4


@pytest.mark.parametrize(("robot", "why"), [("", "is empty"), ("a/b", "choose one without")])
def test_a_stored_scene_needs_the_name_of_a_robot(tmp_path, robot, why):
    (tmp_path / "scene.json").write_text(json.dumps(scene_json(houses.scene())))
    with pytest.raises(ServiceError, match=rf"scene\.json cannot be merged: .*{why}"):
        Fleet(Config(robots=("r1",), stored=(f"{robot}={tmp_path / 'scene.json'}",)))

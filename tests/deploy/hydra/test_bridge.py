"""The bridge beside segmenter and store: Hydra's graph becomes regions, and their names come back to its rooms."""

import asyncio
import socket
from functools import partial

import msgspec
import numpy as np
import pytest
import spark_dsg
from spark_dsg.zmq import DsgReceiver, DsgSender

from prior_sg.deploy.cli.main import main
from prior_sg.deploy.hydra.bridge import SEND_NAMES, SERVICE, Config
from prior_sg.deploy.hydra.core.graph import GraphLost
from prior_sg.deploy.hydra.core.rooms import room_names
from prior_sg.deploy.hydra.core.update import RoomNamesSent
from prior_sg.deploy.hydra.reading import graph_columns
from prior_sg.deploy.hydra.wire import NameSender, names_graph
from prior_sg.schemas.frames import PoseUpdate
from prior_sg.schemas.objects import ObjectDelta
from prior_sg.schemas.places import PlaceDelta, SnapshotRequest
from prior_sg.schemas.regions import RegionDelta
from prior_sg.schemas.scene import SceneRequest
from prior_sg.schemas.status import Tick
from prior_sg.schemas.topics import (
    KEYFRAME,
    OBJECT_DELTA,
    OBJECT_SNAPSHOT,
    PLACE_DELTA,
    PLACE_SNAPSHOT,
    PRIOR,
    PRIORS,
    PYRAMID,
    REGION_DELTA,
    REGION_SNAPSHOT,
    SCENE,
    TASK,
    TASK_IN_FORCE,
    TEXT,
)
from prior_sg.services.registry import BY_NAME
from prior_sg.services.runtime.bus import Hub, LocalBus
from prior_sg.services.runtime.client import BusClient
from prior_sg.services.runtime.host.host import Host
from prior_sg.services.runtime.runner import Pipeline, Runner
from prior_sg.services.runtime.service import Identity, ServiceError
from prior_sg.services.scene_store.core.config import Config as StoreConfig
from tests.help.homes import keyframe, region
from tests.help.hydra import Symbol, add_agent, add_object, hydra_graph, posed
from tests.help.world import ROBOT, place_grid, prior, task, text, walk

ROOMS = ["kitchen", "hall", "bedroom"]
CFG = Config(graph_from="tcp://127.0.0.1:1", labels_to="tcp://127.0.0.1:2")
TICK = Tick(stamp_ns=10**18)
REQUEST = SnapshotRequest(robot=ROBOT)


def first_keyframe(**changes):
    return msgspec.structs.replace(keyframe(), robot=ROBOT, **changes)


class Bridge:
    """One bridge without sockets, which has heard of our world, and the names that it sent."""

    def __init__(self, cfg=CFG, heard=True):
        self.sent = []
        answers = {SEND_NAMES: self.send}
        self.runner = Runner(SERVICE, cfg, Identity(ROBOT, "hydra", 5), answers, wire=True)
        if heard:
            self.feed(first_keyframe())

    def send(self, request):
        self.sent.append(request.names)
        return RoomNamesSent(robot=ROBOT)

    def feed(self, *inputs):
        read = [graph_columns(i, ROBOT) if isinstance(i, spark_dsg.DynamicSceneGraph) else i for i in inputs]
        return [message for _, message in self.runner.feed(*read)]


def of(kind, messages):
    return [message for message in messages if isinstance(message, kind)]


def small(**changes):
    return hydra_graph(np.array([(0.5, 0, 1), (1.5, 0, 1), (2.5, 0, 1)]), [(0, 1), (1, 2)], **changes)


def test_only_what_changed_is_told():
    bridge = Bridge()
    (first,) = of(PlaceDelta, bridge.feed(small()))
    assert (first.epoch, first.revision, first.stamp_ns) == (5, 0, keyframe().stamp_ns)
    assert first.place_ids.tolist() == [0, 1, 2] and first.edges.tolist() == [[0, 1], [1, 2]]
    assert first.clearances_m == pytest.approx([0.4, 0.4]) and first.past_frame_ids.tolist() == [0]
    assert bridge.feed(small()) == []
    moved = small()
    moved.get_node(Symbol("p", 1)).attributes.position = np.array((1.5, 0.3, 1.0))
    moved.add_node("PLACES", Symbol("p", 9), spark_dsg.PlaceNodeAttributes())
    moved.remove_node(Symbol("p", 2))
    (second,) = bridge.feed(moved)
    assert (second.revision, second.place_ids.tolist()) == (1, [1, 9])
    assert second.removed_ids.tolist() == [2] and not len(second.removed_edges)  # it went with its place
    cut = small()
    cut.remove_edge(Symbol("p", 0), Symbol("p", 1))
    third = bridge.feed(cut)[0]
    assert third.removed_edges.tolist() == [[0, 1]] and third.removed_ids.tolist() == [9]
    assert third.edges.tolist() == [[1, 2]] and third.place_ids.tolist() == [1, 2]


def test_slow_drift_adds_up_and_small_changes_are_not_told():
    bridge = Bridge()
    bridge.feed(small())
    told = []
    for step in range(1, 9):
        graph = small()
        graph.get_node(Symbol("p", 0)).attributes.position = np.array((0.5 + 0.004 * step, 0, 1))
        told += of(PlaceDelta, bridge.feed(graph))
    assert [delta.positions_m[0, 0] for delta in told] == pytest.approx([0.512, 0.524])
    assert [delta.revision for delta in told] == [1, 2]


def test_a_graph_that_is_empty_again_removes_everything():
    bridge = Bridge()
    bridge.feed(small())
    (delta,) = bridge.feed(spark_dsg.DynamicSceneGraph())
    assert delta.removed_ids.tolist() == [0, 1, 2] and not len(delta.removed_edges)
    assert not len(bridge.runner.answer(PLACE_SNAPSHOT, REQUEST).place_ids)


def test_a_snapshot_holds_all_that_was_told():
    bridge = Bridge()
    graph = small()
    node = graph.get_node(Symbol("p", 2)).attributes
    node.active_frontier, node.frontier_scale = True, np.array((0.0, 2.0, 0.5))
    node.orientation = spark_dsg.Quaternion(1.0, 0.0, 0.0, 0.0)
    add_object(graph, 4, "stove", (0, 0, 0), (1, 1, 1))
    places, objects = bridge.feed(graph)
    assert places.frontier_ids.tolist() == [2] and places.frontier_areas_m2.tolist() == [1.0]
    snapshot = bridge.runner.answer(PLACE_SNAPSHOT, REQUEST)
    assert snapshot == msgspec.structs.replace(places, snapshot=True)
    assert bridge.runner.answer(OBJECT_SNAPSHOT, REQUEST).objects == objects.objects
    closed = of(PlaceDelta, bridge.feed(small()))[0]
    assert closed.frontier_ids.tolist() == [2] and closed.frontier_areas_m2.tolist() == [0.0]


def test_objects_come_change_and_go():
    bridge, graph = Bridge(), small()
    add_object(graph, 4, "stove", (0, 0, 0), (1, 1, 1))
    (first,) = of(ObjectDelta, bridge.feed(graph))
    assert (first.epoch, first.revision, first.prior_digest) == (5, 0, "")
    assert [(item.id, item.label, item.max_m) for item in first.objects] == [(4, "stove", (1, 1, 1))]
    graph.get_node(Symbol("O", 4)).attributes.name = "oven"
    assert [item.label for item in of(ObjectDelta, bridge.feed(graph))[0].objects] == ["oven"]
    assert of(ObjectDelta, bridge.feed(graph)) == []
    assert of(ObjectDelta, bridge.feed(small()))[0].removed_ids.tolist() == [4]
    assert of(ObjectDelta, Bridge(msgspec.structs.replace(CFG, objects=False)).feed(graph)) == []


def test_objects_outrank_those_of_a_segmenter_that_started_later():
    bridge, graph = Bridge(), small()
    add_object(graph, 4, "stove", (0, 0, 0), (1, 1, 1))
    bridge.feed(graph)
    (again,) = of(ObjectDelta, bridge.feed(regions_of({}, epoch=70)))
    assert (again.epoch, again.revision, again.snapshot) == (71, 0, True) and len(again.objects) == 1
    assert of(ObjectDelta, bridge.feed(regions_of({}, epoch=70, revision=1))) == []
    graph.get_node(Symbol("O", 4)).attributes.name = "oven"
    assert [(d.epoch, d.revision) for d in of(ObjectDelta, bridge.feed(graph))] == [(71, 1)]


def regions_of(places_by_region, epoch=1, revision=0, labels=("hall", "kitchen")):
    """A segmenter's delta: places by region id, regions in the order of the labels."""
    none = np.zeros(0, np.int64)
    places = [place for places in places_by_region.values() for place in places]
    owners = [number for number, places in places_by_region.items() for _ in places]
    return RegionDelta(
        robot=ROBOT,
        epoch=epoch,
        revision=revision,
        stamp_ns=1,
        prior_digest="",
        environment="",
        task="",
        space="",
        labels=list(labels),
        regions=[region(number, labels[k], 0.5, (0, 0, 0)) for k, number in enumerate(places_by_region)],
        removed_ids=none,
        place_ids=np.array(places, np.int64),
        place_regions=np.array(owners, np.int64),
        posteriors=np.zeros((len(places), len(labels)), np.float16),
        unknown=np.zeros(len(places), np.float16),
        removed_place_ids=none,
        energy=0.0,
    )


def test_a_room_is_called_as_most_of_its_places_are():
    labels = {3: "hall", 7: "kitchen", 9: ""}
    names = room_names({1: 50, 2: 50, 3: 50, 4: 51, 5: 51, 6: -1, 8: 52}, {1: 3, 2: 7, 3: 7, 4: 7, 5: 3, 8: 9}, labels)
    assert names == {50: "kitchen", 51: "hall"}  # of equally many the smaller id; nameless ones name nothing
    bridge = Bridge()
    bridge.feed(small())
    assert bridge.sent == []
    bridge.feed(regions_of({3: [0], 7: [1, 2]}))
    assert bridge.sent == [{Symbol("R", 0).value: "kitchen"}]
    bridge.feed(TICK)
    assert len(bridge.sent) == 2  # for those who listen late


def test_a_bridge_that_joins_late_asks_for_the_regions_it_missed():
    bridge = Bridge()
    bridge.feed(small(), regions_of({3: [0, 1, 2]}, revision=4))
    assert [ask.query for ask in bridge.runner.asks] == [REGION_SNAPSHOT] and bridge.sent == []
    bridge.feed(msgspec.structs.replace(regions_of({3: [0, 1, 2]}, revision=4), snapshot=True))
    assert bridge.sent == [{Symbol("R", 0).value: "hall"}]


def test_a_graph_waits_for_the_origin_of_our_world():
    bridge = Bridge(msgspec.structs.replace(CFG, scale=2.0), heard=False)
    graph = small()
    add_object(graph, 4, "stove", (0, 0, 0), (1, 1, 1))
    assert bridge.feed(graph) == []
    places, objects = bridge.feed(first_keyframe(origin_m=(100.0, 10.0, 1.0)))
    assert places.positions_m[1].tolist() == [-97.0, -10.0, 1.0] and places.origin_m == (100.0, 10.0, 1.0)
    assert places.radii_m[0] == 1.0 and places.clearances_m == pytest.approx([0.8, 0.8])
    assert objects.objects[0].max_m == (-98.0, -8.0, 1.0)


def test_keyframes_follow_what_a_loop_closure_moved():
    bridge = Bridge(heard=False)
    frames = [posed(first_keyframe(), n, stamp_s=10 + n, x_m=float(n), y_m=0.0) for n in range(3)]
    first, second = small(), small()
    for n in range(3):
        add_agent(first, n, 10 + n, (n, 0.2, 0.5))
        add_agent(second, n, 10 + n, (n, 0.2 + (1.0 if n == 2 else 0.001), 0.5))
    assert of(PoseUpdate, bridge.feed(*frames, first)) == []
    told = bridge.feed(second)
    (update,) = of(PoseUpdate, told)
    assert update.frame_ids.tolist() == [2] and (update.epoch, update.revision) == (5, 0)
    expected = np.array(frames[2].world_from_camera)
    expected[1, 3] += 1.0
    assert update.world_from_camera[0] == pytest.approx(expected)
    assert of(PlaceDelta, told)[0].past_cameras_m.tolist() == [[2.0, 1.0, 1.0]]
    assert of(PoseUpdate, bridge.feed(second)) == []
    assert of(PoseUpdate, bridge.feed(first))[0].world_from_camera[0] == pytest.approx(frames[2].world_from_camera)


def test_what_was_left_out_is_counted():
    bridge, graph = Bridge(), small()
    graph.get_node(Symbol("p", 2)).attributes.distance = np.nan
    bridge.feed(graph, GraphLost(robot=ROBOT, why="no graph"))
    told = {loss.what: loss.count for loss in SERVICE.losses(bridge.runner.state)}
    assert told == {"nodes of Hydra left out": 1, "graphs of Hydra left out": 1}


def test_two_worlds_are_said_once():
    bridge, graph = Bridge(heard=False), small()
    for n in range(3):
        add_agent(graph, n, 10 + n, (n, 40.0, 0.5))
        bridge.feed(posed(first_keyframe(), n, stamp_s=10 + n, x_m=float(n), y_m=0.0))
    events = [delta.event for _ in range(2) for delta in of(PlaceDelta, bridge.feed(graph))]
    assert len(events) == 1 and "40.0 m from Hydra's robot" in events[0]


@pytest.fixture(scope="module")
def lived():
    """Three rooms: places by Hydra, pyramids of our workers; bridge, segmenter and store joined as on a bus."""
    bridge = Bridge(heard=False)
    segmenter = Runner(BY_NAME["segmenter"], None, Identity(ROBOT, "s", 9), {TEXT: said, PRIORS: nobody}, wire=True)
    segmenter.answers[TASK_IN_FORCE] = nobody
    store = Runner(BY_NAME["scene_store"], StoreConfig(path=":memory:"), Identity("*", "store", 1), wire=True)
    positions_m, edges = place_grid(3)
    graph = hydra_graph(positions_m, edges, features=64)
    add_object(graph, 4, "stove", (0, 0, 0), (1, 1, 1))
    with Pipeline((bridge.runner, segmenter, store)) as pipeline:
        pipeline.publish(KEYFRAME, first_keyframe())
        pipeline.feed(bridge.runner, graph_columns(graph, ROBOT))
        pipeline.publish(TASK, task())
        pipeline.publish(PRIOR, prior(ROOMS))
        for pyramid in walk(3):
            pipeline.publish(PYRAMID, pyramid)
        for _ in range(8):
            pipeline.feed(segmenter, TICK)
        yield bridge, pipeline, store.answer(SCENE, SceneRequest(robot=ROBOT)), positions_m


def said(request):
    return text(np.eye(3)[: len(request.concepts)])


def nobody(request):
    return None


def test_hydras_places_get_our_regions_and_its_rooms_our_names(lived):
    bridge, _, scene, positions_m = lived
    assert scene.positions_m == pytest.approx(positions_m) and len(scene.edges) > 60
    assert sorted({region.label for region in scene.regions}) == sorted(ROOMS)
    assert [item.label for item in scene.objects] == ["stove"]
    rooms = {Symbol("R", number).value: name for number, name in enumerate(ROOMS)}
    assert bridge.sent[-1] == rooms


def test_the_store_gets_what_it_missed_from_the_bridge(lived):
    bridge, pipeline, scene, _ = lived
    with Runner(BY_NAME["scene_store"], StoreConfig(path=":memory:"), Identity("*", "late", 1), wire=True) as late:
        late.answers |= {PLACE_SNAPSHOT: bridge.runner, OBJECT_SNAPSHOT: bridge.runner}
        late.answers[REGION_SNAPSHOT] = pipeline.of("segmenter")
        moved = hydra_graph(scene.positions_m + np.float32((0, 0.5, 0)), scene.edges)
        for topic, message in bridge.runner.feed(graph_columns(moved, ROBOT)):
            if topic in (PLACE_DELTA, OBJECT_DELTA):
                late.feed(message)
        found = late.answer(SCENE, SceneRequest(robot=ROBOT))
    assert found.positions_m == pytest.approx(scene.positions_m + np.array((0, 0.5, 0))) and found.objects == []
    assert len(found.trajectory) == 1


def test_names_are_what_sparks_receiver_takes():
    names = {Symbol("R", 0).value: "kitchen", Symbol("R", 12).value: "büro", -1: "nowhere"}
    graph = spark_dsg.DynamicSceneGraph.from_binary(names_graph(names).to_binary())
    nodes = graph.get_layer("ROOMS").nodes
    assert {node.id.str(): node.attributes.name for node in nodes} == {"R0": "kitchen", "R12": "büro"}


def free_url():
    with socket.socket() as held:
        held.bind(("127.0.0.1", 0))
        return f"tcp://127.0.0.1:{held.getsockname()[1]}"


async def until(condition, seconds=20.0):
    end_s = asyncio.get_running_loop().time() + seconds
    while not condition():
        assert asyncio.get_running_loop().time() < end_s
        await asyncio.sleep(0.05)


def test_sparks_own_sender_and_receiver_at_both_ends(caplog):
    """A host on a bus; before Hydra is there that is said, and bytes that are no graph are left out."""
    cfg = Config(graph_from=free_url(), labels_to=free_url(), silent_after_s=0.2)
    hub, places = Hub(), []

    async def lead():
        host = Host(SERVICE, LocalBus(hub), cfg, Identity(ROBOT, "hydra-1", 5))
        running = asyncio.create_task(host.run())
        with BusClient(LocalBus(hub)) as client:
            client.listen(PLACE_DELTA, ROBOT, places.append)
            await until(lambda: "does Hydra run" in caplog.text)
            sender, receiver = DsgSender(cfg.graph_from), DsgReceiver(cfg.labels_to)
            client.publish(KEYFRAME, first_keyframe())
            client.publish(REGION_DELTA, regions_of({3: [0], 7: [1, 2]}))
            junk, graph = partial(sender._socket.send, b"no graph"), partial(sender.send, small(features=512))
            await until(lambda: (junk(), "are no graph" in caplog.text)[1])
            await until(lambda: (graph(), bool(places))[1])
            await until(lambda: receiver.recv(1))
        host.stop()
        await running
        sender._socket.close()
        receiver._socket.close()
        return {node.id.str(): node.attributes.name for node in receiver.graph.get_layer("ROOMS").nodes}

    assert asyncio.run(lead()) == {"R0": "kitchen"}
    assert len(places) == 1 and "malformed" not in caplog.text and caplog.text.count("are no graph") == 1


@pytest.mark.parametrize(
    ("labels_to", "why"),
    [
        ("pigeon://nowhere", "write it as tcp://"),
        ("hello", "write it as tcp://"),
        ("tcp://192.0.2.1:5", "address"),
    ],
)
def test_addresses_that_cannot_be_used_are_one_sentence(labels_to, why):
    with pytest.raises(ServiceError, match=why):
        NameSender(labels_to)


def test_an_address_in_use_is_one_sentence(endpoint, capsys):
    url = free_url()
    holder = NameSender(url)
    assert main(["hydra", "--labels-to", url, "--from", free_url(), "--connect", endpoint]) == 1
    assert f"names of rooms cannot be sent on {url}: another program listens there" in capsys.readouterr().err
    holder.close()
    assert main(["hydra", "--scale", "0"]) == 2
    assert "scale must be a positive number" in capsys.readouterr().err

"""The bridge on a router: what ROS hears, what it can ask for, and what it may not."""

import asyncio
import contextlib
import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import msgspec
import numpy as np
import pytest
import yaml
import zenoh

from prior_sg.deploy.cli.main import build_parser, main
from prior_sg.deploy.cli.ros_results import bridge_arguments
from prior_sg.deploy.errors import UserError
from prior_sg.deploy.ros import frames, grids, masks, parameters
from prior_sg.deploy.ros.bridge import BUSY, CLOSED, Bridge, bridge_types, serve_ros
from prior_sg.deploy.ros.markers import ARRAY
from prior_sg.deploy.ros.options import Options
from prior_sg.deploy.ros.rules import Look, rule_of
from prior_sg.deploy.ros.topics import STRING
from prior_sg.deploy.running.supervisor import Supervisor
from prior_sg.deploy.serving.system import System
from prior_sg.schemas.regions import NO_REGION
from prior_sg.services.runtime.keys import About, Bundle, Participant
from prior_sg.services.runtime.ros.session import RosError, RosSession
from prior_sg.services.runtime.ros.wire import Channel, Quality
from tests.help.homes import home
from tests.help.store import StandIn

TYPES = bridge_types()
NODE = "prior_sg"
RELAY = Path(__file__).parents[2] / "help" / "ros_relay.py"


def relabelled(scene, task, digest):
    return msgspec.structs.replace(scene, task=task, prior_digest=digest)


@contextlib.contextmanager
def bridged(endpoint, domain, store, **options):
    """A bridge of a stand-in for a system; gives what it says to its user."""
    loop, said = asyncio.new_event_loop(), []
    told = Options(domain=domain, interval_s=0.1, **options)
    with RosSession(endpoint, NODE, domain) as ros:
        system = System(store.open_bus, store.robot)
        bridge = Bridge(system, ros, TYPES, told, said.append)
        thread = threading.Thread(target=loop.run_until_complete, args=(until_cancelled(bridge),), daemon=True)
        thread.start()
        try:
            yield said
        finally:
            loop.call_soon_threadsafe(lambda: [task.cancel() for task in asyncio.all_tasks(loop)])
            thread.join(10)
            system.close()


async def until_cancelled(bridge):
    with contextlib.suppress(asyncio.CancelledError):
        await bridge.run()


class Listener:
    """A node that hears some topics of the bridge."""

    def __init__(self, ros, **types):
        self.ros, self.types, self.heard = ros, types, {name: [] for name in types}
        for name, kind in types.items():
            self.listen(name, f"/{NODE}/{name}", kind, latched=True)

    def listen(self, name, topic, kind, latched):
        self.types[name], self.heard[name] = kind, []
        channel = Channel(topic, kind, TYPES.hash(kind), Quality(1, latched=latched))
        self.ros.subscribe(channel, lambda message: self.heard[name].append(message.payload), print)

    def last(self, name):
        return TYPES.decode(self.heard[name][-1], self.types[name])

    def state(self):
        return json.loads(self.last("task").data) if self.heard["task"] else {}

    def ask(self, service, *fields, timeout_s=20.0):
        kind = parameters.type_of(service)
        client = self.ros.client(Channel(f"/{NODE}/{service}", kind, TYPES.hash(kind)))
        reply = client.call(TYPES.encode(TYPES.make(f"{kind}_Request", *fields)), timeout_s)
        return TYPES.decode(reply, f"{kind}_Response")

    def set_task(self, text):
        nothing = [np.zeros(0, of) for of in (np.uint8, np.bool_, np.int64, np.float64)]
        value = TYPES.make("rcl_interfaces/msg/ParameterValue", 4, False, 0, 0.0, text, *nothing, [])
        one = TYPES.make("rcl_interfaces/msg/Parameter", "task", value)
        (result,) = self.ask("set_parameters", [one]).results
        return result.successful, result.reason


def wait_for(condition, timeout_s=30.0):
    end_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.02)


def names(array):
    return {(marker.ns, marker.id) for marker in array.markers}


def test_ros_hears_of_the_scene_and_of_its_changes(endpoint):
    store = StandIn(home())
    look = Look(rules=(rule_of("kitchen=slow:50"), rule_of("ward=keepout")))
    types = {"markers": ARRAY, "region_grid": grids.GRID, "regions": STRING, "speed_mask": grids.GRID}
    with bridged(endpoint, 21, store, look=look) as said, RosSession(endpoint, "ears", 21) as ros:
        wait_for(lambda: said)
        assert said == ["masks without a region at present: ward"]
        ears = Listener(ros, speed_info=masks.INFO, **types)  # it comes late, and hears what was said
        ears.listen("tf", "/tf", frames.TF, latched=False)
        wait_for(lambda: all(ears.heard.values()))
        assert ("regions/floor", 7) in names(ears.last("markers"))
        assert {one.child_frame_id for one in ears.last("tf").transforms} == {"prior_sg/region_3", "prior_sg/region_7"}
        assert ears.last("speed_info").filter_mask_topic == "/prior_sg/speed_mask"
        scene = home()
        owners = np.where(scene.place_regions == 7, NO_REGION, scene.place_regions)
        store.store(msgspec.structs.replace(scene, regions=scene.regions[:1], place_regions=owners, stamp_ns=2 * 10**9))
        wait_for(lambda: len(ears.heard["markers"]) > 1 and len(ears.heard["regions"]) > 1)
        assert not {key for key in names(ears.last("markers")) if key[1] == 7}
        assert [one["label"] for one in json.loads(ears.last("regions").data)["regions"]] == ["kitchen"]
        assert len(ears.heard["speed_mask"]) == len(ears.heard["speed_info"]) == 1  # nothing new for Nav2
        kinds = {(one.kind, one.full_node) for one in ros.entities()}
        assert {("NN", "/prior_sg"), ("MP", "/prior_sg"), ("SS", "/prior_sg")} <= kinds


def test_ros_gives_tasks_only_where_that_is_allowed(endpoint):
    store = StandIn(home())
    with bridged(endpoint, 22, store), RosSession(endpoint, "hands", 22) as ros:
        hands = Listener(ros, task=STRING)
        wait_for(hands.state)
        assert hands.state() == {"task": "serve drinks", "state": "in force", "note": ""}
        assert hands.set_task("tidy up") == (False, CLOSED)
        assert [value.string_value for value in hands.ask("get_parameters", ["task"]).values] == ["serve drinks"]
        with pytest.raises(RosError, match="are no rcl_interfaces"):
            kind = parameters.type_of("set_parameters")
            ros.client(Channel(f"/{NODE}/set_parameters", kind, TYPES.hash(kind))).call(b"\x00\x01\x00\x00\xff\xff")
    assert store.tasks == []


def test_a_task_of_ros_is_given_and_told_of(endpoint):
    store = StandIn(home(), relabelled)
    with bridged(endpoint, 23, store, takes_tasks=True), RosSession(endpoint, "hands", 23) as ros:
        hands = Listener(ros, task=STRING)
        wait_for(hands.state)
        assert hands.set_task("tidy up") == (True, "")
        again = hands.set_task("dance")
        wait_for(lambda: hands.state() == {"task": "tidy up", "state": "in force", "note": ""})
        assert again == (False, BUSY) and [task.task for task in store.tasks] == ["tidy up"]
        wait_for(lambda: hands.ask("get_parameters", ["task"]).values[0].string_value == "tidy up")
        publisher = ros.publisher(Channel(f"/{NODE}/set_task", STRING, TYPES.hash(STRING)))
        publisher.publish(TYPES.encode(TYPES.make(STRING, "\x1b[2J")))
        publisher.publish(TYPES.encode(TYPES.make(STRING, "serve guests")))
        wait_for(lambda: hands.state() == {"task": "serve guests", "state": "in force", "note": ""})
        assert [task.task for task in store.tasks] == ["tidy up", "serve guests"]


def test_a_node_of_ros_itself_sees_markers_and_grids(endpoint):
    pytest.importorskip("rclpy")
    words = [f"{ARRAY}:/prior_sg/markers", *(f"{grids.GRID}:/prior_sg/{name}" for name in ("region_grid", "free_grid"))]
    words.append(f"{STRING}:/prior_sg/regions")
    apart = {"RMW_IMPLEMENTATION": "rmw_fastrtps_cpp", "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    environment = os.environ | apart | {"ROS_DOMAIN_ID": "77"}
    with bridged(endpoint, 24, StandIn(home())):
        relay = subprocess.Popen([sys.executable, RELAY, "relay", endpoint, "24", *words], env=environment)
        try:
            listening = [sys.executable, RELAY, "listen", "20", *words]
            heard = subprocess.run(listening, env=environment, capture_output=True, text=True, timeout=60, check=True)
        finally:
            relay.kill()
            relay.wait()
    told = {one["topic"]: one["told"] for one in map(json.loads, heard.stdout.splitlines())}
    assert set(told) == {word.partition(":")[2] for word in words}
    markers = {(ns, number): (kind, count, text) for ns, number, kind, count, text in told["/prior_sg/markers"]}
    assert markers["places", 0] == (7, 10, "") and markers["regions/name", 3] == (9, 0, "kitchen 90 %")
    assert told["/prior_sg/region_grid"] == [200, 120, [-1, 1, 2]]
    assert told["/prior_sg/free_grid"] == [200, 120, [-1, 0]]
    assert len(json.loads(told["/prior_sg/regions"])["regions"]) == 2


def test_the_bridge_is_supervised(endpoint, tmp_path):
    supervisor = Supervisor(endpoint, "ada", tmp_path)
    supervisor.start_door("ros", "prior_sg.deploy.ros.process", ["--ros-router", endpoint])
    try:
        (child,) = supervisor.children
        wait_for(lambda: "node /prior_sg" in child.log_path.read_text(), 30)
        supervisor.children[0].process.terminate()
        assert child.process.wait(10) == 0
    finally:
        supervisor.stop()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--mask", "ward=fast"], "LABEL=keepout"),
        (["--mask", "w=slow:5", "--mask", "w=slow:6"], "two masks"),
        (["--node", "a/b"], "no name of a node"),
        (["--frame", "/map"], "no frame"),
        (["--cell", "0.001"], "between 0.02 and 1"),
        (["--cell", "nan"], "between 0.02 and 1"),
        (["--interval", "0"], "between 0.1 and 3600"),
        (["--heights", "2", "1"], "lower one"),
        (["--domain", "233"], "no domain"),
        (["--ros-router", "somewhere"], "PROTOCOL/HOST:PORT"),
    ],
)
def test_options_that_cannot_be_are_told(options, said, endpoint, capsys):
    assert main(["ros", "bridge", "--connect", endpoint, *options]) == 1
    told = capsys.readouterr().err
    assert said in told and len(told.splitlines()) == 1


@pytest.mark.parametrize(
    ("words", "passed"),
    [
        ("--ros", ["--ros-router", "tcp/127.0.0.1:7460"]),
        ("--ros tcp/127.0.0.1:7461 --domain 3", ["--ros-router", "tcp/127.0.0.1:7461", "--domain", "3"]),
    ],
)
def test_up_tells_its_bridge_where_ros_is(words, passed):
    told = build_parser().parse_args(["up", "--connect", "tcp/127.0.0.1:7460", *words.split()])
    assert bridge_arguments(told) == passed


def test_a_viewer_gives_no_tasks(monkeypatch):
    viewer = Participant(name="screen", role="viewer", issue=1, until="2099-01-01")
    bundle = Bundle(folder=Path(), about=About(name="screen", participants=[viewer]))
    monkeypatch.setattr("prior_sg.deploy.ros.bridge.bundle_in_force", lambda: bundle)
    with pytest.raises(UserError, match="screen, a viewer"):
        serve_ros("tcp/127.0.0.1:1", "ada", Options(takes_tasks=True), print, print)


def node_of_ros(endpoint):
    """A session with what matters of rmw_zenoh's own configuration."""
    settings = {
        "mode": "peer",
        "connect": {"endpoints": [endpoint]},
        "listen": {"endpoints": ["tcp/localhost:0"]},
        "scouting": {
            "multicast": {"enabled": False},
            "gossip": {"enabled": True, "autoconnect": {"router": [], "peer": ["router", "peer"]}},
        },
    }
    return zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))


def test_nodes_of_ros_find_each_other_on_our_router(endpoint):
    heard = set()
    with node_of_ros(endpoint) as talker, node_of_ros(endpoint) as listener:
        subscriber = listener.declare_subscriber("25/chatter/**", lambda sample: heard.add(sample.payload.to_string()))

        def said():
            talker.put("25/chatter/x", "hello")
            return heard == {"hello"}

        wait_for(said)
        subscriber.undeclare()


def test_a_router_with_keys_passes_on_nothing_of_ros(tmp_path, capsys):
    assert main(["up", "--ros", "--listen", "tls/127.0.0.1:7450", "--out", str(tmp_path / "up")]) == 2
    assert "passes on nothing of ROS" in capsys.readouterr().err


def test_a_configuration_of_rviz_names_what_the_bridge_tells(tmp_path, capsys):
    file = tmp_path / "ours.rviz"
    assert main(["ros", "rviz", "--out", str(file), "--node", "ada", "--frame", "odom"]) == 0
    shown = yaml.safe_load(file.read_text())["Visualization Manager"]
    assert shown["Global Options"]["Fixed Frame"] == "odom"
    topics = {one["Topic"]["Value"]: one["Topic"] for one in shown["Displays"] if "Topic" in one}
    assert set(topics) == {
        f"/ada/{name}" for name in ("markers", "region_grid", "free_grid", "keepout_mask", "speed_mask")
    }
    assert {topic["Durability Policy"] for topic in topics.values()} == {"Transient Local"}
    assert f"rviz2-d{file}" in "".join(capsys.readouterr().out.split())  # the terminal breaks long lines

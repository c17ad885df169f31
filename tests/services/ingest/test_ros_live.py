"""A live robot over rmw_zenoh's keys: the frames of its recording, whatever order they come in; faults as sentences."""

import asyncio
import json
import os
import struct
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rosbags")

from prior_sg.deploy.cli.main import main
from prior_sg.schemas.topics import POSE_UPDATE
from prior_sg.services.geometry import inverse
from prior_sg.services.ingest import service
from prior_sg.services.ingest.core.config import Config
from prior_sg.services.ingest.core.frames import BadFrame, Closure, Correction, RawFrame, Unused
from prior_sg.services.ingest.core.options import ReadOptions
from prior_sg.services.ingest.core.poses import PoseError
from prior_sg.services.ingest.core.ros.assembly import Assembly, Rules, Shot
from prior_sg.services.ingest.core.ros.motions import Motions
from prior_sg.services.ingest.core.ros.posing import Way
from prior_sg.services.ingest.core.ros.topics import Topic
from prior_sg.services.ingest.core.ros.transforms import Stamped
from prior_sg.services.ingest.core.selection import State
from prior_sg.services.ingest.service import step
from prior_sg.services.ingest.sources import Source, SourceError, open_source
from prior_sg.services.ingest.sources.ros.eyes import robot_of
from prior_sg.services.ingest.sources.ros.live import Due
from prior_sg.services.ingest.sources.ros.look import Look
from prior_sg.services.ingest.sources.ros.reader import robot_types
from prior_sg.services.ingest.sources.ros.stream import Stream
from prior_sg.services.runtime.ros.session import Received
from prior_sg.services.runtime.ros.wire import PUBLISHER, Attachment, Channel, Entity
from tests.help.bags import COLOR, DEPTH, INFO, OPTICAL, Maker
from tests.help.robot import Robot, shifted
from tests.help.walked import (
    MS,
    NEAR,
    STAMPS_NS,
    WALK,
    WORLD_FROM_BASE,
    add_images,
    add_statics,
    assert_the_walk,
    keyframes,
    motion,
    whole,
)

MUTATIONS = int(os.environ.get("PSG_TEST_MUTATIONS", "500"))
FRAMES = (RawFrame, BadFrame)
ATTACHMENT = Attachment(1, 2, bytes(16))


class Wire:
    """A session with a robot that is not there: its messages are handed over by hand."""

    def __init__(self, maker):
        self.types = {topic: message.__msgtype__ for topic, _, message in maker.messages}
        self.on = {}

    def entities(self):
        channels = [Channel(topic, name, "RIHS01_x") for topic, name in self.types.items()]
        return [Entity(PUBLISHER, 0, "a", 0, 1, "robot", channel=channel) for channel in channels]

    def subscribe(self, channel, on_received, on_fault):
        self.on[channel.name] = on_received

    def deliver(self, messages):
        for message in messages:
            self.on[message.topic](message)


def received(maker, shift_s=0):
    """A recording's messages as they come off the wire."""
    ordered = sorted(maker.messages, key=lambda entry: entry[1])
    pairs = [(topic, bytes(maker.store.serialize_cdr(m, m.__msgtype__)), at_ns) for topic, at_ns, m in ordered]
    return [Received(topic, shifted(data, topic, shift_s), ATTACHMENT, at_ns) for topic, data, at_ns in pairs]


def robot_heard(maker, **options):
    """What a look at a robot that plays this finds."""
    session, types = Wire(maker), robot_types()
    look = Look(session, types)
    look.listen(0)
    session.deliver(received(maker))
    look.listen(0)
    return robot_of(look, types, Path("ros2:"), ReadOptions(**options))


def streamed(robot, messages, wanted=lambda view: True):
    """Events of messages that come one by one, and of the end."""
    stream = Stream(robot, wanted, threading.Event(), clock_ns=lambda: 0)  # patience has no end
    listened = {topic.name for topic in robot.topics}
    events = [event for message in messages if message.topic in listened for event in stream.take([message], [])]
    return [*events, *stream.rest()]


@pytest.fixture(scope="module")
def walked():
    return whole("mcap")


def test_the_frames_of_the_bag_come_out_whatever_the_order_on_the_way(walked, tmp_path, rng):
    recorded = list(open_source(walked.write(tmp_path)))
    messages, robot = received(walked), robot_heard(walked)
    for late_ms in (0, 40, 300, 900):
        late_ns = {topic: MS * late_ms * rng.random() for topic in {message.topic for message in messages}}
        by_arrival = sorted(messages, key=lambda message: message.received_ns + late_ns[message.topic])
        frames = [event for event in streamed(robot, by_arrival) if isinstance(event, FRAMES)]
        assert_the_walk(frames)
        for one, other in zip(frames, recorded, strict=True):
            assert (one.frame_id, one.color, one.depth) == (other.frame_id, other.color, other.depth)
            assert np.array_equal(one.world_from_camera, other.world_from_camera)


def test_a_colour_image_waits_for_the_closest_depth_image():
    motions = Motions()
    assembly = Assembly(Rules.of_images(Way("camera", topic="/pose", body="camera"), 20 * MS), motions)
    motions.take(Topic("/pose", "geometry_msgs/msg/PoseStamped", 1, 0), [pose_at(0), pose_at(1000)])
    colors = [Shot(at_ms * MS, 0, b"color") for at_ms in (100, 150, 200)]
    depths = [Shot(at_ms * MS, 0, b"depth") for at_ms in (85, 102, 149, 185, 240)]
    for shot in (depths[0], colors[0]):
        (assembly.depth if shot in depths else assembly.color)(shot)
        assert list(assembly.ready(0)) == []
    for depth, color in zip(depths[1:], [*colors[1:], None, None], strict=True):
        assembly.depth(depth)
        if color:
            assembly.color(color)
    frames = list(assembly.ready(0))
    assert [(f.color.stamp_ns // MS, f.depth.stamp_ns // MS) for f in frames] == [(100, 102), (150, 149)]
    (last,) = assembly.ready(0, ended=True)
    assert last.depth is depths[3]
    assert sorted({fault.what for fault in assembly.faults()}) == ["depth images"]


def pose_at(at_ms):
    return Stamped(at_ms * MS, "world", "", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))


def test_images_are_decoded_only_of_frames_that_may_become_keyframes(walked):
    robot, cfg = robot_heard(walked), Config(min_translation_m=0.12, min_rotation_deg=8.0)
    frames = [e for e in streamed(robot, received(walked), Due(cfg)) if isinstance(e, FRAMES)]
    every = [e for e in streamed(robot, received(walked)) if isinstance(e, FRAMES)]
    ours, theirs = keyframes(frames, cfg), keyframes(every, cfg)
    assert len(ours) < len(frames) == len(WALK) and any(not frame.color for frame in frames)
    assert [(k.frame_id, k.color, k.depth) for k in ours] == [(k.frame_id, k.color, k.depth) for k in theirs]


def test_poses_of_odometry_and_of_arrival(tmp_path):
    maker = Maker("mcap")
    add_statics(maker)
    add_images(maker)
    for stamp_ns, base in zip(STAMPS_NS, WORLD_FROM_BASE, strict=True):
        maker.add("/odom", stamp_ns, maker.odometry(stamp_ns, "odom", "base", base))
    robot = robot_heard(maker)
    assert any("/odom (Odometry of base)" in note for note in robot.notes)
    assert_the_walk([e for e in streamed(robot, received(maker)) if isinstance(e, FRAMES)])
    stampless = Maker("mcap")
    for stamp_ns, (topic, _, message) in [(m[1], m) for m in maker.messages if m[0] in (COLOR, DEPTH)]:
        message.header.stamp = stampless.types["builtin_interfaces/msg/Time"](0, 0)
        stampless.add(topic, stamp_ns - (9 if topic == COLOR else 7) * MS, message)
    for stamp_ns, pose in zip(STAMPS_NS, WALK, strict=True):
        stampless.add("/pose", stamp_ns, stampless.pose(0, "world", pose))
    stampless.messages += [m for m in maker.messages if m[0] == INFO]
    with pytest.raises(SourceError, match="have no stamps; give --clock received"):
        robot_heard(stampless)
    robot = robot_heard(stampless, clock="received")
    assert_the_walk([e for e in streamed(robot, received(stampless)) if isinstance(e, FRAMES)])


@pytest.mark.parametrize(
    ("without", "reason"),
    [
        (DEPTH, "it has no depth images"),
        (INFO, "has no camera info for its colour images: give --info-topic"),
        ("/tf", "nothing says how the camera moves"),
    ],
)
def test_what_a_robot_lacks_is_one_sentence(walked, without, reason):
    lacking = Maker("mcap")
    lacking.messages = [message for message in walked.messages if message[0] != without]
    with pytest.raises((SourceError, ValueError), match=reason):
        robot_heard(lacking)


def words(events):
    return {event.example for event in events if isinstance(event, Unused)}


def test_loops_late_partners_and_clocks_that_go_back_are_told(walked):
    robot, messages = robot_heard(walked), received(walked)
    loop = Maker("mcap")
    loop.add("/tf", STAMPS_NS[0], loop.tf(loop.transform(STAMPS_NS[0], "base", "map", np.eye(4))))
    told = words(streamed(robot, [*messages[:30], *received(loop), *messages[30:]]))
    assert any(said.startswith("tf is a loop: ") for said in told)
    told = words(streamed(robot, [m for i, m in enumerate(messages) if m.topic != DEPTH or i % 2]))
    assert told == {"no depth image lies within 20 ms of it"}
    told = words(streamed(robot, [m for m in messages if m.topic != "/tf" or m.received_ns < STAMPS_NS[4]]))
    assert told == {"tf of base: no pose lies within 20 ms of it"}
    again = [*messages, *received(walked, shift_s=-600)]
    events = streamed(robot, again)
    assert {said for said in words(events) if "went back by 600.900 s" in said}
    state, cfg = State(robot="r", epoch=0), Config()
    for event in events:
        list(step(state, event, cfg))
    assert any(loss.what == "clock jumps" for loss in state.losses.told)
    assert state.read > 1.5 * len(WALK)


def test_a_jump_of_the_map_moves_the_keyframes_before_it(walked):
    """The robot believes itself 30 cm and 4 degrees off in the end; closing the loop puts all keyframes right."""
    jumped, count = Maker("mcap"), len(STAMPS_NS)
    add_statics(jumped)
    add_images(jumped)
    after = motion(0.3, -0.1, 0.0, 4, 0, 0)
    for i, (stamp_ns, base) in enumerate(zip(STAMPS_NS, WORLD_FROM_BASE, strict=True)):
        corrected = after if i == count - 1 else np.eye(4)
        for topic, parent, child, pose in (("/tf", "map", "odom", corrected), ("/tf", "odom", "base", base)):
            jumped.add(topic, stamp_ns, jumped.tf(jumped.transform(stamp_ns, parent, child, pose)))
    robot, cfg = robot_heard(jumped), NEAR
    events = streamed(robot, received(jumped))
    (closure,) = [event for event in events if isinstance(event, Closure)]
    assert events.index(closure) == [isinstance(e, RawFrame) for e in events].index(True) + count - 1
    state = State(robot="r", epoch=4)
    outputs = [output for event in events for output in step(state, event, cfg)]
    (update,) = [message for topic, message in outputs if topic is POSE_UPDATE]
    moved_m = [
        np.linalg.norm(pose[:3, 3] - WALK[number][:3, 3])
        for number, pose in zip(update.frame_ids, update.world_from_camera, strict=True)
    ]
    assert (update.epoch, update.revision, update.stamp_ns) == (4, 0, STAMPS_NS[-1])
    assert moved_m[0] < 1e-9 and moved_m == sorted(moved_m)
    last = update.world_from_camera[-1] @ inverse(after @ WALK[update.frame_ids[-1]])
    assert np.linalg.norm(last[:3, 3]) < 0.15  # the last keyframe lies a little before the jump
    assert state.rejected == 0  # what is after the jump is no jump of the camera


def sentences(events):
    """What is said of faults."""
    return {getattr(event, "example", "") or event.reason for event in events if isinstance(event, Unused | BadFrame)}


@pytest.mark.parametrize("body", ["base", ""])
def test_optimised_poses_of_a_graph_correct_every_frame(walked, body):
    """Nodes at every third frame, the world turned and moved: all frames stand where that puts them."""
    after, maker = motion(0.4, 0.2, 0.0, 25, 0, 0), Maker("mcap")
    poses = WORLD_FROM_BASE if body else WALK
    nodes = [maker.pose(STAMPS_NS[i], "map", after @ poses[i]) for i in range(0, len(WALK), 3)]
    late = maker.types["nav_msgs/msg/Path"](maker.header(STAMPS_NS[-1], "map"), nodes)
    maker.messages = [*walked.messages, ("/graph", STAMPS_NS[-1] + 500 * MS, late)]
    robot = robot_heard(maker, graph_topic="/graph", pose_frame=body)
    empty = maker.types["nav_msgs/msg/Path"](maker.header(0, "map"), [])
    messages = received(maker)
    said = replace(messages[-1], payload=bytes(maker.store.serialize_cdr(empty, "nav_msgs/msg/Path")))
    events = streamed(robot, [*messages, messages[-1], said])
    (update,) = [event for event in events if isinstance(event, Correction)]
    assert not any(isinstance(event, Closure) for event in events)
    assert words(events) == {"no pose of the graph has the stamp of a frame"}
    assert update.frame_ids.tolist() == list(range(len(WALK)))
    for pose, walk_pose in zip(update.world_from_camera, WALK, strict=True):
        assert np.abs(pose - after @ walk_pose).max() < 1e-6


def test_of_a_long_run_the_newest_frames_are_corrected(walked, monkeypatch):
    monkeypatch.setattr("prior_sg.services.ingest.sources.ros.stream.MOST_FRAMES", 4)
    maker, after = Maker("mcap"), motion(0.4, 0.2, 0.0, 25, 0, 0)
    nodes = [
        maker.pose(stamp_ns, "map", after @ base) for stamp_ns, base in zip(STAMPS_NS, WORLD_FROM_BASE, strict=True)
    ]
    path = maker.types["nav_msgs/msg/Path"](maker.header(STAMPS_NS[-1], "map"), nodes)
    maker.messages = [*walked.messages, ("/graph", STAMPS_NS[-1] + 500 * MS, path)]
    messages, robot = received(maker), robot_heard(maker, graph_topic="/graph", pose_frame="base")
    (update,) = [event for event in streamed(robot, [*messages, messages[-1]]) if isinstance(event, Correction)]
    assert update.frame_ids.tolist() == list(range(len(WALK) - 4, len(WALK)))
    assert np.abs(update.world_from_camera[-1] - after @ WALK[-1]).max() < 1e-6


def test_a_graph_of_poses_that_nobody_publishes_yet_is_listened_to(walked):
    robot = robot_heard(walked, graph_topic="graph/late")
    assert [(topic.name, topic.type) for topic in robot.topics][-1] == ("/graph/late", "nav_msgs/msg/Path")
    names = {topic.name for topic in robot_heard(two_without_tf_static(walked)).topics}
    assert {"/tf", "/tf_static"} <= names


def two_without_tf_static(walked):
    """The camera's own frame moves in /tf, and nobody has published on /tf_static yet."""
    maker = Maker("mcap")
    maker.messages = [message for message in walked.messages if not message[0].startswith("/tf")]
    for stamp_ns, pose in zip(STAMPS_NS, WALK, strict=True):
        maker.add("/tf", stamp_ns, maker.tf(maker.transform(stamp_ns, "map", OPTICAL, pose)))
    return maker


def test_mutated_messages_cost_themselves_and_one_sentence(walked, rng):
    """PSG_TEST_MUTATIONS=50000 for the long proof."""
    robot = robot_heard(walked)
    listened = {topic.name for topic in robot.topics}
    messages = [message for message in received(walked) if message.topic in listened]
    stream, said = Stream(robot, lambda view: True, threading.Event()), set()
    for number in range(MUTATIONS):
        whole_one = messages[number % len(messages)]
        said |= sentences(stream.take([replace(whole_one, payload=mutated(rng, whole_one.payload))], []))
    said |= sentences(stream.rest())
    assert len(said) > 5
    assert not [text for text in said if not 10 < len(text) < 400 or "\n" in text]
    stream = Stream(robot, lambda view: True, threading.Event())
    frames = [e for e in (*stream.take(messages, []), *stream.rest()) if isinstance(e, RawFrame)]
    assert len(frames) == len(WALK)


def test_a_look_at_mutated_messages_ends_with_a_robot_or_one_sentence(walked, rng):
    messages, types, found = received(walked), robot_types(), 0
    for _ in range(max(12, MUTATIONS // 200)):
        session = Wire(walked)
        look = Look(session, types)
        look.listen(0)
        wrong = [m if rng.random() < 0.7 else replace(m, payload=mutated(rng, m.payload)) for m in messages]
        session.deliver(wrong)
        look.listen(0)
        try:
            robot_of(look, types, Path("ros2:"), ReadOptions())
            found += 1
        except (SourceError, PoseError, ValueError) as error:
            assert 10 < len(str(error)) < 500 and "\n" not in str(error)
    assert found


def mutated(rng, data):
    """Cut off, lengthened, a few bytes changed, or its numbers replaced."""
    changed, kind = bytearray(data), rng.integers(5)
    if kind == 0:
        return bytes(changed[: rng.integers(0, len(changed))])
    if kind == 1:
        return bytes(changed) + rng.bytes(int(rng.integers(1, 64)))
    if kind == 2:
        for place in rng.integers(0, min(len(changed), 200), int(rng.integers(1, 12))):
            changed[place] = rng.integers(256)
    if kind == 3:
        place = 4 * int(rng.integers(0, min(len(changed), 120) // 4))
        changed[place : place + 4] = struct.pack("<i", int(rng.choice([-1, 0, 2**31 - 1, -(2**31), 1 << 20])))
    if kind == 4:
        place = 8 * int(rng.integers(0, len(changed) // 8))
        changed[place : place + 8] = struct.pack("<d", float(rng.choice([np.nan, np.inf, -1e300, 0.0])))
    return bytes(changed)


def test_a_fault_of_our_own_is_not_waited_for(endpoint, walked, monkeypatch):
    def broken(*_):
        raise ValueError("shapes do not match")

    monkeypatch.setattr("prior_sg.services.ingest.sources.ros.live.robot_of", broken)
    monkeypatch.setattr("prior_sg.services.ingest.sources.ros.live.LOOK_S", 0.0)
    with pytest.raises(ValueError, match=r"^shapes do not match$"):
        open_source(f"ros2:/{endpoint}")


def test_a_robot_on_a_router_is_read_like_its_bag(endpoint, walked, capsys):
    player = Robot(endpoint, walked, 11)
    address = f"ros2:/{endpoint}"
    try:
        with player.rehearsing():
            source = open_source(address, options=ReadOptions(ros_domain=11, end_after_s=6.0))
            assert main(["ros", "topics", address, "--domain", "11", "--seconds", "0.8", "--json"]) == 0
        listed = {topic["topic"]: topic for topic in json.loads(capsys.readouterr().out)}
        assert (listed[COLOR]["encoding"], listed[COLOR]["frame"]) == ("rgb8", OPTICAL)
        assert listed["/tf_static"]["serves_as"] == "fixed transforms"
        assert (source.layout, source.total) == ("ros2", 0)
        assert any("colour /camera/color/image_raw (rgb8), depth" in note for note in source.notes)
        playing = threading.Thread(
            target=lambda: (player.wait_for_reader([COLOR, DEPTH, "/tf", "/tf_static"]), player.play(statics=False))
        )
        playing.start()
        assert_the_walk(source)
        playing.join()
        threading.Timer(0.3, source.close).start()
        begun_s = time.monotonic()
        assert list(source) == [] and time.monotonic() - begun_s < 5.0  # not until the end of its patience
    finally:
        player.close()


class Port:
    """A host that takes all at once."""

    def __init__(self):
        self.stopping, self.consumed = asyncio.Event(), []

    async def consume(self, message):
        self.consumed.append(message)

    async def room(self, window):
        raise AssertionError("a robot waits for nobody")


def test_a_robot_is_waited_for_read_without_pace_and_left_at_once(walked, monkeypatch):
    robot, stop, asked = robot_heard(walked), threading.Event(), []
    frames = [event for event in streamed(robot, received(walked)) if isinstance(event, RawFrame)]

    def live():
        yield from frames
        stop.wait(20)

    def opened(cfg):
        asked.append(cfg.source)
        if len(asked) < 3:
            raise SourceError("nobody is there")
        intrinsics = robot.normaliser.intrinsics
        return Source("ros2", Path("ros2:"), intrinsics, 0, live, live=live, close=stop.set)

    async def driven():
        port = Port()
        driving = asyncio.create_task(service.drive(port, Config(source="ros2:/", speed=0.01)))
        while len(port.consumed) < len(frames):
            await asyncio.sleep(0.01)
        port.stopping.set()
        await asyncio.wait_for(driving, 2)
        return port.consumed

    monkeypatch.setattr(service, "_open", opened)
    monkeypatch.setattr(service, "SEARCH_S", 0.01)
    assert asyncio.run(driven()) == frames and asked == ["ros2:/"] * 3


def test_where_no_robot_is_the_sentence_says_what_to_do(endpoint, monkeypatch):
    monkeypatch.setattr("prior_sg.services.ingest.sources.ros.live.LOOK_S", 0.3)
    with pytest.raises(SourceError, match=r"it has no colour images; .*nobody publishes on domain 12\)"):
        open_source(f"ros2:/{endpoint}", options=ReadOptions(ros_domain=12))
    with pytest.raises(SourceError, match="leave out --rate"):
        open_source("ros2:/", options=ReadOptions(rate_hz=5))
    with pytest.raises(SourceError, match="the domain 999 is not from 0 to 232"):
        open_source(f"ros2:/{endpoint}", options=ReadOptions(ros_domain=999))

"""Robots on a router: a lidar with and without a camera, several cameras, publishers that come and go."""

import asyncio
import threading
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rosbags")

from prior_sg.deploy.sample.packed import keyframe_of, pack_source
from prior_sg.schemas.topics import KEYFRAME
from prior_sg.services.ingest.core import selection
from prior_sg.services.ingest.core.config import Config
from prior_sg.services.ingest.core.frames import RawFrame
from prior_sg.services.ingest.core.options import ReadOptions
from prior_sg.services.ingest.service import drive, step
from prior_sg.services.ingest.sources import LastingError, SourceError, open_source
from prior_sg.services.place_graph.core.trajectory import Bounds, Trajectory
from prior_sg.services.place_graph.core.volume.grid import OCCUPIED
from prior_sg.services.registry import BY_NAME
from prior_sg.services.runtime.runner import Runner
from tests.help.bags import Maker
from tests.help.long import long_run
from tests.help.robot import Robot
from tests.help.room import CAMERA
from tests.help.two_eyed import NAMES, REAR_CAMERA, add_camera, base_of, two_eyed
from tests.help.walked import STAMPS_NS, WORLD_FROM_BASE
from tests.services.ingest.test_clouds import cloud, driven, livox


def read(endpoint, maker, domain, count, **options):
    """So many frames of a robot that plays this, once it was looked at, and the source."""
    player = Robot(endpoint, maker, domain)
    try:
        with player.rehearsing():
            told = Config(ros_domain=domain, end_after_s=20.0, every_frame=True, **options)
            source = open_source(f"ros2:/{endpoint}", options=told)
        topics = {topic for topic, _, _ in maker.messages if topic.endswith(("tf", "points", "image_raw"))}
        playing = threading.Thread(target=lambda: (player.wait_for_reader(topics), player.play(statics=False)))
        playing.start()
        frames = []
        for frame in source:
            frames += [frame] if isinstance(frame, RawFrame) else []
            if len(frames) == count:
                source.close()
        playing.join()
        return frames, source
    finally:
        player.close()


def assert_alike(frames, recorded):
    assert len(frames) == len(recorded)
    for one, other in zip(frames, recorded, strict=True):
        assert (one.frame_id, one.stamp_ns, one.camera) == (other.frame_id, other.stamp_ns, other.camera)
        assert (one.color, one.depth, one.intrinsics) == (other.color, other.depth, other.intrinsics)
        assert np.abs(one.world_from_camera - other.world_from_camera).max() < 1e-9


@pytest.mark.parametrize(
    ("pictures", "message", "domain"),
    [
        pytest.param(True, cloud, 21, marks=long_run),
        pytest.param(False, cloud, 22, marks=long_run),
        pytest.param(True, livox, 23, marks=long_run),
    ],
)
def test_clouds_of_a_robot_give_the_frames_of_their_recording(endpoint, tmp_path, pictures, message, domain):
    maker = driven(pictures=pictures, message=message)
    recorded = [frame for frame in open_source(maker.write(tmp_path)) if isinstance(frame, RawFrame)]
    frames, source = read(endpoint, maker, domain, len(recorded))
    assert any("depth of /points" in note for note in source.notes), source.notes
    assert_alike(frames, recorded)


def mapped(keyframes):
    """Voxels of walls and furniture; nothing is refused."""
    with Runner(BY_NAME["place_graph"]) as place_graph:
        place_graph.feed(*keyframes)
        assert not place_graph.state.refused
        return set(map(tuple, place_graph.state.grid.voxels_with(OCCUPIED).tolist()))


def test_two_cameras_of_a_recording_give_the_map_of_both(tmp_path):
    path = two_eyed().write(tmp_path)
    source = open_source(path, options=ReadOptions(cameras="all"))
    frames = [frame for frame in source if isinstance(frame, RawFrame)]
    assert [frame.frame_id for frame in frames] == list(range(2 * len(STAMPS_NS)))
    assert (np.diff([frame.stamp_ns for frame in frames]) > 0).all()
    for i, frame in enumerate(frames):
        camera = CAMERA if frame.camera == NAMES["front"] else REAR_CAMERA
        assert frame.intrinsics == camera and frame.stamp_ns - STAMPS_NS[i // 2] in (0, 1)
        assert np.abs(base_of(frame) - WORLD_FROM_BASE[i // 2]).max() < 1e-6
    state = selection.State(robot="r")
    told = [one for frame in frames for one in step(state, frame, Config(every_frame=True))]
    keyframes = [message for topic, message in told if topic is KEYFRAME]
    assert (len(keyframes), state.rejected) == (len(frames), 0)
    both, front, rear = mapped(keyframes), *(mapped([k for k in keyframes if k.camera == NAMES[s]]) for s in NAMES)
    assert len(front | rear) > 1.3 * max(len(front), len(rear))
    assert len(both & (front | rear)) > 0.95 * len(front | rear)


def test_one_camera_is_read_unless_more_are_asked_for(tmp_path):
    path = two_eyed().write(tmp_path)
    source = open_source(path)
    assert {frame.camera for frame in source} == {""} and source.total == len(STAMPS_NS)
    assert any("--cameras all reads every camera" in note for note in source.notes)
    named = open_source(path, options=ReadOptions(cameras="rear/color/image_raw"))
    assert {frame.camera for frame in named} == {NAMES["rear"]}
    with pytest.raises(SourceError, match="--color-topic side/color is not in it"):
        open_source(path, options=ReadOptions(cameras="side/color"))
    with pytest.raises(ValueError, match="with --cameras leave out"):
        ReadOptions(cameras="all", depth_topic="/rear/depth/image_raw")


def test_a_packed_log_of_two_cameras_gives_the_same_frames(tmp_path):
    source = open_source(two_eyed().write(tmp_path), options=ReadOptions(cameras="all"))
    assert not pack_source(source.path, tmp_path / "log.mcap", options=ReadOptions(cameras="all"))[1]
    assert_alike(list(open_source(tmp_path / "log.mcap")), list(source))


def test_two_cameras_of_a_robot_come_in_the_order_of_their_stamps(endpoint, tmp_path):
    maker = two_eyed()
    recorded = list(open_source(maker.write(tmp_path), options=ReadOptions(cameras="all")))
    frames, _ = read(endpoint, maker, 24, len(recorded), cameras="all")
    assert_alike(frames, recorded)


def test_a_jump_of_one_camera_is_refused_and_its_change_to_the_other_is_none():
    frames = [frame for i in range(6) for frame in (shown(i, "a", 0.0), shown(i, "b", 9.0))]
    state, cfg = selection.State(robot="r"), Config(every_frame=True, max_speed_m_s=2.0)
    for frame in frames:
        list(step(state, frame, cfg))
    assert (state.keyframes, state.rejected) == (12, 0)
    list(step(state, shown(6, "a", 9.0), cfg))
    assert state.rejected == 1
    place_graph = Trajectory()
    bounds = Bounds(max_speed_m_s=2.0, slack_m=0.5)
    for frame in frames:
        keyframe = keyframe_of(frame, "r", b"", b"")
        assert not place_graph.jump_m(keyframe, bounds)
        place_graph.believe(keyframe)
    assert place_graph.jump_m(keyframe_of(shown(6, "a", 9.0), "r", b"", b""), bounds)


def shown(number, camera, x_m):
    pose = np.eye(4)
    pose[0, 3] = x_m
    return RawFrame(
        frame_id=2 * number + (camera == "b"), stamp_ns=number * 10**8 + (camera == "b"), intrinsics=CAMERA,
        world_from_camera=pose, color=b"", depth=b"", depth_scale_m=0.001, index=0, total=0, camera=camera,
    )  # fmt: skip


def test_a_publisher_that_comes_back_and_a_camera_that_comes_late_are_read(endpoint):
    """The rear camera and all publishers of the front one die and come again in other sessions."""
    maker = two_eyed()
    front, rear = two_eyed(sides=("front",)), Maker("mcap")
    add_camera(rear, "rear")
    player, stop = Robot(endpoint, front, 25), threading.Event()
    told = Config(ros_domain=25, end_after_s=20.0, every_frame=True, cameras="all")
    with player.rehearsing():
        source = open_source(f"ros2:/{endpoint}", options=told)
    assert {topic for topic, _, _ in front.messages} <= {topic for topic, _, _ in maker.messages}
    seen, back = [], []

    def play():
        player.wait_for_reader([NAMES["front"]])
        player.close()
        again = Robot(endpoint, maker, 25)
        back.append(again)
        for number in range(1000):
            if stop.is_set():
                return
            again.play(seconds=20 * number, statics=number == 0)

    playing = threading.Thread(target=play)
    playing.start()
    for event in source.events():
        seen.append(event)
        if {event.camera for event in seen if isinstance(event, RawFrame)} >= set(NAMES.values()):
            source.close()
    stop.set()
    playing.join()
    back[0].close()
    frames = [event for event in seen if isinstance(event, RawFrame)]
    assert {frame.camera for frame in frames} == set(NAMES.values())
    assert [frame.frame_id for frame in frames] == list(range(len(frames)))


@pytest.mark.parametrize(
    ("source", "told", "said"),
    [
        ("ros2:/", {"rate_hz": 5.0}, "leave out --rate"),
        ("ros2:/", {"ros_domain": 999}, "the domain 999"),
        ("ros2:/nonsense", {}, "--connect takes PROTOCOL/HOST:PORT"),
    ],
)
def test_what_waiting_does_not_mend_ends_the_search_for_a_robot(source, told, said):
    port = SimpleNamespace(stopping=asyncio.Event())
    with pytest.raises(SourceError, match=said):
        asyncio.run(asyncio.wait_for(drive(port, Config(source=source, **told)), 20))


def test_a_told_topic_of_a_type_that_cannot_serve_is_not_waited_for(monkeypatch):
    from tests.services.ingest.test_ros_live import robot_heard

    with pytest.raises(LastingError, match=r"--pose-topic /front/color/camera_info .* cannot serve"):
        robot_heard(two_eyed(), pose_topic="/front/color/camera_info")

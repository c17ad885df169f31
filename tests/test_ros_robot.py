"""A node of ROS 2 itself drives the whole pipeline: the scene of the same frames read from a file."""

import os
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

pytest.importorskip("rosbags")
pytest.importorskip("rclpy")

import prior_sg
from prior_sg.schemas.topics import KEYFRAME
from prior_sg.services.ingest.core.options import ReadOptions
from prior_sg.services.ingest.sources import open_source
from prior_sg.services.runtime.record import LogWriter, read_log
from prior_sg.services.runtime.ros.session import RosSession
from prior_sg.services.runtime.ros.wire import SUBSCRIPTION
from tests.help.long import long_run
from tests.help.paths import ROOT, SAMPLE

FRAMES = 2
SPACE = "conse/efficientnet-lite0/minilm-l6-v2"  # the smallest that the extras bring
TYPES = {
    "/camera/color/image_raw/compressed": "sensor_msgs/msg/CompressedImage",
    "/camera/depth/image_raw/compressedDepth": "sensor_msgs/msg/CompressedImage",
    "/camera/color/camera_info": "sensor_msgs/msg/CameraInfo",
    "/pose": "geometry_msgs/msg/PoseStamped",
}


@pytest.fixture
def log(tmp_path):
    with LogWriter(tmp_path / "walk.mcap") as writer:
        for logged, _ in zip(read_log(SAMPLE, [KEYFRAME]), range(FRAMES), strict=False):
            sender = logged.writer, logged.sequence, logged.sent_ns, logged.received_ns
            writer.add(logged.topic, logged.key, logged.payload, *sender)
    return tmp_path / "walk.mcap"


def started(module, *arguments):
    """A process of ROS 2, which hears and is heard on this host only."""
    env = os.environ | {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp"}
    env |= {"ROS_DOMAIN_ID": str(40 + os.getpid() % 60), "PYTHONPATH": f"{ROOT}:{ROOT / 'src'}"}
    command = [sys.executable, "-m", module, *map(str, arguments)]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=env, cwd=ROOT)


def scene_of(source):
    settings = {"ingest.every_frame": True, "feature_pyramid.space": SPACE, "segmenter.space": SPACE}
    with prior_sg.Mapper("residential home", "serve drinks to guests", settings=settings) as mapper:
        mapper.read(source)
        scene = mapper.scene
        assert mapper.progress.keyframes == FRAMES and mapper.progress.rejected == 0
        return scene


@long_run
def test_a_node_of_ros_gives_the_scene_of_the_file(log, endpoint):
    relay = started("tests.help.relay", endpoint, *(f"{topic}={name}" for topic, name in TYPES.items()))
    robot = started("tests.help.rclpy_robot", log, FRAMES)
    try:
        assert relay.stdout.readline() == "ready\n"
        source = open_source(f"ros2:/{endpoint}", options=ReadOptions(end_after_s=6.0))
        assert any("poses of /pose (PoseStamped of camera)" in note for note in source.notes)
        say(robot, "stop")
        playing = threading.Thread(target=say_play, args=(robot, endpoint))
        playing.start()
        live = scene_of(source)
        playing.join()
    finally:
        for process in (relay, robot):
            process.kill()
            process.wait()
    filed = scene_of(open_source(log))
    assert live.places.ids.tolist() == filed.places.ids.tolist() and len(live.places.ids) >= 5
    assert np.abs(live.places.positions_m - filed.places.positions_m).max() < 1e-6
    assert live.places.labels.tolist() == filed.places.labels.tolist()
    assert live.regions.labels.tolist() == filed.regions.labels.tolist() and len(live.regions) > 0
    assert live.regions.place_counts.tolist() == filed.regions.place_counts.tolist()


def say(process, word):
    process.stdin.write(f"{word}\n")
    process.stdin.flush()


def say_play(robot, endpoint):
    """Once the source listens, let the node play."""
    wanted = set(TYPES) - {"/camera/color/camera_info"}
    with RosSession(endpoint, "watcher") as watcher:
        for _ in range(1200):
            heard = {entity.channel.name for entity in watcher.entities() if entity.kind == SUBSCRIPTION}
            if wanted <= heard:
                break
            time.sleep(0.05)
    time.sleep(0.2)
    say(robot, "play")

"""`python -m prior_sg.deploy.benches.live_robot --seconds 60`: a robot at 30 Hz through the whole pipeline.

Plays frames of a source (the sample's) on a Zenoh router as raw messages of ROS 2, RGB and depth, with a pose each, and
runs all services on it. A frame stays for half a second, as a robot stands that looks around. Prints one JSON object.
"""

import argparse
import itertools
import json
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from scipy.spatial.transform import Rotation

from prior_sg.deploy.running.job import Job, run
from prior_sg.deploy.sample import SAMPLE
from prior_sg.deploy.settings import DEMO_ENVIRONMENT, DEMO_TASK
from prior_sg.deploy.terminal import Terminal
from prior_sg.schemas.codec import decode
from prior_sg.schemas.features import Pyramid
from prior_sg.schemas.regions import RegionDelta
from prior_sg.schemas.topics import PYRAMID, REGION_DELTA
from prior_sg.services.ingest.core.frames import RawFrame
from prior_sg.services.ingest.core.pixels import eight_bit, stored
from prior_sg.services.ingest.core.ros.topics import CAMERA_INFO, IMAGE
from prior_sg.services.ingest.sources import open_source
from prior_sg.services.runtime.bus import Sample
from prior_sg.services.runtime.client import BusClient
from prior_sg.services.runtime.ros.session import RosSession
from prior_sg.services.runtime.ros.types import Types, shared_types
from prior_sg.services.runtime.ros.wire import Channel
from prior_sg.services.runtime.zenoh_bus import ZenohBus
from prior_sg.services.runtime.zenoh_router import open_free_router

RATE_HZ, HELD = 30.0, 15
END_AFTER_S = 3.0
COLOR, DEPTH, INFO, POSE = "/camera/image_raw", "/camera/depth/image_raw", "/camera/camera_info", "/pose"
POSE_STAMPED = "geometry_msgs/msg/PoseStamped"
CHANNELS = {COLOR: IMAGE, DEPTH: IMAGE, INFO: CAMERA_INFO, POSE: POSE_STAMPED}


class Player(threading.Thread):
    """Publishes frames at a rate, until told to stop."""

    def __init__(self, endpoint: str, frames: list[RawFrame]) -> None:
        super().__init__(daemon=True)
        self.stopped, self.sent, self.late_s = threading.Event(), 0, 0.0
        self._endpoint, self._types = endpoint, shared_types()
        self._frames = [self._messages(frame) for frame in frames]

    def run(self) -> None:
        """Play there and back, so that no pose jumps."""
        to_and_fro = itertools.cycle([*self._frames, *self._frames[-2:0:-1]])
        with RosSession(self._endpoint, "camera") as session:
            channels = {topic: Channel(topic, name, self._types.hash(name)) for topic, name in CHANNELS.items()}
            publishers = {topic: session.publisher(channel) for topic, channel in channels.items()}
            begun_s = time.monotonic()
            for messages in to_and_fro:
                for _ in range(HELD):
                    due_s = begun_s + self.sent / RATE_HZ
                    self.late_s = max(self.late_s, time.monotonic() - due_s)
                    if self.stopped.wait(max(0.0, due_s - time.monotonic())):
                        return
                    stamp = self._types.make("builtin_interfaces/msg/Time", *divmod(time.time_ns(), 10**9))
                    for topic, message in messages.items():
                        message.header.stamp = stamp
                        publishers[topic].publish(self._types.encode(message))
                    self.sent += 1

    def _messages(self, frame: RawFrame) -> dict[str, Any]:
        make = self._types.make
        color = np.ascontiguousarray(eight_bit(frame.color))
        depth = np.rint(stored(frame.depth) * frame.depth_scale_m * 1000).astype(np.uint16)
        size = (frame.intrinsics.height_px, frame.intrinsics.width_px)
        images = (("bgr8", color, 3), ("16UC1", depth, 2))
        color_message, depth_message = (
            make(
                IMAGE,
                _header(self._types, "camera"),
                *size,
                said,
                0,
                size[1] * width,
                pixels.reshape(-1).view(np.uint8),
            )
            for said, pixels, width in images
        )
        pose = np.array(frame.world_from_camera)
        turn = make("geometry_msgs/msg/Quaternion", *Rotation.from_matrix(pose[:3, :3]).as_quat().tolist())
        place = make("geometry_msgs/msg/Point", *pose[:3, 3].tolist())
        posed = make(POSE_STAMPED, _header(self._types, "world"), make("geometry_msgs/msg/Pose", place, turn))
        return {COLOR: color_message, DEPTH: depth_message, INFO: _info(self._types, frame), POSE: posed}


def _header(types: Types, frame: str) -> Any:
    return types.make("std_msgs/msg/Header", types.make("builtin_interfaces/msg/Time", 0, 0), frame)


def _info(types: Types, frame: RawFrame) -> Any:
    camera = frame.intrinsics
    fx, fy, cx, cy = camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px
    k, p = np.array((fx, 0, cx, 0, fy, cy, 0, 0, 1)), np.array((fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0))
    region = types.make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
    matrices = np.zeros(5), k, np.eye(3).reshape(-1), p
    size = camera.height_px, camera.width_px
    return types.make(CAMERA_INFO, _header(types, "camera"), *size, "plumb_bob", *matrices, 0, 0, region)


class Watch:
    """Time from an image's stamp to what came of it, and what each process has worked."""

    def __init__(self) -> None:
        self.to_pyramid_s: list[float] = []
        self.to_region_s: list[float] = []
        self.begun_ns, self.sent_before = time.time_ns(), 0
        self.pids: dict[str, int] = {}
        self.worked_s: dict[str, float] = {}
        self._client: BusClient | None = None

    def started(self, endpoint: str, pids: dict[str, int]) -> None:
        """Listen to the run; called again when more processes are there."""
        self.pids |= pids
        if self._client is None:
            self._client = BusClient(ZenohBus(endpoint))
            self._client.listen(PYRAMID, "*", lambda sample: self._aged(self.to_pyramid_s, Pyramid, sample))
            self._client.listen(REGION_DELTA, "*", lambda sample: self._aged(self.to_region_s, RegionDelta, sample))

    def look(self) -> None:
        """Remember how long processes have worked, as long as they are there."""
        for process in psutil.Process().children(recursive=True):
            try:
                words, times = process.cmdline(), process.cpu_times()
            except psutil.Error:
                continue
            if "prior_sg.deploy.running.serve" in words:
                name = words[words.index("prior_sg.deploy.running.serve") + 1]
                self.worked_s[name] = times.user + times.system

    def close(self) -> None:
        """Listen no more."""
        if self._client is not None:
            self._client.bus.close()

    def _aged(self, into: list[float], kind: Any, sample: Sample) -> None:
        stamp_ns = decode(kind, sample.payload).stamp_ns
        if stamp_ns >= self.begun_ns:  # the first regions are of no image
            into.append((time.time_ns() - stamp_ns) / 1e9)


def measure(seconds: float, source: str, frames: int, settings: list[str]) -> dict[str, Any]:
    """Figures of one run."""
    played = [frame for frame in itertools.islice(open_source(source), frames) if isinstance(frame, RawFrame)]
    endpoint, stop_router = open_free_router("tcp/127.0.0.1:0")
    player, watch = Player(endpoint, played), Watch()
    player.start()
    with tempfile.TemporaryDirectory() as folder:
        threading.Thread(target=_time_out, args=(player, watch, seconds), daemon=True).start()
        job = Job(
            source=f"ros2:/{endpoint}",
            out=Path(folder),
            environment=DEMO_ENVIRONMENT,
            task=DEMO_TASK,
            settings=[f"ingest.end_after_s={END_AFTER_S}", *settings],
            on_started=watch.started,
        )
        try:
            result = run(job, Terminal(stderr=True))
        finally:
            player.stopped.set()
            player.join()
            watch.close()
            stop_router()
    ingest = result.counts.ingest
    return {
        "seconds": result.seconds,
        "sent_since_the_start": player.sent - watch.sent_before,
        "most_late_s": player.late_s,
        "read": 0 if ingest is None else ingest.frames_read,
        "keyframes": len(result.counts.keyframes),
        "encoded": len(result.counts.pyramids),
        "lost": [f"{loss.count} {loss.what}: {loss.reason}" for loss in result.losses],
        "cpu_cores": {name: worked_s / result.seconds for name, worked_s in sorted(watch.worked_s.items())},
        "image_to_pyramid_s_p50_p99": _percentiles(watch.to_pyramid_s),
        "image_to_region_s_p50_p99": _percentiles(watch.to_region_s),
        "regions": len(result.scene.regions),
    }


def _time_out(player: Player, watch: Watch, seconds: float) -> None:
    """Let the robot go after some seconds of being read."""
    while not watch.pids and not player.stopped.wait(0.2):
        continue
    watch.sent_before = player.sent
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s and not player.stopped.wait(1.0):
        watch.look()
    player.stopped.set()
    while watch.worked_s and psutil.Process().children():
        watch.look()
        time.sleep(1.0)


def _percentiles(values: list[float]) -> list[float]:
    return np.percentile(values, [50, 99]).round(3).tolist() if values else []


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--source", default=str(SAMPLE))
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--set", action="append", default=[], help="a setting, as of `prior-sg run`")
    given = parser.parse_args()
    print(json.dumps(measure(given.seconds, given.source, given.frames, given.set), indent=1))


if __name__ == "__main__":
    main()

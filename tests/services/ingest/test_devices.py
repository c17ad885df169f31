"""Cameras: a fake one, RealSense's own library on a recording of drawn frames, depthai's own messages."""

import os
import threading
import time
from collections import deque
from datetime import timedelta

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from prior_sg.deploy.cli.main import main
from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.ingest.core.config import Config
from prior_sg.services.ingest.core.frames import RawFrame, Unused
from prior_sg.services.ingest.core.options import ReadOptions
from prior_sg.services.ingest.core.pose_rows import row_of
from prior_sg.services.ingest.core.ros.assembly import Fault
from prior_sg.services.ingest.sources import SourceError, open_source
from prior_sg.services.ingest.sources.base import Camera
from prior_sg.services.ingest.sources.devices import feed, oak, rig
from prior_sg.services.ingest.sources.devices.device import Capture, DeviceGone
from prior_sg.services.ingest.sources.devices.live import Mounting
from prior_sg.services.ingest.sources.devices.poses import Lines, is_fifo, open_poses
from prior_sg.services.ingest.sources.devices.rig import Posed

WIDTH, HEIGHT = 64, 48
CAMERA = Intrinsics(WIDTH, HEIGHT, 60.0, 60.0, 31.5, 23.5)
START_NS, STEP_NS = 1_700_000_000_000_000_000, 33_000_000


def colour(number):
    return np.full((HEIGHT, WIDTH, 3), (number, 10, 200), np.uint8)


def depth_of(number):
    return np.full((HEIGHT, WIDTH), 1000 + number, np.uint16)


def capture(number, stamp_ns=None):
    stamp_ns = START_NS + number * STEP_NS if stamp_ns is None else stamp_ns
    return Capture(number, stamp_ns, time.time_ns(), lambda: (colour(number), depth_of(number)))


class Fake:
    """A camera that gives what it was told to: captures, or a fault."""

    name, camera, depth_scale_m, note = "Fake (serial number 7)", Camera(CAMERA), 0.001, ""

    def __init__(self, gives, ends=True):
        self.gives, self.ends, self.closed = deque(gives), ends, False

    def capture(self, timeout_s):
        if not self.gives:
            time.sleep(0.001)
            return None
        one = self.gives.popleft()
        if isinstance(one, Exception):
            raise one
        return one

    @property
    def ended(self):
        return self.ends and not self.gives

    def close(self):
        self.closed = True


def rows(path, count=40, every_ns=STEP_NS, offset_ns=-STEP_NS // 2):
    """Poses between the pictures: half a centimetre a picture along x."""
    stamps = [START_NS + offset_ns + index * every_ns for index in range(count)]
    lines = [f"{stamp / 1e9:.9f} {0.005 * index} 0 1 0 0 0 1" for index, stamp in enumerate(stamps)]
    lines = [
        f"{stamp // 10**9}.{stamp % 10**9:09d} {line.split(' ', 1)[1]}"
        for stamp, line in zip(stamps, lines, strict=True)
    ]
    path.write_text("# stamp tx ty tz qx qy qz qw\n" + "\n".join(lines) + "\n")
    return str(path)


@pytest.fixture
def plugged(monkeypatch):
    """Plug in fakes, which are opened one after the other; the last one again and again."""

    def plug(*devices):
        waiting = deque(devices)

        def open_camera(name):
            one = waiting.popleft() if len(waiting) > 1 else waiting[0]
            if isinstance(one, Exception):
                raise one
            return one

        monkeypatch.setitem(rig.OPENERS, "oak:", open_camera)
        return devices

    return plug


@pytest.mark.parametrize(
    ("line", "unit", "stamp_ns"),
    [
        ("1700000000.123456789 1 2 3 0 0 0 1", "", 1_700_000_000_123_456_789),
        ("1700000000123456789,1,2,3,0,0,0,1", "", 1_700_000_000_123_456_789),
        ("1700000000123.5 1 2 3 0 0 0 1", "", 1_700_000_000_123_500_000),
        ("1700000000123456 1 2 3 0 0 0 1", "", 1_700_000_000_123_456_000),
        ("12.5 1 2 3 0 0 0 1", "", 12_500_000_000),
        ("12500 1 2 3 0 0 0 1", "ms", 12_500_000_000),
    ],
)
def test_a_stamp_says_its_unit_by_its_size(line, unit, stamp_ns):
    row = row_of(line, unit)
    assert (row.stamp_ns, row.position_m, row.quaternion_xyzw) == (stamp_ns, (1, 2, 3), (0, 0, 0, 1))
    assert row_of("5 0 0 0 1 2 3 4", order="wxyz").quaternion_xyzw == (2, 3, 4, 1)
    assert row_of("# comment") is None
    assert row_of("   ") is None


@pytest.mark.parametrize(
    "line", ["1 2 3", "1 2 3 4 0 0 0 x", "1 2 3 4 0 0 0 0", "1 nan 3 4 0 0 0 1", "nan 2 3 4 0 0 0 1"]
)
def test_a_line_that_is_no_pose_is_told(line):
    with pytest.raises(ValueError, match=r"a line has"):
        row_of(line)


def test_a_file_of_poses_is_read_as_it_grows(tmp_path):
    path = tmp_path / "poses.txt"
    path.write_text("1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 1\n3 0 0 0 0 ")
    lines = Lines(path, ReadOptions())
    assert [row.stamp_ns for row in lines.read(10**9)] == [10**9]
    assert [row.stamp_ns for row in lines.read(None)] == [2 * 10**9]
    with path.open("a") as file:
        file.write("0 0 1\nrubbish\n4 0 0 0 0 0 0 1\n")
    got = list(lines.read(None))
    lines.close()
    assert [one.stamp_ns for one in got if not isinstance(one, Fault)] == [3 * 10**9, 4 * 10**9]
    assert [one.text[:19] for one in got if isinstance(one, Fault)] == ["a line has 1 words,"]


def test_poses_come_through_a_fifo(tmp_path):
    path = tmp_path / "poses"
    os.mkfifo(path)
    assert is_fifo(ReadOptions(pose_source=str(path)))
    lines = Lines(path, ReadOptions())
    assert list(lines.read(None)) == []
    with path.open("w") as writer:
        writer.write("1 0 0 0 0 0 0 1\n")
        writer.flush()
        assert [row.stamp_ns for row in lines.read(None)] == [10**9]
        writer.write("2 0 0 0 0 0 0 1\n")
    assert [row.stamp_ns for row in lines.read(None)] == [2 * 10**9]
    lines.close()


def test_a_camera_gives_frames_whose_poses_are_interpolated(tmp_path, plugged):
    (device,) = plugged(Fake([capture(number) for number in range(14)]))
    source = open_source("oak:", options=ReadOptions(pose_source=rows(tmp_path / "p.txt")))
    assert source.live is not None
    assert any("lines of p.txt" in note for note in source.notes)
    frames = list(source)
    assert device.closed
    assert [frame.stamp_ns for frame in frames] == [START_NS + number * STEP_NS for number in range(14)]
    for number, frame in enumerate(frames):
        assert frame.world_from_camera[:3, 3] == pytest.approx((0.005 * (number + 0.5), 0, 1), abs=1e-5)
        depth = cv2.imdecode(np.frombuffer(frame.depth, np.uint8), cv2.IMREAD_UNCHANGED)
        assert (depth == 1000 + number).all()
        assert (cv2.imdecode(np.frombuffer(frame.color, np.uint8), cv2.IMREAD_COLOR) == (number, 10, 200)).all()


def test_only_frames_that_may_become_keyframes_are_drawn_together(tmp_path, plugged):
    plugged(Fake([capture(number) for number in range(15)]))
    cfg = Config(pose_source=rows(tmp_path / "p.txt"), min_translation_m=0.024)
    frames = [event for event in open_source("oak:", options=cfg).live() if isinstance(event, RawFrame)]
    assert [frame.index for frame in frames if not frame.pose_only] == [0, 5, 10]
    assert not any(frame.color or frame.depth for frame in frames if frame.pose_only)


def test_what_ends_while_it_is_looked_at_gives_all_of_its_frames(tmp_path, plugged, monkeypatch):
    plugged(Fake([capture(number) for number in range(15)]))
    take = feed.CameraFeed.take

    def take_at_the_end(one, timeout_s):
        one._thread.join()
        return take(one, timeout_s)

    monkeypatch.setattr(feed.CameraFeed, "take", take_at_the_end)
    frames = list(open_source("oak:", options=ReadOptions(pose_source=rows(tmp_path / "p.txt"))))
    assert [frame.index for frame in frames] == list(range(15))


def test_frames_without_a_pose_are_counted(tmp_path, plugged):
    plugged(Fake([capture(number) for number in range(10)]))
    path = rows(tmp_path / "p.txt", count=5)
    events = list(open_source("oak:", options=ReadOptions(pose_source=path)).live())
    assert len([event for event in events if isinstance(event, RawFrame)]) == 5  # the last within 20 ms of a pose
    assert sum(event.count for event in events if isinstance(event, Unused) and event.reason == "no pose") == 5


def test_who_reads_a_camera_waits_for_nobody():
    device = Fake([capture(number) for number in (*range(40), *range(47, 53))])
    fed = feed.CameraFeed(lambda: device)
    end_s = time.monotonic() + 20
    while device.gives and time.monotonic() < end_s:
        time.sleep(0.005)
    fed._thread.join(20)
    captures, faults, ended = fed.take(0)
    fed.close()
    assert ended
    assert [one.number for one in captures] == [*range(30, 40), *range(47, 53)]
    assert faults == {Fault(feed.CAPTURES, feed.BEHIND): 30, Fault(feed.CAPTURES, feed.BETWEEN): 7}


def test_a_camera_that_is_unplugged_is_read_again_when_it_is_back(tmp_path, plugged, monkeypatch):
    monkeypatch.setattr(feed, "AGAIN_S", 0.01)
    first = Fake([*map(capture, range(6)), DeviceGone("Fake has given no picture: is it unplugged?")], ends=False)
    second = Fake([capture(number) for number in range(10, 14)])
    plugged(first, SourceError("oak: no OAK camera is there"), second)
    events = list(open_source("oak:", options=ReadOptions(pose_source=rows(tmp_path / "p.txt"))).live())
    stamps = [event.stamp_ns for event in events if isinstance(event, RawFrame)]
    assert stamps == [START_NS + number * STEP_NS for number in (*range(6), *range(10, 14))]
    said = {event.reason: event.example for event in events if isinstance(event, Unused)}
    assert said[feed.GONE].endswith("is it unplugged?")
    assert said[feed.NOT_BACK] == "oak: no OAK camera is there"
    assert first.closed and second.closed


def test_a_fault_of_our_own_in_the_thread_is_not_silent(tmp_path, plugged):
    plugged(Fake([*map(capture, range(6)), ZeroDivisionError("ours")]))
    with pytest.raises(ZeroDivisionError, match=r"^ours$"):
        list(open_source("oak:", options=ReadOptions(pose_source=rows(tmp_path / "p.txt"))))


def test_a_camera_that_stays_away_ends_the_source(tmp_path, plugged, monkeypatch):
    monkeypatch.setattr(feed, "AGAIN_S", 0.01)
    plugged(Fake([*map(capture, range(6)), DeviceGone("gone")], ends=False), SourceError("not there"))
    options = ReadOptions(pose_source=rows(tmp_path / "p.txt"), end_after_s=0.3)
    assert len([event for event in open_source("oak:", options=options).live() if isinstance(event, RawFrame)]) == 6


def test_what_poses_are_wanted_is_said_before_anything_is_opened(capsys):
    with pytest.raises(SourceError, match=r"a camera does not know where it is; give --pose-source FILE"):
        open_source("realsense:", options=ReadOptions())
    with pytest.raises(ValueError, match=r"give --pose-source"):
        Config(source="oak:123")
    assert main(["check", "oak:"]) == 1
    assert "--pose-source" in capsys.readouterr().out.replace("\n", " ")


def test_no_pose_in_time_is_told(tmp_path, plugged):
    plugged(Fake([capture(number) for number in range(3)]))
    path = rows(tmp_path / "p.txt", count=5, offset_ns=-(10**12))
    with pytest.raises(SourceError, match=r"no picture has got a pose .*--stamp-offset"):
        open_source("oak:", options=ReadOptions(pose_source=path))
    with pytest.raises(SourceError, match=r"cannot be read from .*absent.txt: No such file"):
        open_source("oak:", options=ReadOptions(pose_source=str(tmp_path / "absent.txt")))
    plugged(Fake([capture(number) for number in range(3)]))
    moved = ReadOptions(pose_source=path, stamp_offset_s=1000.0)
    assert len(list(open_source("oak:", options=moved))) == 3


def test_a_mount_stands_between_the_body_and_the_camera():
    """A robot at (1, 0, 0) that looks along y; its camera half a metre up and a tenth ahead, looking ahead."""
    quarter = Rotation.from_euler("z", 90, degrees=True)
    body = np.eye(4)
    body[:3, :3], body[:3, 3] = quarter.as_matrix(), (1, 0, 0)
    mounting = Mounting.of(ReadOptions(camera_axes="ros", body_from_camera=[0.1, 0, 0.5, 0, 0, 0, 2]))
    pose = mounting.pose(Posed(capture(0), body))
    assert pose[:3, 3] == pytest.approx((1, 0.1, 0.5))
    assert pose[:3, 2] == pytest.approx((0, 1, 0))  # it looks along y
    assert pose[:3, 1] == pytest.approx((0, 0, -1))  # its y is down
    with pytest.raises(ValueError, match=r"body_from_camera must be"):
        ReadOptions(body_from_camera=[0, 0, 0, 0, 0, 0, 0])


def test_poses_of_a_topic_of_a_running_robot(endpoint, plugged, monkeypatch):
    pytest.importorskip("rosbags")
    from prior_sg.services.runtime.ros.session import RosSession
    from prior_sg.services.runtime.ros.types import shared_types
    from prior_sg.services.runtime.ros.wire import Channel

    types = shared_types()
    options = ReadOptions(pose_source=f"ros2:/{endpoint}", ros_domain=23, camera_axes="ros")
    with RosSession(endpoint, "slam", 23) as robot:
        kind = "geometry_msgs/msg/PoseStamped"
        publisher = robot.publisher(Channel("/slam/pose", kind, types.hash(kind)))
        done = threading.Event()

        def publish():
            while not done.is_set():
                for index in range(60):
                    stamp = START_NS + (index - 5) * STEP_NS
                    publisher.publish(types.encode(posed(types, stamp, 0.01 * (index - 5))))
                time.sleep(0.05)

        thread = threading.Thread(target=publish, daemon=True)
        thread.start()
        try:
            plugged(Fake([capture(number) for number in range(10)], ends=False))
            source = open_source("oak:", options=options)
            frames = []
            for frame in source:
                frames.append(frame)
                if len(frames) == 10:
                    break
            source.close()
        finally:
            done.set()
            thread.join()
    assert any("/slam/pose (PoseStamped)" in note for note in source.notes)
    x_m = [frame.world_from_camera[0, 3] for frame in frames]
    assert x_m == pytest.approx([0.01 * number for number in range(10)], abs=1e-6)
    monkeypatch.setattr("prior_sg.services.ingest.sources.devices.poses.SEARCH_S", 0.5)
    with pytest.raises(SourceError, match=r"nobody publishes poses there"):
        open_poses(ReadOptions(pose_source=f"ros2:/{endpoint}", ros_domain=24))


def posed(types, stamp_ns, x_m):
    header = types.make(
        "std_msgs/msg/Header", types.make("builtin_interfaces/msg/Time", *divmod(stamp_ns, 10**9)), "map"
    )
    point = types.make("geometry_msgs/msg/Point", x_m, 0.0, 1.0)
    turn = types.make("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0)
    return types.make("geometry_msgs/msg/PoseStamped", header, types.make("geometry_msgs/msg/Pose", point, turn))


# RealSense's own library.


def drawn(rs, path, count=24):
    """A recording by the library: depth of a step, near on the left, from a camera 0.1 m beside colour's."""

    def stream(kind, form, bytes_per_pixel, number):
        camera = rs.intrinsics()
        camera.width, camera.height, camera.fx, camera.fy = WIDTH, HEIGHT, CAMERA.fx_px, CAMERA.fy_px
        camera.ppx, camera.ppy = CAMERA.cx_px, CAMERA.cy_px
        camera.model, camera.coeffs = rs.distortion.inverse_brown_conrady, [0.0] * 5
        video = rs.video_stream()
        video.type, video.fmt, video.bpp, video.uid, video.fps = kind, form, bytes_per_pixel, number, 30
        video.width, video.height, video.intrinsics, video.index = WIDTH, HEIGHT, camera, 0
        return video

    device = rs.software_device()
    device.register_info(rs.camera_info.name, "Drawn")
    device.register_info(rs.camera_info.serial_number, "42")
    depth_sensor, color_sensor = device.add_sensor("Depth"), device.add_sensor("Color")
    depth_sensor.add_read_only_option(rs.option.depth_units, 0.001)
    depth_profile = depth_sensor.add_video_stream(stream(rs.stream.depth, rs.format.z16, 2, 1))
    color_profile = color_sensor.add_video_stream(stream(rs.stream.color, rs.format.rgb8, 3, 2))
    beside = rs.extrinsics()
    beside.rotation, beside.translation = np.eye(3).ravel().tolist(), [0.1, 0.0, 0.0]
    depth_profile.register_extrinsics_to(color_profile, beside)
    recorder = rs.recorder(str(path), device)
    sensors, queue = recorder.query_sensors(), rs.frame_queue(100)
    for sensor in sensors:
        sensor.open(sensor.get_stream_profiles())
        sensor.start(queue)
    step = np.full((HEIGHT, WIDTH), 2000, np.uint16)
    step[:, :20] = 1000
    for number in range(count):
        red = np.full((HEIGHT, WIDTH, 3), (200, 10, number), np.uint8)
        for sensor, profile, pixels in ((depth_sensor, depth_profile, step), (color_sensor, color_profile, red)):
            frame = rs.software_video_frame()
            frame.bpp = 2 if sensor is depth_sensor else 3
            frame.stride, frame.pixels, frame.frame_number = WIDTH * frame.bpp, pixels, number
            frame.timestamp = (START_NS + number * STEP_NS) / 1e6
            frame.domain, frame.depth_units = rs.timestamp_domain.system_time, 0.001
            frame.profile = profile.as_video_stream_profile()
            sensor.on_video_frame(frame)
        time.sleep(0.01)  # the recording has the times of arrival, by which it is played back
    for sensor in sensors:
        sensor.stop()
        sensor.close()


@pytest.fixture(scope="module")
def rs():
    return pytest.importorskip("pyrealsense2", exc_type=ImportError)  # its wheel needs the system's libusb


def test_a_recording_of_realsense_is_played_back(rs, tmp_path):
    drawn(rs, tmp_path / "walk.db3")
    source = open_source(f"realsense:{tmp_path}/walk.db3", options=ReadOptions(pose_source=rows(tmp_path / "p.txt")))
    assert source.intrinsics == CAMERA
    assert source.why == ("Drawn (serial number 42) is open",)
    events = list(source.live())
    frames = [event for event in events if isinstance(event, RawFrame)]
    lost = sum(event.count for event in events if isinstance(event, Unused))
    assert len(frames) >= 5
    assert len(frames) + lost >= 20  # the library itself lets go of some while it begins
    for frame in frames:
        number = (frame.stamp_ns - START_NS) / STEP_NS
        assert number == pytest.approx(round(number), abs=1e-4)
        color = cv2.imdecode(np.frombuffer(frame.color, np.uint8), cv2.IMREAD_COLOR)
        assert tuple(color[20, 30]) == (round(number), 10, 200)
        assert frame.world_from_camera[0, 3] == pytest.approx(0.005 * (number + 0.5), abs=1e-5)
        depth = cv2.imdecode(np.frombuffer(frame.depth, np.uint8), cv2.IMREAD_UNCHANGED)
        assert (depth[10, 8:25] == 1000).all()  # six pixels to the right: 60 px * 0.1 m / 1 m
        assert (depth[10, 28:] == 2000).all()


def test_what_realsense_cannot_open_is_told(rs, tmp_path):
    told = ReadOptions(pose_source=rows(tmp_path / "p.txt"))
    (tmp_path / "broken.bag").write_bytes(b"no recording")
    for name, said in (
        ("", "plug it in"),
        (f"{tmp_path}/absent.bag", "no such rec"),
        (f"{tmp_path}/broken.bag", "opened"),
    ):
        with pytest.raises(SourceError, match=said):
            open_source(f"realsense:{name}", options=told)


# depthai's own messages.


def message(dai, number, steady):
    color, depth, both = dai.ImgFrame(), dai.ImgFrame(), dai.RGBDData()
    color.setCvFrame(colour(number), dai.ImgFrame.Type.RGB888i)
    matrix = [[CAMERA.fx_px, 0.0, CAMERA.cx_px], [0.0, CAMERA.fy_px, CAMERA.cy_px], [0.0, 0.0, 1.0]]
    color.setTransformation(dai.ImgTransformation(WIDTH, HEIGHT, matrix))
    depth.setType(dai.ImgFrame.Type.RAW16)
    depth.setWidth(WIDTH)
    depth.setHeight(HEIGHT)
    depth.setFrame(depth_of(number))
    both.setRGBFrame(color)
    both.setDepthFrame(depth)
    both.setTimestamp(steady)
    both.setSequenceNum(number)
    return both


class Pipeline:
    """What is asked of depthai's."""

    def __init__(self):
        self.running = True

    def isRunning(self):
        return self.running

    def stop(self):
        self.running = False


class Queue:
    def __init__(self, messages):
        self.messages = deque(messages)

    def get(self, timeout):
        return self.messages.popleft() if self.messages else None


def test_messages_of_an_oak_become_captures_with_stamps_since_1970():
    dai = pytest.importorskip("depthai")
    before = time.time_ns() - time.monotonic_ns()
    steady = [timedelta(seconds=100 + number) for number in range(3)]
    pipeline = Pipeline()
    camera = oak.Oak(pipeline, Queue([message(dai, number, at) for number, at in enumerate(steady)]), "OAK")
    assert camera.camera.intrinsics == CAMERA
    one = camera.capture(0.1)
    assert one.number == 1
    assert one.stamp_ns - before == pytest.approx(101e9, abs=50e6)
    color, depth = one.images()
    assert (color == colour(1)).all() and (depth == depth_of(1)).all()
    camera.capture(0.1)
    assert camera.capture(0.1) is None
    pipeline.stop()
    with pytest.raises(DeviceGone, match=r"is it unplugged"):
        camera.capture(0.1)


def test_no_oak_is_told(tmp_path):
    pytest.importorskip("depthai")
    told = ReadOptions(pose_source=rows(tmp_path / "p.txt"))
    with pytest.raises(SourceError, match=r"no OAK camera is there: plug it in"):
        open_source("oak:", options=told)
    with pytest.raises(SourceError, match=r"oak:123 is not there: no OAK camera is"):
        open_source("oak:123", options=told)

"""Ingest: sources against hand-made folders and real depth, selection by hand, the ring's bound, and the whole flow."""

import asyncio
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from mcap.writer import Writer
from scipy.spatial.transform import Rotation

from prior_sg.deploy.sample.make import PackError, bare_jpeg, pack
from prior_sg.schemas.codec import decode, encode
from prior_sg.schemas.features import Backfill
from prior_sg.schemas.frames import ArchiveRequest, Intrinsics, Keyframe, PoseUpdate
from prior_sg.schemas.status import JobDone
from prior_sg.schemas.topics import ARCHIVE, CAMERA_STATE, ENCODE, INGEST_STATE, KEYFRAME, POSE_UPDATE
from prior_sg.services.geometry import back_project, inverse, pose_from_quaternion, project, transform
from prior_sg.services.headers import ImageError, image_size
from prior_sg.services.ingest.core import selection
from prior_sg.services.ingest.core.config import Config
from prior_sg.services.ingest.core.frames import BadFrame, Correction, EndOfSource, RawFrame
from prior_sg.services.ingest.service import SERVICE, drive, step
from prior_sg.services.ingest.sources import SourceError, open_source
from prior_sg.services.ingest.sources.base import levelling
from prior_sg.services.runtime.record import LogWriter, attachments, metadata
from prior_sg.services.runtime.runner import Runner
from prior_sg.services.runtime.service import Identity
from tests.help.paths import SAMPLE, SHARED_DATA

DATA = SHARED_DATA
WIDTH, HEIGHT = 32, 24
SECOND = 1_000_000_000


def image(extension, depth=False, width=WIDTH, height=HEIGHT, value=1000):
    shape, kind = ((height, width), np.uint16) if depth else ((height, width, 3), np.uint8)
    return cv2.imencode(extension, np.full(shape, value % 256 if not depth else value, kind))[1].tobytes()


JPEG, DEPTH = image(".jpg"), image(".png", depth=True)


def pose(x=0.0, yaw_deg=0.0):
    turned = np.eye(4)
    turned[:3, :3] = Rotation.from_euler("z", yaw_deg, degrees=True).as_matrix()
    turned[0, 3] = x
    return turned


def frame(number, stamp_s, x=0.0, yaw_deg=0.0, **changes):
    fields = {
        "frame_id": number,
        "stamp_ns": round(stamp_s * SECOND),
        "intrinsics": Intrinsics(WIDTH, HEIGHT, 30, 30, 16, 12),
        "world_from_camera": pose(x, yaw_deg),
        "color": JPEG,
        "depth": DEPTH,
        "depth_scale_m": 0.001,
        "index": number,
        "total": 100,
    }
    return RawFrame(**(fields | changes))


def empty_state():
    return SERVICE.init(Config(), Identity("tiago", "ingest-1", 1))


def feed(state, messages, cfg):
    """All outputs, each checked to be declared."""
    outputs = Runner(SERVICE, cfg, state=state).feed(*messages)
    assert all(isinstance(message, topic.type) for topic, message in outputs)
    return outputs


def keyframes_of(frames, **settings):
    return [m.frame_id for topic, m in feed(empty_state(), frames, Config(**settings)) if topic is KEYFRAME]


# Selection: (what moves the camera between frames 0, 1, 2, …, expected keyframes), thresholds 0.25 m, 12 degrees, 2 s
SELECTION = {
    "first frame only when at rest": ([frame(i, 0.1 * i) for i in range(10)], [0]),
    "translation adds up to the threshold": ([frame(i, 0.1 * i, x=0.1 * i) for i in range(7)], [0, 3, 6]),
    "a large step counts once": ([frame(0, 0), frame(1, 0.1, x=0.3), frame(2, 0.2, x=0.31)], [0, 1]),
    "going back to the start is no motion": ([frame(0, 0), frame(1, 0.1, x=0.2), frame(2, 0.2, x=0.0)], [0]),
    "turning adds up to the threshold": ([frame(i, 0.1 * i, yaw_deg=5 * i) for i in range(8)], [0, 3, 6]),
    "turning the other way counts alike": ([frame(i, 0.1 * i, yaw_deg=-5 * i) for i in range(4)], [0, 3]),
    "a resting camera reports every two seconds": ([frame(i, 0.5 * i) for i in range(10)], [0, 4, 8]),
}


@pytest.mark.parametrize("name", SELECTION)
def test_selection_by_hand(name):
    frames, expected = SELECTION[name]
    assert keyframes_of(frames) == expected


def test_every_frame_and_no_interval_are_settings():
    frames = [frame(i, i) for i in range(6)]
    assert keyframes_of(frames, every_frame=True) == [0, 1, 2, 3, 4, 5]
    assert keyframes_of(frames, max_interval_s=0) == [0]


# Refusals: (frames, numbers of those that the camera's pose is reported for)
REFUSALS = {
    "a stamp that goes back": ([frame(0, 1), frame(1, 0.9), frame(2, 1.1)], [SECOND, 1_100_000_000]),
    "a stamp that repeats": ([frame(0, 1), frame(1, 1), frame(2, 2)], [SECOND, 2 * SECOND]),
    "a number that repeats": ([frame(3, 1), frame(3, 2), frame(4, 3)], [SECOND, 3 * SECOND]),
    "a pose that jumps away and back": ([frame(0, 0), frame(1, 1, x=50), frame(2, 2, x=0.1)], [0, 2 * SECOND]),
    "a tracker that jumps and stays": ([frame(0, 0), frame(1, 1, x=50), frame(2, 2, x=50.1)], [0, 2 * SECOND]),
    "a tracker that jumps about": ([frame(0, 0), frame(1, 1, x=50), frame(2, 2, x=-50)], [0]),
}


@pytest.mark.parametrize("name", REFUSALS)
def test_refusals_by_hand(name, caplog):
    frames, expected = REFUSALS[name]
    state = empty_state()
    outputs = feed(state, frames, Config())
    assert [m.stamp_ns for topic, m in outputs if topic is CAMERA_STATE] == expected
    assert outputs[-1][1].rejected == len(frames) - len(expected) == len(caplog.records)
    assert outputs[-1][1].frames_read == len(frames)


def test_a_fast_camera_is_believed_when_the_setting_says_so():
    frames = [frame(0, 0), frame(1, 1, x=50)]
    assert keyframes_of(frames, max_speed_m_s=0) == [0, 1]
    assert keyframes_of(frames, max_speed_m_s=49.9) == [0]
    assert keyframes_of(frames, max_speed_m_s=50) == [0, 1]


def test_flow_from_first_frame_to_finished():
    state, cfg = empty_state(), Config()
    outputs = feed(state, [frame(5, 0), BadFrame(frame_id=6, reason="gone", index=1, total=3), frame(7, 1, x=1)], cfg)
    assert [topic for topic, _ in outputs] == [
        *(CAMERA_STATE, KEYFRAME, ENCODE, INGEST_STATE),
        INGEST_STATE,
        *(CAMERA_STATE, KEYFRAME, ENCODE, INGEST_STATE),
    ]
    keyframe = outputs[1][1]
    assert (keyframe.robot, keyframe.frame_id, keyframe.stamp_ns) == ("tiago", 5, 0)
    assert (keyframe.color, keyframe.depth) == (JPEG, DEPTH)
    assert outputs[2][1] is keyframe

    done = [JobDone(topic="ENCODE", frame_id=i, worker="w", attempts=1) for i in (5, 5, 99)]
    ((_, first),) = feed(state, done, cfg)  # a second report and a foreign one change nothing
    assert (first.encoded, first.finished) == (1, False)
    ((_, ended),) = feed(state, [EndOfSource()], cfg)
    assert (ended.encoded, ended.finished) == (1, False)
    ((_, last),) = feed(state, [JobDone(topic="ENCODE", frame_id=7, worker="w", attempts=2)], cfg)
    assert (last.frames_read, last.frames_total, last.keyframes, last.encoded) == (3, 100, 2, 2)
    assert (last.rejected, last.finished) == (1, True)


def test_a_job_given_up_does_not_hold_the_end_back():
    state = empty_state()
    given_up = JobDone(topic="ENCODE", frame_id=0, worker="w", attempts=3, error="no worker could do it")
    last = feed(state, [frame(0, 0), EndOfSource(), given_up], Config())[-1][1]
    assert (last.encoded, last.finished) == (0, True)


def test_state_does_not_keep_a_received_buffer_alive():
    state = empty_state()
    received = decode(RawFrame, encode(frame(0, 0)))
    (keyframe,) = (m for topic, m in feed(state, [received], Config()) if topic is KEYFRAME)
    assert not np.shares_memory(keyframe.world_from_camera, received.world_from_camera)
    assert not np.shares_memory(state.last.world_from_camera, received.world_from_camera)


def test_equal_inputs_give_equal_bytes():
    def run():
        frames = [frame(i, 0.2 * i, x=0.1 * i, yaw_deg=i * i) for i in range(30)]
        return [(topic.name, encode(message)) for topic, message in feed(empty_state(), frames, Config())]

    assert run() == run()


def test_the_ring_keeps_the_newest_keyframes_within_its_bound():
    state = empty_state()
    cfg = Config(every_frame=True, archive_mb=0.01)  # 10 000 bytes: ten frames of 1000
    frames = [frame(i, i, color=bytes(900), depth=bytes(100)) for i in range(25)]
    feed(state, frames[:3], cfg)
    assert selection.archived(state, ArchiveRequest(robot="tiago"), cfg).oldest_frame_id == 0
    feed(state, frames[3:], cfg)
    reply = selection.archived(state, ArchiveRequest(robot="tiago"), cfg)
    assert (reply.oldest_frame_id, [k.frame_id for k in reply.keyframes]) == (15, list(range(15, 25)))
    feed(state, [frame(25, 25, color=bytes(9_500), depth=bytes(1000))], cfg)  # larger than the ring
    assert selection.archived(state, ArchiveRequest(robot="tiago"), cfg).oldest_frame_id == -1


@pytest.mark.parametrize(
    ("request_fields", "expected"),
    [
        ({}, [0, 3, 6, 9, 12]),
        ({"first_frame_id": 3, "end_frame_id": 9}, [3, 6]),
        ({"first_frame_id": 4}, [6, 9, 12]),
        ({"limit": 2}, [0, 3]),
        ({"limit": -1}, []),
        ({"first_frame_id": 13}, []),
    ],
)
def test_the_archive_answers_by_number(request_fields, expected):
    state, cfg = empty_state(), Config(every_frame=True)
    feed(state, [frame(3 * i, i) for i in range(5)], cfg)
    reply = SERVICE.answers[next(iter(SERVICE.answers))](state, ArchiveRequest(robot="tiago", **request_fields), cfg)
    assert [k.frame_id for k in reply.keyframes] == expected


# Sources


def dataset_folder(path, rows):
    for name in ("color", "depth"):
        (path / name).mkdir(parents=True)
    camera = {"width": WIDTH, "height": HEIGHT, "fx": 30, "fy": 31, "cx": 16, "cy": 12, "depth_scale_m": 0.001}
    (path / "camera.json").write_text(json.dumps(camera))
    (path / "trajectory.csv").write_text("\n".join(("frame,stamp_ns,x_m,y_m,z_m,qx,qy,qz,qw", *rows)) + "\n")
    for row in rows:
        number = row.split(",")[0]
        (path / "color" / f"{int(number):06d}.jpg").write_bytes(JPEG)
        (path / "depth" / f"{int(number):06d}.png").write_bytes(DEPTH)
    return path


def good_rows(count):
    return [f"{i},{i * SECOND},{0.5 * i},0,1,0,0,0,1" for i in range(count)]


def test_a_dataset_gives_its_camera_poses_images_and_ground_truth(tmp_path):
    turned = Rotation.from_euler("xyz", (-100, 10, 30), degrees=True)
    x, y, z, w = turned.as_quat()
    folder = dataset_folder(tmp_path / "d", ["4,70,1,2,3,0,0,0,2", f"9,80,1.5,-2,0,{x},{y},{z},{w}"])
    (folder / "regions.json").write_text('{"regions": [{"label": "hall"}]}')
    source = open_source(folder)
    first, second = source
    assert (source.layout, source.total) == ("dataset", 2)
    assert source.intrinsics == Intrinsics(WIDTH, HEIGHT, 30, 31, 16, 12)
    assert source.ground_truth == {"regions": [{"label": "hall"}]}
    assert [(f.frame_id, f.stamp_ns, f.index, f.total) for f in (first, second)] == [(4, 70, 0, 2), (9, 80, 1, 2)]
    assert (first.color, first.depth, first.depth_scale_m) == (JPEG, DEPTH, 0.001)
    assert first.world_from_camera.tolist() == [[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    np.testing.assert_allclose(second.world_from_camera[:3, :3], turned.as_matrix(), atol=1e-12)
    assert second.world_from_camera[:3, 3].tolist() == [1.5, -2, 0]


BROKEN = [
    (lambda f: (f / "depth" / "000001.png").unlink(), "000001.png cannot be read"),
    (lambda f: (f / "color" / "000001.jpg").unlink(), "000001.jpg cannot be read"),
    (lambda f: (f / "color" / "000001.jpg").write_bytes(image(".jpg", width=40)), "40 x 24 pixels, the camera 32 x 24"),
    (lambda f: (f / "depth" / "000001.png").write_bytes(image(".png")), "8 bits per channel instead of 16"),
    (lambda f: (f / "depth" / "000001.png").write_bytes(DEPTH[:-20]), "depth image is damaged: it is cut off"),
    (lambda f: (f / "color" / "000001.jpg").write_bytes(JPEG[: len(JPEG) // 2]), "colour image is damaged"),
    (lambda f: (f / "color" / "000001.jpg").write_bytes(b""), "neither a PNG nor a JPEG"),
]
BROKEN_ROWS = [
    (f"1,{SECOND},nan,0,0,0,0,0,1", "pose is not finite"),
    (f"1,{SECOND},0,0,0,0,0,0,0", "pose is not finite"),
    (f"1,{SECOND},0,0,0,inf,0,0,0", "pose is not finite"),
    (f"1,{SECOND},0,0", "malformed"),
    ("1,yesterday,0,0,0,0,0,0,1", "malformed"),
]


@pytest.mark.parametrize(("damage", "reason"), BROKEN)
def test_a_broken_frame_is_reported_and_the_stream_goes_on(tmp_path, damage, reason):
    folder = dataset_folder(tmp_path / "d", good_rows(3))
    damage(folder)
    first, broken, last = open_source(folder)
    assert (first.frame_id, broken.frame_id, last.frame_id) == (0, 1, 2)
    assert isinstance(broken, BadFrame)
    assert reason in broken.reason


@pytest.mark.parametrize(("row", "reason"), BROKEN_ROWS)
def test_a_broken_pose_is_reported_and_the_stream_goes_on(tmp_path, row, reason):
    rows = good_rows(3)
    rows[1] = row
    first, broken, last = open_source(dataset_folder(tmp_path / "d", rows))
    assert (first.frame_id, last.frame_id) == (0, 2)
    assert isinstance(broken, BadFrame)
    assert reason in broken.reason


def seven_scenes_folder(path, numbers, depth=DEPTH):
    path.mkdir(parents=True)
    for number in numbers:
        stem = f"frame-{number:06d}"
        (path / f"{stem}.color.png").write_bytes(image(".png"))
        (path / f"{stem}.depth.png").write_bytes(depth)
        matrix = pose(x=0.1 * number)
        (path / f"{stem}.pose.txt").write_text("\n".join("\t ".join(f"{v: .7e}" for v in row) for row in matrix) + "\n")
    return path


def test_seven_scenes_has_z_up_and_no_invalid_depth(tmp_path):
    depth = np.full((HEIGHT, WIDTH), 1500, np.uint16)
    depth[:5] = 65535
    folder = seven_scenes_folder(tmp_path / "s", (0, 2), cv2.imencode(".png", depth)[1].tobytes())
    source = open_source(folder)
    first, second = source
    assert (source.layout, source.total, source.ground_truth) == ("7-scenes", 2, None)
    assert source.intrinsics == Intrinsics(WIDTH, HEIGHT, 585, 585, 320, 240)
    assert [(f.frame_id, f.stamp_ns) for f in (first, second)] == [(0, 0), (2, 66_666_667)]
    # The camera of the identity pose looks along its z, horizontally; its y points down, so the world's z is its -y.
    expected = [[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]]
    np.testing.assert_allclose(first.world_from_camera, expected, atol=1e-12)
    np.testing.assert_allclose(second.world_from_camera[:3, 3], (0.2, 0, 0), atol=1e-7)
    decoded = cv2.imdecode(np.frombuffer(first.depth, np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(decoded, np.where(depth == 65535, 0, 1500))


def test_seven_scenes_sequences_are_counted_on(tmp_path):
    for name, numbers in (("seq-01", (0, 1, 2)), ("seq-02", (0, 1))):
        seven_scenes_folder(tmp_path / "s" / name, numbers)
    (tmp_path / "s" / "seq-02" / "frame-000000.pose.txt").write_text("not a pose")
    (tmp_path / "s" / "camera-intrinsics.txt").write_text("500 0 310\n0 501 230\n0 0 1\n")
    source = open_source(tmp_path / "s")
    assert [f.frame_id for f in source] == [0, 1, 2, 3, 4]
    assert [type(f) for f in source] == [RawFrame, RawFrame, RawFrame, BadFrame, RawFrame]
    assert source.intrinsics == Intrinsics(WIDTH, HEIGHT, 500, 501, 310, 230)
    assert len(list(open_source(tmp_path / "s" / "seq-01"))) == 3


def log_of(path, robots):
    with LogWriter(path) as log:
        for sequence, (robot, number) in enumerate(robots):
            raw = frame(number, number)
            fields = {name: getattr(raw, name) for name in Keyframe.__struct_fields__ if hasattr(raw, name)}
            keyframe = Keyframe(robot=robot, **fields)
            log.add(
                KEYFRAME, KEYFRAME.key_of(keyframe), encode(keyframe), "w", sequence, sent_ns=0, received_ns=sequence
            )
    return path


def test_a_log_plays_one_robot(tmp_path):
    path = log_of(tmp_path / "a.mcap", [("a", 0), ("b", 7), ("a", 1), ("b", 9)])
    source = open_source(path)
    assert (source.layout, source.total) == ("log", 2)
    assert [(f.frame_id, f.index, f.total) for f in source] == [(0, 0, 2), (1, 1, 2)]
    assert [f.frame_id for f in open_source(path, robot="b")] == [7, 9]
    with pytest.raises(SourceError, match="no keyframes of c; it holds those of a, b"):
        open_source(path, robot="c")
    assert any(
        "a (2 keyframes), b (2 keyframes): a is read; --set ingest.source_robot=" in note for note in source.notes
    )


def test_a_log_that_was_cut_off_says_so(tmp_path):
    path = log_of(tmp_path / "a.mcap", [("a", number) for number in range(6)])
    assert not any("cut off" in note for note in open_source(path).notes)
    path.write_bytes(path.read_bytes()[:-100])
    assert any("cut off" in note for note in open_source(path).notes)


def test_a_damaged_part_of_a_log_costs_what_lies_in_it(tmp_path):
    path = log_in_parts(tmp_path / "a.mcap", 6)
    data = bytearray(path.read_bytes())
    at = len(data) // 2
    data[at : at + 8] = b"\xff" * 8
    path.write_bytes(data)
    frames = list(open_source(path))
    lost = [f for f in frames if isinstance(f, BadFrame)]
    assert len(frames) == 6 and len(lost) == 1
    assert "damaged" in lost[0].reason


def log_in_parts(path, frames):
    """A log with a chunk for each keyframe."""
    with LogWriter(path) as log:
        for number in range(frames):
            raw = frame(number, number)
            fields = {name: getattr(raw, name) for name in Keyframe.__struct_fields__ if hasattr(raw, name)}
            keyframe = Keyframe(robot="a", **fields)
            log.add(KEYFRAME, KEYFRAME.key_of(keyframe), encode(keyframe), "w", number, sent_ns=0, received_ns=number)
            log.flush()
        log.attach("regions.json", "application/json", b'{"regions": []}')
    return path


def test_of_a_log_that_was_cut_off_and_damaged_all_that_can_be_read_is(tmp_path):
    path = log_in_parts(tmp_path / "a.mcap", 6)
    data = bytearray(path.read_bytes())
    at = len(data) // 2
    data[at : at + 8] = b"\xff" * 8
    path.write_bytes(data[:-100])
    source = open_source(path)
    found = [f.frame_id for f in source]
    assert len(found) == 5 and found[:2] == [0, 1] and found[-1] == 5
    assert any("damaged parts left out: 1" in note for note in source.notes)


def test_a_damaged_attachment_costs_the_ground_truth_alone(tmp_path):
    path = log_in_parts(tmp_path / "a.mcap", 3)
    path.write_bytes(path.read_bytes().replace(b'{"regions"', b'{"regiona"'))
    source = open_source(path)
    assert len(list(source)) == 3 and source.ground_truth is None
    assert any("without ground truth" in note for note in source.notes)


def test_logs_without_keyframes_are_told_apart(tmp_path):
    with LogWriter(tmp_path / "task.mcap") as log:
        log.add(POSE_UPDATE, "psg/a/pose_update", b"", "w", 0, sent_ns=0, received_ns=0)
    with pytest.raises(SourceError, match="holds no keyframes; of ours it holds POSE_UPDATE: record a system"):
        open_source(tmp_path / "task.mcap")
    with LogWriter(tmp_path / "empty.mcap"):
        pass
    with pytest.raises(SourceError, match="holds no keyframes; it holds no messages of ours"):
        open_source(tmp_path / "empty.mcap")
    (tmp_path / "cut.mcap").write_bytes((tmp_path / "empty.mcap").read_bytes()[:8])
    with pytest.raises(SourceError, match="holds no keyframes: it was cut off before its first complete part"):
        open_source(tmp_path / "cut.mcap")
    with (tmp_path / "ros.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel("/camera/depth", "cdr", writer.register_schema("Image", "ros2msg", b""))
        writer.add_message(channel, 0, b"\x00", 0)
        writer.finish()
    with pytest.raises(SourceError, match=r"written by another program \(topics /camera/depth\); export its images"):
        open_source(tmp_path / "ros.mcap")


def test_a_malformed_keyframe_of_a_log_is_reported(tmp_path):
    path = tmp_path / "a.mcap"
    with LogWriter(path) as log:
        key = KEYFRAME.pattern("a")
        log.add(KEYFRAME, key, b"\xc1", "w", 0, sent_ns=0, received_ns=0)
        raw = frame(1, 1)
        good = Keyframe(robot="a", **{n: getattr(raw, n) for n in Keyframe.__struct_fields__ if hasattr(raw, n)})
        log.add(KEYFRAME, key, encode(good), "w", 1, sent_ns=0, received_ns=1)
    bad, first = open_source(path)
    assert isinstance(bad, BadFrame)
    assert first.frame_id == 1


def test_unknown_sources_are_explained_in_one_sentence(tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "foreign.mcap").write_bytes(b"nothing")
    with pytest.raises(SourceError, match="does not exist"):
        open_source(tmp_path / "none")
    with pytest.raises(SourceError, match=r"looked for camera\.json and trajectory\.csv .* frame-\*\.pose\.txt"):
        open_source(tmp_path / "empty")
    with pytest.raises(SourceError, match="is not a log"):
        open_source(tmp_path / "foreign.mcap")
    folder = dataset_folder(tmp_path / "d", good_rows(1))
    (folder / "camera.json").write_text('{"width": 3}')
    with pytest.raises(SourceError, match="is not a camera"):
        open_source(folder)
    (folder / "trajectory.csv").write_text("frame,x\n1,2\n")
    with pytest.raises(SourceError, match="lacks the columns stamp_ns"):
        open_source(folder)


@pytest.mark.parametrize("up", [(0, -1, 0), (1, 0, 0), (0, 0, -1), (0.1, -3, 0.4), (0, 0, 2)])
def test_levelling_turns_up_into_z_by_the_smallest_rotation(up):
    world_from_source = levelling(up, floor_m=0.7)
    rotation = world_from_source[:3, :3]
    unit = np.array(up) / np.linalg.norm(up)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
    np.testing.assert_allclose(rotation @ unit, (0, 0, 1), atol=1e-12)
    angle = Rotation.from_matrix(rotation).magnitude()
    assert angle == pytest.approx(np.arccos(np.clip(unit[2], -1, 1)))
    assert (world_from_source @ (*(0.7 * unit), 1))[2] == pytest.approx(0)  # a point of the floor


def test_levelling_leaves_level_poses_alone_and_refuses_nonsense(tmp_path):
    assert levelling((0, 0, 1), 0) is None
    for up in ((0, 0, 0), (1, 2), (0, float("nan"), 1)):
        with pytest.raises(SourceError, match="three numbers"):
            levelling(up, 0)
    raised, *_ = open_source(dataset_folder(tmp_path / "d", good_rows(2)), floor_m=0.25)
    assert raised.world_from_camera[2, 3] == 0.75


@pytest.mark.parametrize(("extension", "depth"), [(".jpg", False), (".png", False), (".png", True), (".jpeg", False)])
def test_image_sizes_come_from_headers(extension, depth):
    assert image_size(image(extension, depth, width=57, height=19)) == (57, 19, 16 if depth else 8)
    progressive = cv2.imencode(".jpg", np.zeros((19, 57, 3), np.uint8), (cv2.IMWRITE_JPEG_PROGRESSIVE, 1))[1].tobytes()
    assert image_size(progressive) == (57, 19, 8)


@pytest.mark.parametrize("data", [JPEG, DEPTH])
def test_no_beginning_of_an_image_counts_as_whole(data):
    for length in range(len(data) - 12):
        with pytest.raises(ImageError):
            image_size(data[:length])


# Driving


class Port:
    """A host of one service that records what it was asked."""

    def __init__(self, cfg, stop_after=10**9):
        self.stopping, self.state, self.cfg = asyncio.Event(), empty_state(), cfg
        self.outputs, self.windows, self.consumed, self.stop_after = [], [], [], stop_after

    async def consume(self, message):
        self.consumed.append(message)
        self.outputs += step(self.state, message, self.cfg)
        if len(self.consumed) == self.stop_after:
            self.stopping.set()

    async def room(self, window):
        self.windows.append(window)


def driven(cfg, **options):
    async def run():
        port = Port(cfg, **options)
        await asyncio.wait_for(drive(port, cfg), timeout=20)
        return port

    return asyncio.run(run())


def test_drive_feeds_every_frame_and_the_end(tmp_path):
    folder = dataset_folder(tmp_path / "d", good_rows(4))
    (folder / "depth" / "000002.png").unlink()
    port = driven(Config(source=str(folder), window=3))
    assert [type(m) for m in port.consumed] == [RawFrame, RawFrame, BadFrame, RawFrame, EndOfSource]
    assert [m.frame_id for topic, m in port.outputs if topic is KEYFRAME] == [0, 1, 3]
    assert port.windows == [3] * 4


def test_drive_paces_by_stamps_without_asking_for_room(tmp_path, monkeypatch):
    delays_s = []

    async def sleep(delay_s):
        delays_s.append(delay_s)

    monkeypatch.setattr("prior_sg.services.ingest.service.asyncio.sleep", sleep)
    folder = dataset_folder(tmp_path / "d", good_rows(4))  # one second apart
    port = driven(Config(source=str(folder), speed=0.001, when_behind="skip"))
    assert [round(delay_s, -2) for delay_s in delays_s] == [0, 1000, 2000, 3000]
    assert port.windows == []
    assert isinstance(port.consumed[-1], EndOfSource)
    port = driven(Config(source=str(folder), speed=0.001, window=3))  # it waits for whoever is behind, too
    assert port.windows == [3] * 4


def test_when_skipping_as_many_jobs_wait_as_the_window_holds():
    limit = SERVICE.job_limit
    assert limit(Config(speed=1.0, when_behind="skip", window=5)) == 5
    assert limit(Config(speed=1.0)) == limit(Config(when_behind="skip")) == 0


def test_a_backfill_encodes_what_the_reader_lacks_in_its_space():
    state = selection.State(robot="a")
    for number in range(4):
        list(selection.accept(state, frame(number, number), Config(every_frame=True)))
    fresh = Backfill(robot="a", space="new/space", frame_ids=np.array([1, 3]))
    assert [job.frame_id for _, job in step(state, fresh, Config())] == [0]  # 2 may be on the way
    assert not list(step(state, Backfill(robot="a", space="new/space", frame_ids=np.array([0, 2])), Config()))
    assert not list(step(state, Backfill(robot="a", space="new/space", frame_ids=np.zeros(0, int)), Config()))
    wish = Backfill(robot="a", space="new/space", frame_ids=np.array([1, 3, 99]), settled=True)
    jobs = list(step(state, wish, Config()))
    assert [(topic, job.frame_id, job.space) for topic, job in jobs] == [
        (ENCODE, 0, "new/space"),
        (ENCODE, 2, "new/space"),
    ]
    assert [keyframe.space for keyframe in state.archive] == [""] * 4


def test_a_skipped_keyframe_ends_the_wait_and_is_counted():
    state = selection.State(robot="a")
    list(selection.accept(state, frame(0, 0), Config()))
    list(selection.end(state))
    (report,) = selection.encoded(state, JobDone(topic="ENCODE", frame_id=0, worker="", attempts=0, error="skipped"))
    assert (report[1].encoded, report[1].skipped, report[1].finished) == (0, 1, True)


def test_drive_stops_in_the_middle_even_while_it_waits(tmp_path):
    folder = dataset_folder(tmp_path / "d", good_rows(4))
    port = driven(Config(source=str(folder)), stop_after=2)
    assert len(port.consumed) == 2
    slow = driven(Config(source=str(folder), speed=1e-6), stop_after=1)  # the second frame is due in eleven days
    assert len(slow.consumed) == 1


def test_drive_without_a_source_says_so_and_with_a_wrong_one_fails(caplog):
    caplog.set_level("INFO")
    port = driven(Config())
    assert port.consumed == []
    assert "no source is configured" in caplog.text
    with pytest.raises(SourceError, match="does not exist"):
        driven(Config(source="/nowhere/at/all"))


def test_drive_passes_on_why_the_host_failed(tmp_path):
    class Failing(Port):
        async def room(self, window):
            raise ConnectionError("router gone")

    async def run():
        cfg = Config(source=str(dataset_folder(tmp_path / "d", good_rows(1))))
        await drive(Failing(cfg), cfg)

    with pytest.raises(ConnectionError, match="router gone"):
        asyncio.run(run())


# The sample


def test_packing_is_lossless_repeatable_and_tells_where_it_comes_from(tmp_path):
    folder = dataset_folder(tmp_path / "d", good_rows(3))
    noise = np.random.default_rng(0).integers(0, 60_000, (HEIGHT, WIDTH)).astype(np.uint16)
    (folder / "depth" / "000001.png").write_bytes(cv2.imencode(".png", noise)[1].tobytes())
    (folder / "regions.json").write_text('{"regions": []}')
    for name in ("a.mcap", "b.mcap"):
        assert pack(folder, tmp_path / name, provenance="made here") == 3
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()
    assert metadata(tmp_path / "a.mcap") == {"source": {"provenance": "made here"}}
    packed = open_source(tmp_path / "a.mcap")
    assert packed.ground_truth == {"regions": []}
    for before, after in zip(open_source(folder), packed, strict=True):
        assert (after.frame_id, after.stamp_ns, after.intrinsics) == (
            before.frame_id,
            before.stamp_ns,
            before.intrinsics,
        )
        np.testing.assert_array_equal(after.world_from_camera, before.world_from_camera)
        for kind in ("color", "depth"):
            pixels = [cv2.imdecode(np.frombuffer(getattr(f, kind), np.uint8), -1) for f in (before, after)]
            np.testing.assert_array_equal(*pixels)


def test_packing_too_much_into_too_little_fails_and_keeps_the_old_sample(tmp_path):
    folder = dataset_folder(tmp_path / "d", good_rows(3))
    out = tmp_path / "a.mcap"
    out.write_bytes(b"old")
    with pytest.raises(PackError, match="does not fit"):
        pack(folder, out, max_mb=0.001)
    assert out.read_bytes() == b"old"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.mcap", "d"]


def test_bare_jpeg_drops_comments_and_keeps_the_picture():
    rich = cv2.imencode(".jpg", np.random.default_rng(0).integers(0, 255, (40, 60, 3)).astype(np.uint8))[1].tobytes()
    commented = rich[:2] + b"\xff\xfe\x00\x0asecrets!" + rich[2:]
    assert bare_jpeg(commented) == rich
    assert bare_jpeg(rich) == rich


def test_the_shipped_sample_is_whole_small_and_clean():
    source = open_source(SAMPLE)
    frames = list(source)
    assert len(frames) == source.total == 86
    assert all(isinstance(f, RawFrame) for f in frames)
    assert SAMPLE.stat().st_size <= 12e6
    labels = {region["label"] for region in source.ground_truth["regions"]}
    assert labels == {"bathroom", "bedroom", "living room", "kitchen", "dining room"}
    sentence = metadata(SAMPLE)["source"]["provenance"]
    assert sentence in (SAMPLE.parent / "README.md").read_text()
    assert set(attachments(SAMPLE)) == {"regions.json"}
    assert not any(b"Blender" in f.color or b".blend" in f.color for f in frames)


# Real poses and depth


def points_camera(raw):
    depth_m = cv2.imdecode(np.frombuffer(raw.depth, np.uint8), cv2.IMREAD_UNCHANGED) * raw.depth_scale_m
    points = back_project(depth_m, raw.intrinsics)[::4, ::4].reshape(-1, 3)
    return points[points[:, 2] > 0], depth_m


def disagreement_m(first, second, second_from_first):
    """Median difference between the depth that `second` measures and what `first` predicts, and how many there are."""
    points, _ = points_camera(first)
    _, depth_m = points_camera(second)
    pixels, expected_m = project(transform(second_from_first, points), second.intrinsics)
    u, v = np.rint(pixels).astype(int).T
    inside = (expected_m > 0.1) & (u >= 0) & (v >= 0) & (u < depth_m.shape[1]) & (v < depth_m.shape[0])
    measured_m = depth_m[v[inside], u[inside]]
    seen = measured_m > 0
    errors_m = np.abs(measured_m - expected_m[inside])[seen]
    return (float(np.median(errors_m)) if errors_m.size else np.inf), int(seen.sum())


REAL = [
    ("hololens_office", 100, 104),
    ("hololens_office", 250, 256),
    ("red_kitchen", 60, 68),
    ("aws_small_house", 20, 22),
]


@pytest.mark.parametrize(("name", "first", "second"), REAL)
def test_overlapping_frames_agree_on_where_things_are(name, first, second):
    if not (DATA / name).is_dir():
        pytest.skip("development data is not here")
    frames = list(open_source(DATA / name))
    a, b = frames[first], frames[second]
    error_m, pixels = disagreement_m(a, b, inverse(b.world_from_camera) @ a.world_from_camera)
    assert pixels > 2000
    assert error_m < 0.05
    # The check can fail: poses read the wrong way round do not agree.
    assert disagreement_m(a, b, b.world_from_camera @ inverse(a.world_from_camera))[0] > 0.1


def test_the_samples_frames_agree_on_where_things_are():
    frames = list(open_source(SAMPLE))
    second_from_first = inverse(frames[1].world_from_camera) @ frames[0].world_from_camera
    error_m, pixels = disagreement_m(frames[0], frames[1], second_from_first)
    assert pixels > 2000
    assert error_m < 0.05


@pytest.mark.parametrize(("name", "least", "most"), [("hololens_office", 90, 150), ("infinigen_home_a", 84, 86)])
def test_selection_on_development_sequences(name, least, most):
    if not (DATA / name).is_dir():
        pytest.skip("development data is not here")
    state = empty_state()
    feed(state, open_source(DATA / name), Config())
    assert least <= state.keyframes <= most
    assert state.rejected == 0


def test_a_real_sequence_reads_the_same_through_seven_scenes(tmp_path):
    if not (DATA / "red_kitchen").is_dir():
        pytest.skip("development data is not here")
    folder = tmp_path / "seq-01"
    folder.mkdir()
    originals = list(open_source(DATA / "red_kitchen"))[:3]
    for number, raw in enumerate(originals):
        stem = folder / f"frame-{number:06d}"
        pixels = cv2.imdecode(np.frombuffer(raw.color, np.uint8), cv2.IMREAD_COLOR)
        cv2.imwrite(f"{stem}.color.png", pixels)
        Path(f"{stem}.depth.png").write_bytes(raw.depth)
        np.savetxt(f"{stem}.pose.txt", raw.world_from_camera)
    for original, read in zip(originals, open_source(folder, world_up=(0, 0, 1)), strict=True):
        np.testing.assert_allclose(read.world_from_camera, original.world_from_camera)
        assert (read.depth, read.intrinsics) == (original.depth, original.intrinsics)


def test_scipy_reads_the_same_quaternions():
    for quaternion in np.random.default_rng(0).normal(size=(20, 4)):
        expected = Rotation.from_quat(quaternion).as_matrix()
        np.testing.assert_allclose(pose_from_quaternion(np.zeros(3), quaternion)[:3, :3], expected, atol=1e-12)


# Corrected poses.


HEAD = "frame,stamp_ns,x_m,y_m,z_m,qx,qy,qz,qw\n"


def test_a_dataset_delivers_its_corrections_between_the_frames_they_came_between(tmp_path):
    folder = dataset_folder(tmp_path / "d", [f"{i},{i}000,{i},0,1,0,0,0,1" for i in range(3)])
    rows = "0,1500,7,0,1,0,0,0,1\n1,1500,8,0,1,0,0,0,1\n1,9000,9,0,1,0,0,0,1\n"
    (folder / "pose_updates.csv").write_text(HEAD + rows)
    source = open_source(folder, floor_m=0.5)
    seen = [event.frame_ids.tolist() if isinstance(event, Correction) else event.frame_id for event in source.events()]
    assert seen == [0, 1, [0, 1], 2, [1]]
    assert [frame.frame_id for frame in source] == [0, 1, 2]
    first = next(event for event in source.events() if isinstance(event, Correction))
    assert first.world_from_camera[:, :3, 3].tolist() == [[7, 0, 0.5], [8, 0, 0.5]]


def test_corrections_that_make_no_sense_are_one_sentence(tmp_path):
    folder = dataset_folder(tmp_path / "d", [f"{i},{i}000,{i},0,1,0,0,0,1" for i in range(3)])
    for rows, complaint in (("0,1,x,0,1,0,0,0,1\n", "malformed"), ("0,1,1,0,1,0,0,0,0\n", "not finite")):
        (folder / "pose_updates.csv").write_text(HEAD + rows)
        with pytest.raises(SourceError, match=complaint):
            open_source(folder)


def test_a_correction_is_published_and_the_ring_follows_it():
    state = SERVICE.init(Config(every_frame=True), Identity("tiago", "ingest-1", 5))
    feed(state, [frame(i, i) for i in range(3)], Config(every_frame=True))
    correction = Correction(
        stamp_ns=7, frame_ids=np.array([1, 9]), world_from_camera=np.stack((pose(0.5, 3.0), pose(4.0)))
    )
    ((topic, update),) = feed(state, [correction], Config())
    assert (topic, update.robot, update.epoch, update.revision, update.stamp_ns) == (POSE_UPDATE, "tiago", 5, 0, 7)
    assert feed(state, [decode(PoseUpdate, encode(update))], Config()) == []
    poses = [
        k.world_from_camera for k in SERVICE.answers[ARCHIVE](state, ArchiveRequest(robot="tiago"), Config()).keyframes
    ]
    np.testing.assert_array_equal(poses, [pose(), pose(0.5, 3.0), pose()])


def test_a_log_replays_its_pose_updates_where_they_were(tmp_path):
    log = LogWriter(tmp_path / "log.mcap")
    update = PoseUpdate(
        robot="tiago", epoch=1, revision=0, stamp_ns=10**18, frame_ids=np.array([0]), world_from_camera=pose(2)[None]
    )
    state = empty_state()
    outputs = feed(state, [frame(i, i) for i in range(0, 9, 3)], Config())
    keyframes = [(topic, message) for topic, message in outputs if topic is KEYFRAME]
    for sequence, (topic, message) in enumerate([*keyframes[:2], (POSE_UPDATE, update), *keyframes[2:]]):
        log.add(topic, topic.key_of(message), encode(message), "w/1/1", sequence, 0, 0)
    log.close()
    events = list(open_source(tmp_path / "log.mcap").events())
    assert [type(event) for event in events] == [RawFrame, RawFrame, Correction, RawFrame]
    assert events[2].frame_ids.tolist() == [0]


@pytest.mark.parametrize("fault", ["negative", "repeats", "mirrors", "not a number"])
def test_pose_updates_that_cannot_be_true_are_refused(fault):
    ids, poses = np.array([1, 2]), np.stack((pose(), pose()))
    if fault == "negative":
        ids[0] = -1
    elif fault == "repeats":
        ids[1] = 1
    elif fault == "mirrors":
        poses[0, 0, 0] = -1
    else:
        poses[1, 0, 3] = np.nan
    with pytest.raises(ValueError):
        PoseUpdate(robot="r", epoch=0, revision=0, stamp_ns=0, frame_ids=ids, world_from_camera=poses)


def test_masks_beside_the_images_travel_with_them(tmp_path):
    folder = dataset_folder(tmp_path / "d", good_rows(2))
    (folder / "mask").mkdir()
    (folder / "mask" / "000001.png").write_bytes(DEPTH)
    outputs = feed(empty_state(), open_source(folder), Config(every_frame=True))
    assert [m.mask for topic, m in outputs if topic is KEYFRAME] == [b"", DEPTH]

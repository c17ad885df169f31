"""Recordings of ROS 1 and 2 of every storage, written by rosbags, against the folder with the same frames."""

import json
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("rosbags")

from prior_sg.deploy.cli.main import main
from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.geometry import inverse
from prior_sg.services.headers import ImageError
from prior_sg.services.ingest.core.frames import BadFrame, RawFrame
from prior_sg.services.ingest.core.options import ReadOptions
from prior_sg.services.ingest.core.pixels import encoded, stored
from prior_sg.services.ingest.core.poses import PoseError
from prior_sg.services.ingest.core.ros.cameras import camera_fields
from prior_sg.services.ingest.core.ros.images import color_file, depth_image, metres, shown_by
from prior_sg.services.ingest.core.ros.transforms import TransformTree, transforms_of
from prior_sg.services.ingest.sources import SourceError, open_source
from prior_sg.services.ingest.sources.base import FrameError, camera_of
from tests.help.bags import COLOR, DEPTH, INFO, KINDS, OPTICAL, Maker, compressed_depth
from tests.help.paths import SAMPLE
from tests.help.room import CAMERA, depth_of
from tests.help.walked import (
    COLORS,
    DEPTHS_MM,
    MAP_FROM_ODOM,
    MS,
    STAMPS_NS,
    STEP_NS,
    WALK,
    WORLD_FROM_BASE,
    add_images,
    add_statics,
    add_tree,
    assert_the_walk,
    keyframes,
    motion,
    whole,
)


@pytest.fixture(scope="module")
def bags(tmp_path_factory):
    """A recording of each kind."""
    return {kind: whole(kind, pad=3).write(tmp_path_factory.mktemp(kind)) for kind in KINDS}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The same frames as a dataset folder."""
    path = tmp_path_factory.mktemp("folder")
    for name in ("color", "depth"):
        (path / name).mkdir()
    fields = {name: getattr(CAMERA, f"{name}_px") for name in ("width", "height", "fx", "fy", "cx", "cy")}
    (path / "camera.json").write_text(json.dumps(fields | {"depth_scale_m": 0.001}))
    rows = ["frame,stamp_ns,x_m,y_m,z_m,qx,qy,qz,qw"]
    for i, (stamp, pose, color, depth_mm) in enumerate(zip(STAMPS_NS, WALK, COLORS, DEPTHS_MM, strict=True)):
        numbers = [*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()]
        rows.append(",".join([str(i), str(stamp), *(f"{number:.12f}" for number in numbers)]))
        (path / f"color/{i:06d}.png").write_bytes(encoded(color[..., ::-1], ".png"))
        (path / f"depth/{i:06d}.png").write_bytes(encoded(depth_mm, ".png"))
    (path / "trajectory.csv").write_text("\n".join(rows) + "\n")
    return path


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_gives_the_frames_of_the_folder(bags, folder, kind):
    source, plain = open_source(bags[kind]), open_source(folder)
    assert (source.layout, source.intrinsics, source.total) == ("ros", plain.intrinsics, len(WALK))
    assert any("colour /camera/color/image_raw (rgb8), depth /camera/depth/image_raw" in note for note in source.notes)
    assert any("in map" in note for note in source.notes)
    assert_the_walk(source)
    assert_the_walk(plain)
    ours, theirs = keyframes(source), keyframes(plain)
    assert len(ours) >= 3 and [k.frame_id for k in ours] == [k.frame_id for k in theirs]
    for one, other in zip(ours, theirs, strict=True):
        assert one.stamp_ns == other.stamp_ns
        assert np.array_equal(stored(one.color), stored(other.color))
        assert np.array_equal(stored(one.depth), stored(other.depth))


def test_the_sample_passes_through_a_bag_byte_for_byte(tmp_path):
    """JPEG as CompressedImage, depth as compressedDepth, poses of the camera itself."""
    plain = open_source(SAMPLE)
    frames = [frame for frame, _ in zip(plain, range(4), strict=False)]
    maker = Maker("mcap")
    for frame in frames:
        maker.add(f"{COLOR}/compressed", frame.stamp_ns, maker.compressed(frame.stamp_ns, frame.color, "jpeg", ""))
        depth = compressed_depth(encoded(np.rint(stored(frame.depth) * frame.depth_scale_m * 1e3).astype(np.uint16),
                                         ".png"))  # fmt: skip
        message = maker.compressed(frame.stamp_ns, depth, "16UC1; compressedDepth png", "")
        maker.add(f"{DEPTH}/compressedDepth", frame.stamp_ns, message)
        maker.add(INFO, frame.stamp_ns, maker.info(frame.stamp_ns, plain.intrinsics, ""))
        maker.add("/pose", frame.stamp_ns, maker.pose(frame.stamp_ns, "world", np.array(frame.world_from_camera)))
    source = open_source(maker.write(tmp_path))
    assert source.intrinsics == plain.intrinsics
    read = list(source)
    assert len(read) == len(frames)
    for one, other in zip(read, frames, strict=True):
        assert (one.color, one.stamp_ns) == (other.color, other.stamp_ns)
        assert np.abs(one.world_from_camera - other.world_from_camera).max() < 1e-6
        depth_m = stored(other.depth) * other.depth_scale_m
        assert np.abs(stored(one.depth) * one.depth_scale_m - depth_m).max() <= 0.0005 + 1e-9


def test_poses_of_odometry_are_carried_to_the_camera(tmp_path):
    maker = Maker("sqlite3")
    add_statics(maker)
    add_images(maker)
    for stamp_ns, base in zip(STAMPS_NS, WORLD_FROM_BASE, strict=True):
        maker.add("/odom", stamp_ns, maker.odometry(stamp_ns, "odom", "base", base))
    path = maker.write(tmp_path)
    source = open_source(path)
    assert any("/odom (Odometry of base)" in note for note in source.notes)
    assert_the_walk(source)
    with pytest.raises(SourceError, match=r"poses of 'arm', and tf does not connect it .* give --pose-frame camera_"):
        open_source(path, options=ReadOptions(pose_frame="arm"))
    own = next(iter(open_source(path, options=ReadOptions(pose_frame=OPTICAL))))
    assert np.abs(own.world_from_camera - WORLD_FROM_BASE[0]).max() < 1e-6
    with pytest.raises(SourceError, match=r"asked for"):
        open_source(path, options=ReadOptions(fixed_frame="nowhere"))


def test_another_fixed_frame_and_camera_axes_of_ros(bags):
    frame = next(iter(open_source(bags["mcap"], options=ReadOptions(fixed_frame="odom"))))
    assert np.abs(frame.world_from_camera - inverse(MAP_FROM_ODOM[0]) @ WALK[0]).max() < 1e-6
    ahead = next(iter(open_source(bags["mcap"], options=ReadOptions(camera_axes="ros"))))
    turned = WALK[0] @ np.array(((0, 0, 1, 0), (-1, 0, 0, 0), (0, -1, 0, 0), (0, 0, 0, 1)))
    assert np.abs(ahead.world_from_camera - turned).max() < 1e-6


def test_poses_between_stamps_and_images_late_by_less_than_the_tolerance(tmp_path):
    maker = Maker("sqlite3")
    add_images(maker, depth_late_ns=15 * MS)
    add_statics(maker)
    for stamp_ns, before, after in zip(STAMPS_NS, WORLD_FROM_BASE, WORLD_FROM_BASE[1:], strict=False):
        for share_ns, base in ((-30 * MS, before), (30 * MS, before), (STEP_NS - 30 * MS, after)):
            maker.add("/tf", stamp_ns, maker.tf(maker.transform(stamp_ns + share_ns, "map", "base", base)))
    path = maker.write(tmp_path)
    frames = list(open_source(path))
    assert np.abs(frames[3].world_from_camera - WALK[3]).max() < 1e-6
    assert isinstance(frames[-1], BadFrame) and "no pose lies within 20 ms" in frames[-1].reason
    with pytest.raises(SourceError, match=r"within 10 ms; depth begins \+0.015 s after colour: give --sync-tolerance"):
        open_source(path, options=ReadOptions(sync_tolerance_s=0.01))


def test_images_without_a_partner_are_counted(tmp_path):
    maker = whole("mcap")
    maker.messages = [m for i, m in enumerate(maker.messages) if m[0] != DEPTH or i % 2]
    source = open_source(maker.write(tmp_path))
    depths = sum(topic == DEPTH for topic, _, _ in maker.messages)
    assert 0 < source.total == depths < len(WALK)
    assert any(f"{depths} of {len(WALK)} colour and {depths} depth images belong together" in n for n in source.notes)


def test_a_fault_of_our_own_is_not_told_as_a_damaged_recording(tmp_path, monkeypatch):
    path = whole("mcap").write(tmp_path)
    monkeypatch.setattr("prior_sg.services.ingest.sources.ros.bag.shown_by", lambda message: message.no_such_field)
    with pytest.raises(AttributeError, match="no_such_field"):
        open_source(path)


def test_stamps_of_arrival_where_headers_have_none(tmp_path):
    maker = Maker("mcap")
    for stamp_ns, color, depth_mm, pose in zip(STAMPS_NS, COLORS, DEPTHS_MM, WALK, strict=True):
        maker.add(COLOR, stamp_ns, maker.image(0, color, "rgb8"))
        maker.add(DEPTH, stamp_ns, maker.image(0, depth_mm, "16UC1"))
        maker.add("/pose", stamp_ns, maker.pose(0, "world", pose))
    maker.add(INFO, STAMPS_NS[0], maker.info(0, CAMERA))
    path = maker.write(tmp_path)
    with pytest.raises(SourceError, match="have no stamps; give --clock received"):
        open_source(path)
    assert_the_walk(open_source(path, options=ReadOptions(clock="received")))


def test_metres_and_quantised_depth(tmp_path):
    maker = Maker("bag")
    add_tree(maker)
    a, b = 100 * 101.0, 1 - 100 * 101 / 10.0
    for stamp_ns, color, depth_mm in zip(STAMPS_NS, COLORS, DEPTHS_MM, strict=True):
        depth_m = np.where(depth_mm > 0, depth_mm / 1000, np.nan).astype(np.float32)
        maker.add(COLOR, stamp_ns, maker.image(stamp_ns, color, "rgb8"))
        maker.add(DEPTH, stamp_ns, maker.image(stamp_ns, depth_m, "32FC1"))
        png = encoded(np.where(depth_mm > 0, a / np.nan_to_num(depth_m, nan=1.0) + b, 0).astype(np.uint16), ".png")
        message = maker.compressed(stamp_ns, compressed_depth(png, a, b), "32FC1; compressedDepth")
        maker.add(f"{DEPTH}/compressedDepth", stamp_ns, message)
        maker.add(INFO, stamp_ns, maker.info(stamp_ns, CAMERA))
    path = maker.write(tmp_path)
    assert_the_walk(open_source(path))
    quantised = open_source(path, options=ReadOptions(depth_topic=f"{DEPTH}/compressedDepth"))
    assert_the_walk(quantised, depth_m=0.006)  # one step of inverse depth at 6 m: 36 / A


def test_depth_of_a_camera_beside_colour_is_drawn_into_it(tmp_path):
    """Depth of 10 cm beside, with another size, must fall where colour's own depth would be."""
    wide = Intrinsics(120, 80, 60.0, 60.0, 59.5, 39.5)
    color_from_depth = motion(0.05, 0.02, 0.0, 0, 2, 0)
    maker = Maker("sqlite3")
    add_tree(maker)
    mount = maker.transform(STAMPS_NS[0], OPTICAL, "depth_optical", color_from_depth)
    maker.add("/tf_static", STAMPS_NS[0], maker.tf(mount))
    for stamp_ns, color, pose in zip(STAMPS_NS, COLORS, WALK, strict=True):
        depth_m = depth_of(pose @ color_from_depth, wide).astype(np.float32)
        maker.add(COLOR, stamp_ns, maker.image(stamp_ns, color, "rgb8"))
        maker.add(DEPTH, stamp_ns, maker.image(stamp_ns, depth_m, "32FC1", "depth_optical"))
        maker.add(INFO, stamp_ns, maker.info(stamp_ns, CAMERA))
        maker.add("/camera/depth/camera_info", stamp_ns, maker.info(stamp_ns, wide, "depth_optical"))
    source = open_source(maker.write(tmp_path / "mounted"))
    assert source.intrinsics == CAMERA and any("0.054 m and 2.0 degrees apart" in note for note in source.notes)
    for frame, truth_mm in zip(source, DEPTHS_MM, strict=True):
        seen = stored(frame.depth)
        off_mm = np.abs(seen.astype(float) - truth_mm)[seen > 0]
        assert (seen > 0).mean() > 0.75 and np.median(off_mm) <= 5 and np.quantile(off_mm, 0.9) < 60
    maker.messages = [m for m in maker.messages if getattr(m[2], "transforms", [None])[0] is not mount]
    with pytest.raises(SourceError, match="are not registered, and tf does not connect them"):
        open_source(maker.write(tmp_path / "loose"))


def test_a_bent_lens_is_straightened(tmp_path):
    maker = Maker("mcap")
    add_tree(maker)
    add_images(maker)
    bent = [m for m in maker.messages if m[0] != INFO]
    maker.messages = [*bent, (INFO, STAMPS_NS[0], maker.info(STAMPS_NS[0], CAMERA, distortion=(-0.1, 0.01, 0, 0, 0)))]
    source = open_source(maker.write(tmp_path / "a"))
    assert any("undistorted (opencv lens, 4 coefficients)" in note for note in source.notes)
    for model, d in (("thin_film", (0.1,)), ("rational_polynomial", (0.1,) * 14)):
        info = maker.info(STAMPS_NS[0], CAMERA, model=model, distortion=d)
        maker.messages = [*bent, (INFO, STAMPS_NS[0], info)]
        with pytest.raises(SourceError, match="lens"):
            open_source(maker.write(tmp_path / model))


@pytest.mark.parametrize(
    ("without", "reason"),
    [
        (DEPTH, "has no depth images"),
        (COLOR, "has no colour images"),
        (INFO, "has no camera info for its colour images: give --info-topic TOPIC, or --intrinsics"),
        ("/tf", "nothing says how the camera moves: in tf its frame 'camera_color_optical_frame' stays"),
        ("/tf_static", "nothing says how the camera moves"),
    ],
)
def test_what_is_missing_is_one_sentence(tmp_path, without, reason):
    maker = whole("mcap")
    maker.messages = [message for message in maker.messages if message[0] != without]
    path = maker.write(tmp_path)
    with pytest.raises(SourceError, match=reason):
        open_source(path)
    if without == INFO:
        size = [CAMERA.fx_px, CAMERA.fy_px, CAMERA.cx_px, CAMERA.cy_px, CAMERA.width_px, CAMERA.height_px]
        assert_the_walk(open_source(path, options=ReadOptions(intrinsics=size)))


def damaged(rng, data):
    """A file with a few bytes changed, or cut off."""
    changed = bytearray(data)
    if rng.random() < 0.4:
        return bytes(changed[: rng.integers(1, len(changed))])
    for position in rng.integers(0, len(changed), int(rng.integers(1, 40))):
        changed[position] = rng.integers(0, 256)
    return bytes(changed)


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_recordings_give_frames_or_one_sentence(bags, tmp_path, kind):
    rng, sentences = np.random.default_rng(KINDS.index(kind)), 0
    for trial in range(8):
        path = tmp_path / f"{trial}{bags[kind].suffix}"
        if bags[kind].is_dir():
            shutil.copytree(bags[kind], path)
            files = sorted(path.iterdir())
            file = files[0 if trial % 4 else -1]
        else:
            file = shutil.copy(bags[kind], path)
        file.write_bytes(damaged(rng, file.read_bytes()))
        try:
            frames = list(open_source(path))
            assert all(isinstance(frame, (RawFrame, BadFrame)) for frame in frames)
        except SourceError as error:
            sentences += 1
            assert "\n" not in str(error)
    assert sentences


def test_messages_that_only_the_index_knows_are_told(bags, tmp_path):
    shutil.copytree(bags["sqlite3"], tmp_path / "walk")
    (file,) = (tmp_path / "walk").glob("*.db3")
    with closing(sqlite3.connect(file)) as database, database:
        where = "topic_id = (SELECT id FROM topics WHERE name = ?)"
        database.execute(f"DELETE FROM messages WHERE id = (SELECT max(id) FROM messages WHERE {where})", (DEPTH,))
    source = open_source(tmp_path / "walk")
    assert any(f"1 messages of {DEPTH} are missing, though its index counts them" in note for note in source.notes)


def test_our_own_logs_stay_ours_and_files_alone_are_read(bags):
    assert open_source(SAMPLE).layout == "log"
    for kind, ending in (("mcap", "*.mcap"), ("sqlite3", "*.db3")):
        (file,) = bags[kind].glob(ending)
        source = open_source(file)
        assert (source.layout, source.total) == ("ros", len(WALK))


def test_a_bag_of_ros_1_that_was_split_is_read_as_one(tmp_path):
    maker = whole("bag")
    ordered = sorted(maker.messages, key=lambda entry: entry[1])
    for part, begin in enumerate(range(0, len(ordered), 17)):
        maker.messages = ordered[begin : begin + 17]
        maker.write(tmp_path / str(part)).rename(tmp_path / f"walk_{part}.bag")
        (tmp_path / str(part)).rmdir()
    source = open_source(tmp_path)
    assert (source.layout, len(list(tmp_path.iterdir()))) == ("ros", 3)
    assert_the_walk(source)


def test_a_folder_that_lost_its_metadata_is_told_what_to_give(bags, tmp_path):
    shutil.copytree(bags["sqlite3"], tmp_path / "cut")
    (tmp_path / "cut/metadata.yaml").unlink()
    with pytest.raises(SourceError, match=r"it holds recordings, give one of them: walk\.db3"):
        open_source(tmp_path / "cut")
    assert_the_walk(open_source(tmp_path / "cut/walk.db3"))


def test_check_and_topics_on_the_command_line(bags, capsys):
    assert main(["check", "--json", str(bags["bag"])]) == 0
    report = json.loads(capsys.readouterr().out)
    assert (report["layout"], report["verdict"] != "problem") == ("ros", True)
    assert main(["ros", "topics", str(bags["mcap"])]) == 0
    shown = capsys.readouterr().out
    assert "would read colour /camera/color/image_raw (rgb8)" in shown
    assert main(["ros", "topics", "--json", str(bags["bag"])]) == 0
    topics = {topic["topic"]: topic for topic in json.loads(capsys.readouterr().out)}
    assert topics[DEPTH] == {
        "topic": DEPTH,
        "type": "sensor_msgs/msg/Image",
        "messages": len(WALK),
        "rate_hz": topics[DEPTH]["rate_hz"],
        "encoding": "16UC1",
        "frame": OPTICAL,
        "serves_as": "depth",
    }
    assert 9 < topics[DEPTH]["rate_hz"] < 12 and topics["/tf_static"]["serves_as"] == "fixed transforms"
    assert main(["ros", "topics", str(SAMPLE)]) == 1
    assert "is no recording of ROS" in capsys.readouterr().err


def read_whole(store, name, data):
    """A message of any topic, all the way; raises what makes a bad frame."""
    try:
        message = store.deserialize_cdr(data, name)
    except Exception as error:  # as sources/ros/bag.py does
        raise FrameError(str(error)) from error
    if hasattr(message, "transforms") or hasattr(message, "pose"):
        tree = TransformTree(list(transforms_of(message)))
        return tree.at("map", "odom", STAMPS_NS[0], MS)
    if hasattr(message, "distortion_model"):
        return camera_of(Path("info"), camera_fields(message, rectified=False))
    return color_file(message) if shown_by(message) != "depth" else metres(depth_image(message), 0.001)


def test_mutated_messages_are_bad_frames_at_most(count=400):
    """50 000 by hand: python -c "from tests.services.ingest.test_ros_recordings import *; …(50_000)"."""
    maker, rng = whole("mcap"), np.random.default_rng(7)
    png = compressed_depth(encoded(DEPTHS_MM[0], ".png"), 10100.0, -1009.0)
    maker.add("/c", STAMPS_NS[0], maker.compressed(STAMPS_NS[0], png, "32FC1; compressedDepth png"))
    maker.add("/o", STAMPS_NS[0], maker.odometry(STAMPS_NS[0], "map", "odom", WALK[0]))
    samples = {topic: message for topic, _, message in maker.messages}
    plain = [(m.__msgtype__, bytes(maker.store.serialize_cdr(m, m.__msgtype__))) for m in samples.values()]
    refused = 0
    for trial in range(count):
        name, data = plain[trial % len(plain)]
        changed = bytearray(damaged(rng, data[:400]) + data[400:] if trial % 2 else damaged(rng, data))
        try:
            read_whole(maker.store, name, bytes(changed))
        except (FrameError, ImageError, PoseError, SourceError, ValueError):
            refused += 1
    assert count / 4 < refused < count

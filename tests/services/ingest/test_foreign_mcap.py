"""MCAP files that other programs wrote: Foxglove's own SDK in protobuf, JSON, and ROS 2 without its profile."""

import base64
import json

import numpy as np
import pytest
from mcap.writer import Writer
from scipy.spatial.transform import Rotation

pytest.importorskip("rosbags")
pytest.importorskip("foxglove")

import foxglove
from foxglove import channels, messages

from prior_sg.services.ingest.core.frames import RawFrame
from prior_sg.services.ingest.core.pixels import encoded, stored
from prior_sg.services.ingest.sources import SourceError, open_source
from tests.help.bags import OPTICAL
from tests.help.room import CAMERA
from tests.help.walked import COLORS, DEPTHS_MM, MS, STAMPS_NS, WALK, assert_the_walk, whole

K = [CAMERA.fx_px, 0.0, CAMERA.cx_px, 0.0, CAMERA.fy_px, CAMERA.cy_px, 0.0, 0.0, 1.0]
P = [CAMERA.fx_px, 0.0, CAMERA.cx_px, 0.0, 0.0, CAMERA.fy_px, CAMERA.cy_px, 0.0, 0.0, 0.0, 1.0, 0.0]
SIZE = {"width": CAMERA.width_px, "height": CAMERA.height_px}


def by_sdk(path, compressed):
    """As Foxglove's SDK writes it: protobuf."""
    context = foxglove.Context()
    image, depth, info, tf = (
        kind(topic, context=context)
        for topic, kind in (
            ("/cam/color", channels.CompressedImageChannel if compressed else channels.RawImageChannel),
            ("/cam/depth", channels.CompressedImageChannel if compressed else channels.RawImageChannel),
            ("/cam/camera_info", channels.CameraCalibrationChannel),
            ("/tf", channels.FrameTransformChannel),
        )
    )
    with path.open("wb") as file, foxglove.open_mcap(file, context=context):
        for stamp_ns, pose, color, depth_mm in zip(STAMPS_NS, WALK, COLORS, DEPTHS_MM, strict=True):
            about = {"timestamp": messages.Timestamp(*divmod(stamp_ns, 10**9)), "frame_id": OPTICAL}
            for channel, pixels, encoding in ((image, color, "rgb8"), (depth, depth_mm, "16UC1")):
                raw = {**about, **SIZE, "encoding": encoding, "step": pixels[0].nbytes, "data": pixels.tobytes()}
                png = encoded(pixels[..., ::-1] if pixels.ndim == 3 else pixels, ".png")
                message = (
                    messages.CompressedImage(**about, format="png", data=png)
                    if compressed
                    else messages.RawImage(**raw)
                )
                channel.log(message, log_time=stamp_ns)
            info.log(messages.CameraCalibration(**about, **SIZE, K=K, P=P), log_time=stamp_ns)
            x, y, z = pose[:3, 3].tolist()
            turn = Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
            moved = messages.FrameTransform(
                timestamp=about["timestamp"], parent_frame_id="map", child_frame_id=OPTICAL,
                translation=messages.Vector3(x=x, y=y, z=z),
                rotation=messages.Quaternion(**dict(zip("xyzw", turn, strict=True))),
            )  # fmt: skip
            tf.log(moved, log_time=stamp_ns)
    return path


def by_json(path):
    """Foxglove's schemas in JSON, poses of the camera beside them."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channels_of = {}
        for topic, name in (
            ("/color", "RawImage"), ("/depth", "RawImage"), ("/info", "CameraCalibration"), ("/pose", "PoseInFrame"),
        ):  # fmt: skip
            schema = writer.register_schema(f"foxglove.{name}", "jsonschema", b'{"type": "object"}')
            channels_of[topic] = writer.register_channel(topic, "json", schema)
        for stamp_ns, pose, color, depth_mm in zip(STAMPS_NS, WALK, COLORS, DEPTHS_MM, strict=True):
            stamp = dict(zip(("sec", "nsec"), divmod(stamp_ns, 10**9), strict=True))
            about = {"timestamp": stamp, "frame_id": OPTICAL}
            turn = dict(zip("xyzw", Rotation.from_matrix(pose[:3, :3]).as_quat().tolist(), strict=True))
            placed = {"position": dict(zip("xyz", pose[:3, 3].tolist(), strict=True)), "orientation": turn}
            told = {"/info": {**about, **SIZE, "D": [], "K": K, "P": P, "distortion_model": ""}}
            told["/pose"] = {"timestamp": stamp, "frame_id": "map", "pose": placed}
            for topic, pixels, encoding in (("/color", color, "rgb8"), ("/depth", depth_mm, "16UC1")):
                data = base64.b64encode(pixels.tobytes()).decode()
                told[topic] = {**about, **SIZE, "encoding": encoding, "step": pixels[0].nbytes, "data": data}
            for topic, message in told.items():
                data = json.dumps(message).encode()
                writer.add_message(channels_of[topic], stamp_ns, data, stamp_ns)
        writer.finish()
    return path


def without_profile(path):
    """Messages of ROS 2 as a bridge writes them that is no bag recorder."""
    maker = whole("mcap")
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("a bridge")
        channels_of = {}
        for topic, received_ns, message in sorted(maker.messages, key=lambda entry: entry[1]):
            name = message.__msgtype__
            if topic not in channels_of:
                text = maker.store.generate_msgdef(name)[0].encode()
                channels_of[topic] = writer.register_channel(
                    topic, "cdr", writer.register_schema(name, "ros2msg", text)
                )
            data = bytes(maker.store.serialize_cdr(message, name))
            writer.add_message(channels_of[topic], received_ns, data, received_ns)
        writer.finish()
    return path


@pytest.mark.parametrize(
    "written", [lambda path: by_sdk(path, False), lambda path: by_sdk(path, True), by_json, without_profile]
)
def test_what_other_programs_wrote_gives_the_walk(tmp_path, written):
    source = open_source(written(tmp_path / "walk.mcap"))
    assert (source.layout, source.why) == ("ros", ("it is an MCAP file with messages of ROS 2 or Foxglove",))
    assert_the_walk(source)


def test_damaged_messages_cost_themselves_or_one_sentence(tmp_path, rng):
    data = by_json(tmp_path / "walk.mcap").read_bytes()
    for _ in range(12):
        hurt = bytearray(data)
        for place in rng.integers(0, len(hurt), 30):
            hurt[place] = rng.integers(256)
        (tmp_path / "hurt.mcap").write_bytes(hurt[: int(rng.integers(len(hurt) // 2, len(hurt)))])
        try:
            list(open_source(tmp_path / "hurt.mcap"))
        except SourceError as error:
            assert 10 < len(str(error)) < 500 and "\n" not in str(error)


def test_a_recording_of_another_program_that_was_cut_off_is_told_what_mends_it(tmp_path):
    data = without_profile(tmp_path / "walk.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[:-30])
    with pytest.raises(SourceError, match=r"its end is missing or damaged; `mcap recover cut\.mcap"):
        open_source(tmp_path / "cut.mcap")


def test_depth_lies_in_the_frames_of_a_foxglove_file(tmp_path):
    frames = [frame for frame in open_source(by_sdk(tmp_path / "a.mcap", True)) if isinstance(frame, RawFrame)]
    assert [frame.stamp_ns for frame in frames] == STAMPS_NS and frames[0].stamp_ns % MS
    assert np.array_equal(stored(frames[3].depth), DEPTHS_MM[3])

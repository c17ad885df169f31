"""What Foxglove gets, read back by readers that are not ours: MCAP's, protobuf's, a plain WebSocket client."""

import asyncio
import json
import threading
from pathlib import Path

import msgspec
import numpy as np
import pytest
import websockets
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.reader import make_reader

from prior_sg.deploy.cli.main import main
from prior_sg.deploy.errors import UserError
from prior_sg.deploy.showing.colors import label_colors
from prior_sg.deploy.showing.formats import ExportError, save
from prior_sg.deploy.showing.material import Material, Moment
from prior_sg.deploy.viewing.drawing import Painter
from prior_sg.deploy.viewing.foxglove.layout import layout
from prior_sg.deploy.viewing.foxglove.server import AGAIN_S, Broadcast, jpeg_of, lens_of
from prior_sg.deploy.viewing.foxglove.stream import LAYERS
from prior_sg.deploy.viewing.held import Held
from prior_sg.deploy.viewing.recorded import camera_of
from prior_sg.schemas.codec import copied, encode
from prior_sg.services.images import depth_of
from prior_sg.services.runtime.bus import BusError
from tests.deploy.viewing.test_recorded import log as recorded_log
from tests.help.homes import home, keyframe, marked_home, region

log = recorded_log
SCHEMAS = {
    "/map/places": "foxglove.PointCloud",
    "/map/regions": "foxglove.SceneUpdate",
    "/map/edges": "foxglove.SceneUpdate",
    "/camera/image": "foxglove.CompressedImage",
    "/camera/depth": "foxglove.RawImage",
    "/camera/calibration": "foxglove.CameraCalibration",
    "/tf": "foxglove.FrameTransform",
    "/notes": "foxglove.Log",
    "/scene": "prior_sg.Scene",
}


def decoder_of(schema_name, descriptors):
    """A reader of one message type, made of the descriptors that travel with it."""
    files = descriptor_pb2.FileDescriptorSet.FromString(descriptors)
    pool = descriptor_pool.DescriptorPool()
    for file in files.file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(schema_name)).FromString


def told(path):
    """Schema names by topic, and messages by topic with their times."""
    schemas, messages, decoders = {}, {}, {"prior_sg.Scene": json.loads}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            schemas[channel.topic] = schema.name
            if schema.name not in decoders:
                assert (schema.encoding, channel.message_encoding) == ("protobuf", "protobuf")
                decoders[schema.name] = decoder_of(schema.name, schema.data)
            messages.setdefault(channel.topic, []).append((message.log_time, decoders[schema.name](message.data)))
    return schemas, messages


@pytest.fixture(scope="module")
def exported(log):
    """The recording of a log with one keyframe, places and regions, as the command writes it."""
    out = log.with_name("out.mcap")
    assert main(["export", str(log), "--format", "foxglove", "--out", str(out)]) == 0
    return out


def test_every_topic_has_the_schema_that_panels_look_for(exported):
    schemas, messages = told(exported)
    assert SCHEMAS.items() <= schemas.items()
    assert all(len(entries) == 1 for topic, entries in messages.items() if topic.startswith("/camera"))
    times = [when for when, _ in messages["/scene"]]
    assert times == sorted(times) and times[-1] == 2 * 10**9


def test_the_image_is_the_cameras_file_where_it_was_taken(exported):
    _, messages = told(exported)
    (_, image), (_, lens), (_, pose) = (messages[topic][0] for topic in ("/camera/image", "/camera/calibration", "/tf"))
    frame = keyframe()
    assert image.data == frame.color and (image.format, image.frame_id) == ("png", "camera")
    assert (lens.width, lens.height, lens.K[0], lens.K[2], lens.P[6]) == (64, 48, 50.0, 31.5, 23.5)
    assert (pose.parent_frame_id, pose.child_frame_id) == ("world", "camera")
    assert (pose.translation.x, pose.translation.y, pose.translation.z) == pytest.approx((1.0, 1.0, 1.2))
    x, y, z, w = (getattr(pose.rotation, axis) for axis in "xyzw")
    forward = (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y))
    assert forward == pytest.approx(frame.world_from_camera[:3, 2])


def test_what_is_kept_to_show_depth_does_not_hold_the_colour_image():
    received = copied(keyframe())
    kept = camera_of(received)
    assert kept.depth.depth == received.depth and (kept.world_from_camera == received.world_from_camera).all()
    assert kept.depth.depth.obj == encode(msgspec.structs.replace(received, color=b""))
    assert not np.shares_memory(kept.world_from_camera, received.world_from_camera)


def test_depth_is_in_millimetres_beside_the_image(exported):
    _, messages = told(exported)
    ((when, image),) = messages["/camera/depth"]
    depth_m = depth_of(keyframe(), 0.5)
    assert (image.encoding, image.frame_id, image.width, image.height) == ("16UC1", "camera", 64, 48)
    assert when == messages["/camera/image"][0][0]
    shown = np.frombuffer(image.data, "<u2").reshape(48, image.step // 2)
    assert depth_m.any() and np.abs(shown / 1000 - depth_m).max() <= 0.0005


def test_regions_have_the_colours_of_the_page_and_say_what_they_are(exported):
    _, messages = told(exported)
    _, update = messages["/map/regions"][-1]
    found = {entity.id: entity for entity in update.entities}
    assert sorted(found) == ["regions/3", "regions/7"]
    colors = label_colors(home())
    for name, label in (("regions/3", "kitchen"), ("regions/7", "bedroom")):
        floor = found[name].triangles[0]
        red, green, blue = (round(255 * getattr(floor.color, part)) for part in "rgb")
        assert (red, green, blue) == colors[label] and 0 < floor.color.a < 1
        assert max(floor.indices) < len(floor.points)
        assert found[name].texts[0].text.startswith(label)
        assert {pair.key: pair.value for pair in found[name].metadata}["label"] == label
        assert found[name].frame_id == "world"


def test_each_message_holds_its_whole_layer(exported):
    _, messages = told(exported)
    for layer in ("regions", "edges"):
        for _, update in messages[f"/map/{layer}"]:
            assert [deletion.type for deletion in update.deletions] == [1]  # all
    assert len(messages["/map/edges"][-1][1].entities[0].lines[0].points) == 2 * len(home().edges)


def test_places_are_points_with_colours(exported):
    _, messages = told(exported)
    _, cloud = messages["/map/places"][-1]
    assert [field.name for field in cloud.fields] == ["x", "y", "z", "red", "green", "blue", "alpha"]
    assert cloud.point_stride == 16 and len(cloud.data) == 16 * len(home().place_ids)
    rows = np.frombuffer(cloud.data, np.dtype([("m", "<f4", 3), ("rgba", "u1", 4)]))
    assert rows["m"] == pytest.approx(home().positions_m) and rows["rgba"][0, 3] == 255
    assert tuple(rows["rgba"][0, :3]) == label_colors(home())["kitchen"]


def test_the_layout_shows_our_topics(exported):
    written = json.loads(exported.with_name("out-layout.json").read_text())
    assert written == json.loads(layout().to_json())
    text, schemas = json.dumps(written), told(exported)[0]
    assert all(f'"{topic}"' in text for topic in SCHEMAS if topic.startswith(("/map", "/camera", "/notes")))
    assert {f"/map/{name}" for name in LAYERS} >= {topic for topic, schema in schemas.items() if "SceneUpd" in schema}


def test_the_log_that_is_read_is_not_written(log, capsys):
    assert main(["export", str(log.parent), "--format", "foxglove", "--out", str(log)]) == 1
    assert "is what is read" in capsys.readouterr().err


def test_a_story_from_nothing_keeps_what_a_label_was_coloured(tmp_path):
    empty = nothing()
    assert not any(name.startswith("/places") for name in Painter().draw(empty))
    renamed = [region(3, "bath", 0.9, (2.0, 1.5, 1.0)), *home().regions[1:]]
    later = msgspec.structs.replace(home(), regions=renamed, stamp_ns=3 * 10**9)
    path = tmp_path / "story.mcap"
    save(Material(later, moments=[Moment(0, empty), Moment(1, home()), Moment(2, later)]), path, "foxglove")
    _, messages = told(path)
    boxes = messages["/map/objects"][0][1].entities[0].lines[0]
    assert len(boxes.points) == 2 * 24 and boxes.scale_invariant  # two with a name, of twelve edges each
    assert "/camera/image" not in messages and len(messages["/map/regions"]) == 2
    first, second = ({e.id: e for e in update.entities} for _, update in messages["/map/regions"])
    assert first["regions/7"].triangles[0].color == second["regions/7"].triangles[0].color
    assert first["regions/3"].triangles[0].color != second["regions/3"].triangles[0].color


def nothing():
    """The home before anything was seen."""
    whole = home()
    columns = {
        name: getattr(whole, name)[:0]
        for name in whole.__struct_fields__
        if isinstance(getattr(whole, name), np.ndarray) and name != "trajectory"
    }
    return msgspec.structs.replace(whole, regions=[], stamp_ns=0, **columns)


def test_what_a_region_is_said_to_be_is_told_though_it_looks_the_same(tmp_path):
    doubted = [msgspec.structs.replace(one, unknown=0.5) for one in home().regions]
    later = msgspec.structs.replace(home(), regions=doubted, stamp_ns=2 * 10**9)
    save(Material(later, moments=[Moment(0, home()), Moment(1, later)]), tmp_path / "a.mcap", "foxglove")
    updates = [update for _, update in told(tmp_path / "a.mcap")[1]["/map/regions"]]
    facts = [{pair.key: pair.value for pair in update.entities[0].metadata} for update in updates]
    assert [fact["unknown"] for fact in facts] == ["0.0", "0.5"]


def test_a_marker_is_one_entity_that_says_what_it_is(tmp_path):
    save(Material(marked_home()), tmp_path / "a.mcap", "foxglove")
    _, update = told(tmp_path / "a.mcap")[1]["/map/markers"][-1]
    found = {entity.id: {pair.key: pair.value for pair in entity.metadata} for entity in update.entities}
    assert sorted(found) == ["markers/7/in_apriltag_36h11", "markers/9/in_apriltag_36h11"]
    assert (
        found["markers/7/in_apriltag_36h11"]["doubt"] == "none"
        and "2 spots" in found["markers/9/in_apriltag_36h11"]["doubt"]
    )


def test_a_file_that_cannot_be_written_is_one_sentence(capsys):
    with pytest.raises(ExportError, match="cannot write"):
        save(Material(home()), Path("/proc/nowhere/x.mcap"), "foxglove")
    assert main(["foxglove", "--layout", "/proc/nowhere/layout.json"]) == 1
    assert "cannot write /proc/nowhere/layout.json" in capsys.readouterr().err


class Filmed(Held):
    """With one image."""

    def camera(self, until_ns=np.inf):
        return camera_of(keyframe())


async def subscribed(address, topics, ready):
    """Messages by topic that a client gets after it has asked for them, by Foxglove's protocol."""
    found = {}
    async with websockets.connect(address, subprotocols=["foxglove.sdk.v1"], max_size=None) as client:
        channels = {}
        while not topics <= channels.keys():
            text = await asyncio.wait_for(client.recv(), 10)
            for channel in json.loads(text).get("channels", []) if isinstance(text, str) else []:
                channels[channel["topic"]] = channel
        wanted = sorted(topics)
        asked = [{"id": number, "channelId": channels[topic]["id"]} for number, topic in enumerate(wanted)]
        await client.send(json.dumps({"op": "subscribe", "subscriptions": asked}))
        ready.set()
        while topics - found.keys():
            data = await asyncio.wait_for(client.recv(), 10)
            if isinstance(data, bytes) and data[0] == 1:
                topic = wanted[int.from_bytes(data[1:5], "little")]
                found[topic] = channels[topic]["schemaName"], data[13:]
    return found


def test_a_client_that_comes_late_gets_everything():
    source, ready, stop = Filmed(home()), threading.Event(), threading.Event()
    broadcast = Broadcast(source, 0)

    def follow():
        while not stop.is_set():
            broadcast.follow(0.05)

    serving = threading.Thread(target=follow)
    serving.start()
    try:
        topics = {"/map/regions", "/map/places", "/camera/image", "/camera/depth", "/scene"}
        for _ in range(2):  # the second finds all sent already
            found = asyncio.run(subscribed(broadcast.address, topics, ready))
            assert {topic: schema for topic, (schema, _) in found.items()} == {t: SCHEMAS[t] for t in topics}
            rows = json.loads(found["/scene"][1])["regions"]
            assert [row["label"] for row in rows] == ["kitchen", "bedroom"]
        assert broadcast.address.startswith("ws://127.0.0.1:")
        with pytest.raises(UserError, match="choose another with --port"):
            Broadcast(source, int(broadcast.address.rsplit(":", 1)[1]))
    finally:
        stop.set()
        serving.join()
        broadcast.close()


def test_all_is_told_again_once_a_subscription_stands(monkeypatch):
    """What is sent before the server hears a client's subscription goes to nobody."""
    source, shown, now_s = Held(home()), [], [100.0]
    broadcast = Broadcast(source, 0)
    monkeypatch.setattr(broadcast._stream, "show", lambda scene, stamp_ns: shown.append(stamp_ns))
    monkeypatch.setattr("prior_sg.deploy.viewing.foxglove.server.time.monotonic", lambda: now_s[0])
    broadcast.follow(0.0)
    shown.clear()
    broadcast._newcomers.on_subscribe(None, None)
    for expected, later_s in ((1, 0.1), (1, AGAIN_S), (2, 5.0), (2, 0.0)):
        broadcast.follow(0.0)
        assert len(shown) == expected
        now_s[0] += later_s
    broadcast.close()


class Gone(Held):
    """Whose store does not answer, until it does."""

    silent = True

    def scene(self, moment=None):
        if self.silent:
            raise BusError("nobody answers")
        return super().scene(moment)


def test_a_store_that_does_not_answer_is_noted_once_and_asked_again(monkeypatch):
    source, notes, shown = Gone(home()), [], []
    broadcast = Broadcast(source, 0)
    monkeypatch.setattr(broadcast._stream, "note", lambda text, stamp_ns: notes.append(text))
    monkeypatch.setattr(broadcast._stream, "show", lambda scene, stamp_ns: shown.append(stamp_ns))
    source.put(home())
    broadcast.follow(0.0)
    broadcast.follow(0.0)
    assert (notes, shown) == (["nobody answers"], [])
    source.silent = False
    broadcast.follow(0.0)
    broadcast.follow(0.0)
    broadcast.close()
    assert (notes, shown) == (["nobody answers"], [10**9])


def test_a_smaller_image_has_a_smaller_lens():
    camera = camera_of(keyframe())
    half = type(camera)(0, 1, camera.intrinsics, camera.world_from_camera, camera.image[::2, ::2])
    lens = lens_of(half)
    assert (lens.width_px, lens.height_px, lens.fx_px, lens.cx_px, lens.cy_px) == (32, 24, 25.0, 15.5, 11.5)
    assert jpeg_of(half).startswith(b"\xff\xd8\xff")

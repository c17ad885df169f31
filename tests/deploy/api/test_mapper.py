"""The method in the calling process, on a bare room drawn here."""

import json

import msgspec
import numpy as np
import pytest

import prior_sg
from prior_sg.deploy.api.frames import frame_of
from prior_sg.schemas.codec import encode
from prior_sg.schemas.frames import Intrinsics, Keyframe
from prior_sg.schemas.topics import KEYFRAME
from prior_sg.services.runtime.record import LogWriter
from tests.help.paths import ROOT
from tests.test_examples import example

HOME, TASK, FRAMES = "residential home", "real-estate listing", 8
room = example("03_arrays")


def arrays(number):
    view = room.pose(1.4 if number < 4 else 2.6, 2.0, number * np.pi / 3)
    return {
        "color": np.full((room.HEIGHT, room.WIDTH, 3), (200, 180, 150), np.uint8),
        "depth": room.depth_of_room(view),
        "intrinsics": room.CAMERA,
        "world_from_camera": view,
        "stamp_ns": number * 500_000_000,
    }


def mapped():
    mapper = prior_sg.Mapper(HOME, TASK)
    for number in range(FRAMES):
        assert mapper.add(**arrays(number))
    return mapper


@pytest.fixture(scope="module")
def mapper():
    with mapped() as mapper:
        yield mapper


def test_the_scene_is_settled_labelled_and_the_same_again(mapper):
    scene = mapper.scene
    assert scene.task == TASK and len(scene.places) > 5 and (scene.places.region_ids >= 0).all()
    assert mapper.progress.keyframes == FRAMES == mapper.progress.encoded
    assert encode(mapper.scene.message) == encode(scene.message)
    with mapped() as again:
        assert encode(again.scene.message) == encode(scene.message)


def test_another_task_looks_at_no_image_again(mapper, monkeypatch):
    def fail(crops):
        raise AssertionError("an image was encoded again")

    monkeypatch.setattr(mapper._pipeline.of("feature_pyramid").state.encoder, "encode_images", fail)
    before = mapper.scene
    other = mapper.task("hospitality service")
    assert other.task == "hospitality service" and set(other.labels) != set(before.labels)
    np.testing.assert_array_equal(other.places.ids, before.places.ids)
    fixed = mapper.task("anything", regions=["kitchen", "bedroom"])
    assert fixed.labels == ("kitchen", "bedroom") and set(fixed.regions.labels) <= {"kitchen", "bedroom"}
    assert encode(mapper.task(TASK).message) == encode(mapper.scene.message)
    assert mapper.scene.task == TASK == mapper.prior.task


def test_explain(mapper):
    place = int(mapper.scene.places.ids[0])
    reply = mapper.explain(place)
    assert reply.label == mapper.scene.places.labels[0] and reply.votes[0].expert == "visual"
    with pytest.raises(prior_sg.NotInSceneError, match="no labelled place 99999"):
        mapper.explain(99999)


def test_save(mapper, tmp_path):
    folder = mapper.save(tmp_path / "out")
    assert sorted(path.name for path in folder.iterdir()) == ["dsg.json", "map-3d.png", "map.png", "scene.json"]
    assert json.loads((folder / "scene.json").read_text()) == mapper.scene.to_dict()
    assert json.loads(mapper.save(tmp_path / "one.json").read_text()) == mapper.scene.to_dict()
    for _ in range(2):  # over the former one
        database = mapper.save(tmp_path / "one.sqlite")
    saved = msgspec.structs.replace(prior_sg.Scene.read(database).message, revision=mapper.scene.revision)
    assert encode(saved) == encode(mapper.scene.message)
    with pytest.raises(prior_sg.SaveError, match=r"ends in \.xml; name a folder, or a file"):
        mapper.save(tmp_path / "one.xml")
    with pytest.raises(prior_sg.SaveError, match="choose another place"):
        mapper.save(database / "below")


BAD_ARRAYS = {
    "color must be uint8": {"color": np.zeros((4, 4, 3))},
    "depth must have the shape": {"depth": np.zeros((4, 4))},
    "depth must be float in metres or uint16": {"depth": np.zeros((room.HEIGHT, room.WIDTH), np.int64)},
    "rotation is not orthonormal": {"world_from_camera": np.zeros((4, 4))},
    "an Intrinsics or a matrix": {"intrinsics": np.eye(2)},
    "the camera has 8 x 8 pixels": {"intrinsics": Intrinsics(8, 8, 1.0, 1.0, 0.0, 0.0)},
    "add takes a frame, or color": {"stamp_ns": None},
}


@pytest.mark.parametrize("sentence", BAD_ARRAYS)
def test_unusable_arrays_are_one_sentence(mapper, sentence):
    before = mapper.progress
    with pytest.raises(prior_sg.SourceError, match=sentence) as error:
        mapper.add(**(arrays(0) | BAD_ARRAYS[sentence]))
    assert "\n" not in str(error.value) and mapper.progress == before


def test_a_frame_that_cannot_follow_is_counted(mapper):
    before = mapper.progress.rejected
    assert not mapper.add(**arrays(0))  # its stamp is behind
    assert mapper.progress.rejected == before + 1


def test_depth_in_millimetres_is_the_same():
    metres = arrays(1)
    whole = metres | {"depth": np.rint(1000 * metres["depth"]).astype(np.uint16)}
    one, other = frame_of(3, **metres), frame_of(3, **whole)
    assert one.depth == other.depth and one.intrinsics == Intrinsics(320, 240, 160.0, 160.0, 159.5, 119.5)


@pytest.mark.parametrize(
    "settings, kind, sentence",
    [
        ({"beta": 1}, prior_sg.ConfigError, "SERVICE.FIELD"),
        ({"nobody.beta": 1}, prior_sg.ConfigError, "no service 'nobody'"),
        ({"segmenter.betta": 1}, prior_sg.ConfigError, "no setting 'betta'"),
        ({"prior_gateway.provider": "openai"}, prior_sg.ConfigError, "asks the library"),
        ({"scene_store.path": "x"}, prior_sg.ConfigError, "keeps nothing"),
    ],
)
def test_wrong_settings_are_told_before_anything_is_loaded(settings, kind, sentence):
    with pytest.raises(kind, match=sentence):
        prior_sg.Mapper(HOME, TASK, settings=settings)


def test_what_the_library_does_not_know_is_the_librarys_sentence():
    with pytest.raises(prior_sg.NoPriorError, match="knows no environment like 'submarine'"):
        prior_sg.Mapper("submarine", "dive")


def test_a_source_that_is_none(mapper):
    with pytest.raises(prior_sg.Error, match="does not exist"):
        mapper.read(ROOT / "nowhere")


def test_a_source_is_read_to_its_end_and_not_twice(mapper, tmp_path):
    with LogWriter(tmp_path / "more.mcap") as log:
        for number in (100, 101):
            frame = frame_of(number, **arrays(number))
            fields = {name: getattr(frame, name) for name in Keyframe.__struct_fields__ if hasattr(frame, name)}
            keyframe = Keyframe(robot="robot1", **fields)
            log.add(KEYFRAME, KEYFRAME.key_of(keyframe), encode(keyframe), "w/1/1", number, 0, 0)
    before, told = mapper.progress.keyframes, []
    mapper.read(tmp_path / "more.mcap", progress=lambda done, total: told.append((done, total)))
    assert told == [(1, 2), (2, 2)] and mapper.progress.keyframes == before + 2
    with pytest.raises(
        prior_sg.SourceError, match=r"no frame of .*more\.mcap can be used: \d+ of \d+ frames refused: their stamps"
    ):
        mapper.read(prior_sg.open_source(tmp_path / "more.mcap"))


def test_a_recording_read_again_is_another_walk(tmp_path):
    with LogWriter(tmp_path / "walk.mcap") as log:
        for number in range(4):
            frame = frame_of(number, **arrays(number))
            fields = {name: getattr(frame, name) for name in Keyframe.__struct_fields__ if hasattr(frame, name)}
            keyframe = Keyframe(robot="robot1", **fields)
            log.add(KEYFRAME, KEYFRAME.key_of(keyframe), encode(keyframe), "w/1/1", number, 0, 0)
    with prior_sg.Mapper(HOME, TASK, settings={"ingest.every_frame": True}) as mapper:
        mapper.read(tmp_path / "walk.mcap")
        once = mapper.progress.keyframes
        mapper.read(tmp_path / "walk.mcap")
        assert (once, mapper.progress.keyframes, mapper.progress.rejected) == (4, 8, 0)


def test_what_is_lost_is_told(mapper):
    (loss,) = [loss for loss in mapper.losses if loss.reason == "their stamps go back"]
    assert loss.what == "frames refused" and loss.count >= 1

import threading
import time
from pathlib import Path

import msgspec
import numpy as np
import pytest

from prior_sg.deploy.cli.main import main
from prior_sg.deploy.errors import UserError
from prior_sg.deploy.showing.moments import cloud_of
from prior_sg.deploy.viewing.live import MOST_IMAGES, Live
from prior_sg.deploy.viewing.recorded import open_recorded
from prior_sg.schemas.codec import LAST_NUMBER, decode, encode
from prior_sg.schemas.frames import ArchiveReply, ArchiveRequest, Keyframe, PoseUpdate
from prior_sg.schemas.places import PlaceDelta
from prior_sg.schemas.regions import RegionDelta
from prior_sg.schemas.topics import KEYFRAME, PLACE_DELTA, POSE_UPDATE, REGION_DELTA
from prior_sg.services.runtime.bus import Hub, LocalBus, LocalRequest
from prior_sg.services.runtime.record import LogError, LogWriter, read_log
from tests.help.homes import home, keyframe

NO_IDS, NO_PAIRS = np.zeros(0, np.int64), np.zeros((0, 2), np.int64)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A keyframe, the places of a home, then its regions, a second apart."""
    path, scene = tmp_path_factory.mktemp("run") / "log.mcap", home()
    places = PlaceDelta(
        robot="robot1",
        epoch=1,
        revision=0,
        stamp_ns=10**9,
        frame_id=0,
        place_ids=scene.place_ids,
        positions_m=scene.positions_m,
        radii_m=scene.radii_m,
        basis_points=scene.basis_points,
        removed_ids=NO_IDS,
        merged_ids=NO_PAIRS,
        edges=scene.edges,
        clearances_m=scene.clearances_m,
        removed_edges=NO_PAIRS,
        camera_m=(1.0, 1.0, 1.2),
    )
    regions = RegionDelta(
        robot="robot1",
        epoch=1,
        revision=0,
        stamp_ns=2 * 10**9,
        prior_digest="",
        environment=scene.environment,
        task=scene.task,
        space="",
        labels=scene.labels,
        regions=scene.regions,
        removed_ids=NO_IDS,
        place_ids=scene.place_ids,
        place_regions=scene.place_regions,
        posteriors=scene.posteriors,
        unknown=scene.unknown,
        removed_place_ids=NO_IDS,
        energy=0.0,
    )
    with LogWriter(path) as writer:
        for topic, message in ((KEYFRAME, keyframe()), (PLACE_DELTA, places), (REGION_DELTA, regions)):
            writer.add(topic, topic.key_of(message), encode(message), "test", 0, 1, 1)
    return path


def test_a_log_shows_every_moment_with_its_image_and_points(log: Path) -> None:
    source = open_recorded(str(log.parent), "robot1")
    source._reader.join()
    assert source.stamps() == [10**9, 2 * 10**9]
    assert [len(source.scene(moment).regions) for moment in (0, 1, None)] == [0, 2, 2]
    assert len(source.scene(0).place_ids) == 10
    camera = source.camera()
    assert camera is not None and camera.image.shape == (48, 64, 3)
    assert source.camera(until_ns=0) is None
    assert len(source.cloud) > 100
    with pytest.raises(LogError, match="segmenter"):
        source.explain(10, lambda text: None)
    with pytest.raises(UserError, match="prior-sg up"):
        source.switch("tidy up", "", lambda text: None)
    source.close()


def pose_update(revision: int) -> PoseUpdate:
    return PoseUpdate(
        robot="robot1",
        epoch=1,
        revision=revision,
        stamp_ns=1,
        frame_ids=np.array([9]),
        world_from_camera=np.eye(4)[None],
    )


def test_what_no_service_took_hides_nothing_of_a_log(log: Path, tmp_path: Path) -> None:
    """Garbage, and poses numbered so far ahead that they are not believed."""
    path = tmp_path / "log.mcap"
    absurd = [encode(pose_update(0)), encode(pose_update(LAST_NUMBER)), b"\xff" * 20]
    with LogWriter(path) as writer:
        for payload in absurd:
            writer.add(POSE_UPDATE, POSE_UPDATE.key_of(pose_update(0)), payload, "test", 0, 1, 1)
        writer.add(KEYFRAME, KEYFRAME.key_of(keyframe()), b"\xff" * 20, "test", 0, 1, 1)
        for logged in read_log(log, (KEYFRAME, PLACE_DELTA)):
            writer.add(logged.topic, logged.key, logged.payload, "test", 0, 1, 1)
    source = open_recorded(str(path), "robot1")
    source._reader.join()
    assert len(source.cloud) > 100
    source.close()
    cloud = cloud_of(path, "robot1")
    assert cloud is not None and len(cloud.points_world) > 20

    bus = LocalBus(Hub())
    live = Live(bus, "robot1")
    for payload in absurd:
        bus.put(POSE_UPDATE, POSE_UPDATE.key_of(pose_update(0)), payload, b"")
    bus.put(KEYFRAME, KEYFRAME.key_of(keyframe()), encode(keyframe()), b"")
    end_s = time.monotonic() + 30
    while not len(live.cloud) and time.monotonic() < end_s:
        time.sleep(0.02)
    assert len(live.cloud) > 100
    live.close()


def test_images_that_come_too_fast_are_fetched_later(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[int] = []
    busy, free = threading.Event(), threading.Event()

    def take(self: Live, keyframe: Keyframe) -> None:
        busy.set()
        free.wait(10)
        drawn.append(keyframe.frame_id)

    monkeypatch.setattr(Live, "_take_image", take)
    bus, asked = LocalBus(Hub()), []

    def archive(request: LocalRequest) -> None:
        first = decode(ArchiveRequest, request.payload).first_frame_id
        asked.append(first)
        keyframes = [msgspec.structs.replace(keyframe(), frame_id=number) for number in range(first, 200)][:16]
        request.reply(encode(ArchiveReply(robot="robot1", oldest_frame_id=0, keyframes=keyframes)))

    live = Live(bus, "robot1")
    for number in range(200):
        sent = msgspec.structs.replace(keyframe(), frame_id=number)
        bus.put(KEYFRAME, KEYFRAME.key_of(sent), encode(sent), b"")
        if not number:
            assert busy.wait(5)
    bus.serve("psg/robot1/ask/keyframes", archive)
    free.set()
    end_s = time.monotonic() + 30
    while set(drawn) != set(range(200)) and time.monotonic() < end_s:
        time.sleep(0.02)
    assert drawn[: MOST_IMAGES + 1] == [0, *range(200 - MOST_IMAGES, 200)]  # the newest first
    assert set(drawn) == set(range(200)) and asked[0] == 0
    live.close()


def test_another_robot_is_named(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["view", str(log), "--robot", "robot9"]) == 1
    said = " ".join(capsys.readouterr().err.split())
    assert "robot9" in said and "robot1" in said and "--robot" in said

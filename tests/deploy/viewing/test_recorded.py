from pathlib import Path

import numpy as np
import pytest

from prior_sg.deploy.cli.main import main
from prior_sg.deploy.errors import UserError
from prior_sg.deploy.viewing.recorded import open_recorded
from prior_sg.schemas.codec import encode
from prior_sg.schemas.places import PlaceDelta
from prior_sg.schemas.regions import RegionDelta
from prior_sg.schemas.topics import KEYFRAME, PLACE_DELTA, REGION_DELTA
from prior_sg.services.runtime.record import LogError, LogWriter
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


def test_another_robot_is_named(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["view", str(log), "--robot", "robot9"]) == 1
    said = " ".join(capsys.readouterr().err.split())
    assert "robot9" in said and "robot1" in said and "--robot" in said

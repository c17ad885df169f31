"""Every example runs, on few frames."""

import importlib.util
import threading

import pytest

from prior_sg.deploy.api.client import Client
from prior_sg.deploy.running.supervisor import Supervisor
from prior_sg.schemas.topics import KEYFRAME
from prior_sg.services.registry import SERVICES
from prior_sg.services.runtime.endpoints import free_endpoint
from prior_sg.services.runtime.record import LogWriter, read_log
from prior_sg.services.runtime.zenoh_router import open_router
from prior_sg.services.segmenter.core.experts import REGISTRY
from tests.help.paths import ROOT, SAMPLE

FRAMES = 4


def example(name):
    """An example as a module; its name begins with a digit, so that it is loaded by path."""
    spec = importlib.util.spec_from_file_location(f"example_{name}", ROOT / "examples" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def system(tmp_path_factory):
    """All services on a router of their own, with a few frames of the sample mapped; where to reach it."""
    folder = tmp_path_factory.mktemp("live")
    with LogWriter(folder / "short.mcap") as log:
        for sample in list(read_log(SAMPLE, [KEYFRAME]))[:FRAMES]:
            fields = (sample.writer, sample.sequence, sample.sent_ns, sample.received_ns)
            log.add(sample.topic, sample.key, sample.payload, *fields)
    endpoint = free_endpoint("tcp/127.0.0.1:0")
    stop_router = open_router(endpoint)
    settings = [f"scene_store.path={folder / 'scene.sqlite'}", f"ingest.source={folder / 'short.mcap'}"]
    supervisor = Supervisor(endpoint, "robot1", folder / "logs", settings)
    try:
        for service in sorted(SERVICES, key=lambda service: service.name == "ingest"):
            supervisor.start(service.name)
        with Client(endpoint) as client:
            wait_for(lambda: len(client.scene().trajectory_m) == FRAMES)
        yield endpoint
    finally:
        supervisor.stop()
        stop_router()


def wait_for(condition, timeout_s=90.0):
    """Until it holds; a store that is not there yet is waited for."""
    from prior_sg import BusError

    ended = threading.Event()
    for _ in range(int(timeout_s / 0.2)):
        try:
            if condition():
                return
        except BusError:
            pass
        ended.wait(0.2)
    raise AssertionError("it never came to hold")


def test_notebook(capsys):
    scene = example("01_notebook").main(frames=FRAMES)
    assert scene.task == "hospitality service" and len(scene.places) > 10 and (scene.places.region_ids >= 0).all()
    assert "'real-estate listing' in 'residential home'" in capsys.readouterr().out


def test_arrays():
    scene = example("03_arrays").main()
    assert len(scene.trajectory_m) == 12 and len(scene.places) > 5
    inside = (scene.places.positions_m > 0).all(axis=1) & (scene.places.positions_m < (4.0, 4.0, 2.6)).all(axis=1)
    assert inside.all() and 0.9 < scene.places.radii_m.max() < 2.0


def test_new_expert():
    try:
        assert set(example("04_new_expert").main(frames=FRAMES)) == {"visual", "environment", "ceiling"}
    finally:
        REGISTRY.pop("ceiling", None)


def test_live_task_and_its_changes(system, capsys):
    scene = example("02_live_task").main("real-estate listing", "residential home", connect=system)
    assert scene.task == "real-estate listing" and len(scene.regions) > 0
    assert "segmenter: busy" in capsys.readouterr().out
    follower = threading.Thread(target=example("05_follow_changes").main, args=(system, 2))
    follower.start()
    example("02_live_task").main("hospitality service", connect=system)
    follower.join(30)
    assert not follower.is_alive() and "region " in capsys.readouterr().out

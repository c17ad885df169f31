"""The encoder is exchanged while everything runs: real processes, a real router, a real recording."""

import signal
import time

import pytest

from prior_sg.deploy.running.supervisor import Supervisor
from prior_sg.schemas.codec import decode
from prior_sg.schemas.priors import Task
from prior_sg.schemas.topics import INGEST_STATE, PYRAMID, REGION_DELTA, TASK
from prior_sg.services.runtime.client import BusClient
from prior_sg.services.runtime.zenoh_bus import ZenohBus
from tests.help.long import long_run
from tests.help.world import Reader
from tests.test_pipeline import shortened

OLD, NEW = (f"conse/efficientnet-lite{size}/minilm-l6-v2" for size in (0, 1))
FRAMES = 10
ROBOT = "robot1"


class Watch:
    """What a client sees: the newest regions, the spaces of all deltas, and who encoded what in which space."""

    def __init__(self, client):
        self.reader, self.spaces, self.encoded, self.state, self.task = Reader(), [], {}, None, ""
        client.listen(REGION_DELTA, ROBOT, self.saw_regions)
        client.listen(PYRAMID, ROBOT, self.saw_pyramid)
        client.listen(INGEST_STATE, ROBOT, self.saw_ingest)

    def saw_ingest(self, sample):
        self.state = decode(sample.topic.type, sample.payload)

    def saw_pyramid(self, sample):
        pyramid = decode(sample.topic.type, sample.payload)
        self.encoded.setdefault(pyramid.space, []).append(pyramid.frame_id)

    def saw_regions(self, sample):
        delta = decode(sample.topic.type, sample.payload)
        self.reader.apply(delta)
        self.task = delta.task
        self.spaces.append((delta.space, len(self.reader.beliefs)))
        assert all(belief[0] in self.reader.regions for belief in self.reader.beliefs.values())


def until(condition, supervisors, timeout_s=120.0):
    end_s = time.monotonic() + timeout_s
    while not condition():
        for supervisor in supervisors:
            supervisor.check()
        assert time.monotonic() < end_s, "did not happen"
        time.sleep(0.05)


@pytest.fixture
def system(tmp_path, endpoint):
    """All services on a short recording, and a supervisor for the workers of the other space."""
    common = ["feature_pyramid.layers=1", "feature_pyramid.smallest_crop_px=480"]
    settings = [
        f"ingest.source={shortened(tmp_path / 'short.mcap', FRAMES)}",
        f"scene_store.path={tmp_path / 'scene.sqlite'}",
        f"feature_pyramid.space={OLD}",
        f"segmenter.space={OLD}",
    ]
    supervisors = [
        Supervisor(endpoint, ROBOT, tmp_path / "old", common + settings),
        Supervisor(endpoint, ROBOT, tmp_path / "new", [*common, f"feature_pyramid.space={NEW}"]),
    ]
    try:
        yield supervisors
    finally:
        for supervisor in supervisors:
            supervisor.stop()


@long_run
def test_a_new_encoder_takes_over_and_the_old_one_may_go(system, endpoint):
    first, second = system
    with BusClient(ZenohBus(endpoint)) as client:
        watch = Watch(client)
        for name in ("prior_gateway", "segmenter", "place_graph", "feature_pyramid"):
            first.start(name)
        client.publish(TASK, Task(robot=ROBOT, stamp_ns=1, environment="residential home", task="real-estate listing"))
        first.start("ingest")
        until(lambda: watch.state is not None and watch.state.finished, system)
        until(lambda: watch.spaces and watch.spaces[-1][0] == OLD, system)
        assert set(watch.encoded[OLD]) == set(range(FRAMES))
        places = set(watch.reader.beliefs)
        second.start("feature_pyramid")
        until(lambda: watch.spaces[-1][0] == NEW, system)
        assert sorted(watch.encoded[NEW]) == list(range(FRAMES))  # all of the archive, each frame once
        assert set(watch.reader.beliefs) >= places  # nobody lost its label on the way
        assert all(count >= len(places) for space, count in watch.spaces if space == NEW)
        (old_worker,) = (child for child in first.children if child.service == "feature_pyramid")
        old_worker.process.send_signal(signal.SIGKILL)
        old_worker.process.wait()
        client.publish(TASK, Task(robot=ROBOT, stamp_ns=2, environment="residential home", task="hospitality service"))
        until(lambda: watch.task == "hospitality service", [second])
        assert watch.spaces[-1][0] == NEW

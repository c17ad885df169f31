"""What a thin link carries: all that may not be lost, states of the moment less often, and no keyframes."""

import json
import time

import pytest

from prior_sg.schemas.topics import CAMERA_STATE, KEYFRAME, PLACE_DELTA, TASK, TOPICS
from prior_sg.services.runtime.bus import pack_header
from prior_sg.services.runtime.shaping import LEAST_BUFFER
from prior_sg.services.runtime.zenoh_router import router_settings
from tests.help.fleet import ROBOTS, Fleet, beyond, until

SENT = 60


@pytest.fixture(scope="module")
def fleet(tmp_path_factory):
    made = Fleet(tmp_path_factory.mktemp("thin"), thin_bps=2e6)
    yield made
    made.close()


def listen(bus):
    heard = {topic: [] for topic in (CAMERA_STATE, KEYFRAME, PLACE_DELTA, TASK)}
    for topic, samples in heard.items():
        bus.subscribe(topic, topic.pattern("robotA"), samples.append, lambda *_: None)
    return heard


def test_a_thin_link_carries_states_less_often_and_no_keyframes(fleet):
    robot = fleet.at(fleet.robot)
    there, here = listen(fleet.at(fleet.local)), listen(fleet.at(fleet.robot))
    header = pack_header("test/a/1", 0, time.time_ns())
    until(lambda: robot.put(TASK, "psg/robotA/task", b"x", header) or (there[TASK] and here[TASK]), 30)
    began_s = time.monotonic()
    for number in range(SENT):
        for topic in (CAMERA_STATE, KEYFRAME, PLACE_DELTA):
            robot.put(topic, topic.pattern("robotA"), bytes(100), pack_header("test/a/1", number, time.time_ns()))
        time.sleep(0.02)
    until(lambda: len(there[PLACE_DELTA]) >= SENT and len(here[KEYFRAME]) >= SENT, 60)
    took_s = time.monotonic() - began_s
    assert len(there[PLACE_DELTA]) == SENT and there[KEYFRAME] == []
    assert 1 <= len(there[CAMERA_STATE]) <= 2 + CAMERA_STATE.beyond_hz * took_s
    assert len(here[CAMERA_STATE]) > len(there[CAMERA_STATE])


def test_the_settings_of_a_thin_link(fleet):
    def settings(bps):
        return router_settings("tcp/127.0.0.1:1", beyond(fleet.own.bundle("edge1"), ("tls/0.0.0.0:2",), thin_bps=bps))

    link = settings(2e6)["transport"]["link"]
    assert link["tls"]["so_sndbuf"] == 62_500 and link["tls"]["enable_mtls"]
    assert settings(1e4)["transport"]["link"]["tls"]["so_sndbuf"] == LEAST_BUFFER
    rules = settings(2e6)["downsampling"][0]["rules"]
    seldom = [topic for topic in TOPICS if topic.beyond_hz]
    assert seldom and {rule["key_expr"] for rule in rules} == {t.pattern(name) for t in seldom for name in ROBOTS}
    fast = settings(0)
    assert "downsampling" not in fast and "so_sndbuf" not in json.dumps(fast)

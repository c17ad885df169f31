"""The bridge over real Zenoh: two robots that are replayed become one map; and it may write nobody else's."""

import asyncio
import threading
import time

import numpy as np
import pytest

from prior_sg.deploy.fleet.bridge import SERVICE
from prior_sg.deploy.fleet.core.finding.frames import level
from prior_sg.deploy.fleet.core.update import Config
from prior_sg.deploy.keys.access import grants_of
from prior_sg.deploy.keys.authority import Authority
from prior_sg.schemas.codec import encode
from prior_sg.schemas.scene import SceneRequest
from prior_sg.schemas.topics import PLACE_DELTA, SCENE, topic_of
from prior_sg.services.registry import BY_NAME
from prior_sg.services.runtime.bus import BusError, pack_header
from prior_sg.services.runtime.client import BusClient
from prior_sg.services.runtime.endpoints import free_endpoint
from prior_sg.services.runtime.host.host import Host
from prior_sg.services.runtime.keys import VARIABLE
from prior_sg.services.runtime.service import Identity
from prior_sg.services.runtime.zenoh_bus import ZenohBus
from prior_sg.services.runtime.zenoh_router import open_router
from prior_sg.services.scene_store.core.config import Config as StoreConfig
from tests.help import houses
from tests.help.fleet import beyond, until

MOVED = level(2.3, np.array((12.0, -7.0, 0.4)))


@pytest.fixture
def router():
    endpoint = free_endpoint("tcp/127.0.0.1:0")
    close = open_router(endpoint)
    yield endpoint
    close()


class Running:
    """Hosts on one event loop in a thread, each with a bus of its own."""

    def __init__(self, endpoint, *parts):
        self.loop = asyncio.new_event_loop()
        self.thread = threading.Thread(target=self.loop.run_forever, daemon=True)
        self.thread.start()
        self.hosts = []
        for service, cfg, robot in parts:
            host = asyncio.run_coroutine_threadsafe(self.host(endpoint, service, cfg, robot), self.loop).result(20)
            self.hosts.append((host, asyncio.run_coroutine_threadsafe(host.run(), self.loop)))

    async def host(self, endpoint, service, cfg, robot):
        bus = await asyncio.to_thread(ZenohBus, endpoint, 5.0)
        return Host(service, bus, cfg, Identity(robot, f"{service.name}-1", time.time_ns()))

    def close(self):
        for host, _ in self.hosts:
            self.loop.call_soon_threadsafe(host.stop)
        for _, running in self.hosts:
            running.result(20)
        self.loop.call_soon_threadsafe(self.loop.stop)
        self.thread.join(10)


def _note(keys, sample):
    keys.append(sample.key)


def test_two_replayed_robots_become_one_map(router):
    parts = (
        (BY_NAME["scene_store"], StoreConfig(path=":memory:"), "*"),
        (SERVICE, Config(robots=("r1", "r2")), "home"),
    )
    robots = [houses.scene(rooms=houses.ROOMS[:4]), houses.scene("r2", MOVED, rooms=houses.ROOMS[1:])]
    with BusClient(ZenohBus(router, 5.0)) as early:
        for delta in houses.deltas(robots[0]):  # before the bridge is there: readers that come late get it, too
            early.publish(topic_of(type(delta)), delta)
        running = Running(router, *parts)
        try:
            for delta in houses.deltas(robots[1]):
                early.publish(topic_of(type(delta)), delta)

            def labels():
                try:
                    scene = early.ask(SCENE, SceneRequest(robot="home"), 2.0)
                except BusError:
                    return []
                return sorted(region.label for region in scene.regions)

            until(lambda: labels() == houses.LABELS, timeout_s=30)
            merged = early.ask(SCENE, SceneRequest(robot="home"))
            assert len(merged.objects) == len(houses.THINGS)
            assert early.ask(SCENE, SceneRequest(robot="r2")).place_ids.tolist() == robots[1].place_ids.tolist()
        finally:
            running.close()


def test_a_fleet_writes_its_own_name_and_reads_all():
    grants = grants_of("fleet", "home")
    deltas = {"psg/home/places", "psg/home/regions", "psg/home/objects"}
    assert {*grants.writes} == {*deltas, "psg/home/journal"}
    assert {f"psg/home/ask/{kind}" for kind in ("places", "regions", "objects")} <= {*grants.answers}
    assert not [key for key in (*grants.writes, *grants.answers, *grants.announces) if key.startswith("psg/*/")]
    assert {"psg/*/places", "psg/*/regions", "psg/*/objects"} <= {*grants.reads}
    assert "psg/*/ask/places" in grants.asks
    assert "psg/*/places" not in grants_of("robot", "r1").reads


def test_a_router_passes_a_fleet_nothing_but_its_own(tmp_path, monkeypatch):
    authority = Authority.create(tmp_path / "keys")
    for role, name in (("edge", "edge1"), ("fleet", "home"), ("robot", "r1")):
        authority.add(role, name)
    tls, local = free_endpoint("tls/127.0.0.1:0"), free_endpoint("tcp/127.0.0.1:0")
    close = open_router(local, beyond(authority.bundle("edge1"), listen=(tls,)))
    inside = ZenohBus(local, 5.0)
    monkeypatch.setenv(VARIABLE, str(authority.bundle("home")))
    outside = ZenohBus(tls, 5.0)
    try:
        heard, told = [], []
        inside.subscribe(
            PLACE_DELTA, PLACE_DELTA.pattern("*"), lambda sample: heard.append(sample.key), lambda *_: None
        )
        outside.subscribe(
            PLACE_DELTA, PLACE_DELTA.pattern("*"), lambda sample: told.append(sample.key), lambda *_: None
        )
        (delta, *_) = houses.deltas(houses.scene())
        inside.put(PLACE_DELTA, "psg/r1/places", encode(delta), pack_header("robot", 0, 1))
        until(lambda: "psg/r1/places" in told)
        for key in ("psg/r1/places", "psg/home/places"):
            outside.put(PLACE_DELTA, key, encode(delta), pack_header("fleet", 0, 1))
        until(lambda: "psg/home/places" in heard)
        assert heard.count("psg/r1/places") == 1  # the robot's own
    finally:
        for end in (outside.close, inside.close, close):
            end()

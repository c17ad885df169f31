"""Who gets in and may do what, by real Zenoh over TLS on loopback: an edge's router, and a robot's joined to it."""

import json
import threading
import time

import msgspec
import pytest
import zenoh

from prior_sg.deploy.keys.access import grants_of
from prior_sg.deploy.keys.authority import Authority, KeysError
from prior_sg.schemas.codec import encode
from prior_sg.schemas.priors import Task
from prior_sg.schemas.topics import (
    ENCODE,
    JOURNAL,
    PLACE_DELTA,
    PRIOR,
    QUERIES,
    SCENE,
    STATUS,
    TASK,
    TOPICS,
    alive_key,
    job_key,
    status_key,
    worker_keys,
)
from prior_sg.services.runtime import zenoh_session
from prior_sg.services.runtime.bus import BusError, pack_header
from prior_sg.services.runtime.endpoints import free_endpoint
from prior_sg.services.runtime.keys import VARIABLE, read_bundle
from prior_sg.services.runtime.zenoh_bus import ZenohBus
from prior_sg.services.runtime.zenoh_router import open_router
from prior_sg.services.runtime.zenoh_session import client_config
from tests.help.fleet import Fleet, beyond, until, without_certificate


@pytest.fixture(scope="module")
def fleet(tmp_path_factory):
    made = Fleet(tmp_path_factory.mktemp("fleet"))
    yield made
    made.close()


def task(robot, text):
    return Task(robot=robot, stamp_ns=1, environment="e", task=text)


def give(bus, topic, key, text):
    bus.put(topic, key, encode(task("robotA", text)), pack_header(f"test/{text}/1", 0, time.time_ns()))


class Heard:
    def __init__(self, bus, *topics):
        self.keys = []
        for topic in topics:
            bus.subscribe(topic, topic.pattern("*"), lambda sample: self.keys.append(sample.key), lambda *_: None)


def said(samples):
    """What was given, by its text: others of the fleet have said things on the same keys before."""
    return {sample.writer.split("/")[1] for sample in samples}


def answered(bus, key, timeout_s=1.0):
    got, done = [], threading.Event()
    bus.call(key, encode(task("robotA", "x")), timeout_s, lambda answer: (got.append(answer), done.set()))
    assert done.wait(timeout_s + 2)
    return got[0].payload


@pytest.fixture
def impatient(monkeypatch):
    monkeypatch.setattr(zenoh_session, "CONNECT_MS", 400)


def test_strangers_are_not_let_in(fleet, monkeypatch, impatient):
    for end in (without_certificate(fleet), zenoh.Config.from_json5(json.dumps(
        {"mode": "client", "connect": {"endpoints": [fleet.tls.replace("tls/", "tcp/")], "timeout_ms": 500}}
    ))):  # fmt: skip
        with pytest.raises(zenoh.ZError):
            zenoh.open(end).close()
    time.sleep(1.1)  # certificates count in seconds
    for folder in (fleet.foreign.bundle("robotA"), fleet.own.bundle("late")):
        with pytest.raises(BusError, match="takes not the keys"):
            fleet.bus(folder, monkeypatch)
    monkeypatch.delenv(VARIABLE)
    with pytest.raises(BusError, match="keys only"):
        ZenohBus(fleet.tls, 0.1)


def test_a_robot_that_poses_as_an_edge_is_not_joined(fleet, monkeypatch, impatient):
    posing = free_endpoint("tls/127.0.0.1:0")
    bundle = read_bundle(fleet.own.bundle("robotB"))
    with pytest.raises(BusError, match="no key of an edge"):
        open_router(free_endpoint("tcp/127.0.0.1:0"), beyond(bundle.folder, listen=(posing,)))
    settings = {"mode": "router", "listen": {"endpoints": [posing]}, "transport": {"link": {"tls": bundle.transport()}},
                "scouting": {"multicast": {"enabled": False}}}  # fmt: skip
    with zenoh.open(zenoh.Config.from_json5(json.dumps(settings))):
        monkeypatch.setenv(VARIABLE, str(fleet.own.bundle("robotA")))
        with pytest.raises(BusError, match="takes not the keys"):
            ZenohBus(posing, 0.1)


def test_everybody_writes_what_is_theirs_and_nothing_else(fleet, monkeypatch):
    heard = Heard(fleet.at(fleet.local), TASK, PLACE_DELTA, PRIOR)
    ends = {
        name: fleet.bus(fleet.own.bundle(name), monkeypatch) for name in ("robotA", "robotB", "anna", "stolen", "otto")
    }
    ends["old B"] = fleet.bus(fleet.old, monkeypatch)
    digest = "0" * 32
    refused = [
        ("robotB", TASK, "psg/robotA/task"),
        ("robotB", TASK, "psg/*/task"),
        ("robotB", PLACE_DELTA, "psg/robotA/places"),
        ("robotB", PRIOR, f"psg/fleet/prior/{digest}"),
        ("anna", TASK, "psg/robotA/task"),
        ("anna", PLACE_DELTA, "psg/anna/places"),
        ("stolen", PLACE_DELTA, "psg/stolen/places"),
        ("old B", PLACE_DELTA, "psg/robotB/places"),
        ("otto", PLACE_DELTA, "psg/robotA/places"),
    ]
    for name, topic, key in refused:
        give(ends[name], topic, key, name.replace(" ", ""))
    give(ends["robotA"], PLACE_DELTA, "psg/robotA/places", "own")
    give(ends["robotB"], PLACE_DELTA, "psg/robotB/places", "own")
    give(ends["otto"], TASK, "psg/robotB/task", "order")
    give(fleet.at(fleet.robot), TASK, "psg/robotA/task", "console")
    allowed = ["psg/robotA/places", "psg/robotA/task", "psg/robotB/places", "psg/robotB/task"]
    until(lambda: len(heard.keys) >= len(allowed))
    time.sleep(0.5)
    assert sorted(heard.keys) == allowed


def test_everybody_reads_what_concerns_them_also_what_was_said_before(fleet, monkeypatch):
    writer = fleet.at(fleet.robot)
    give(writer, PLACE_DELTA, "psg/robotA/places", "early")
    time.sleep(0.3)
    names = ("anna", "robotA", "robotB", "stolen")
    heard = {name: [] for name in names}
    for name in names:
        bus = fleet.bus(fleet.own.bundle(name), monkeypatch)
        bus.subscribe(PLACE_DELTA, PLACE_DELTA.pattern("robotA"), heard[name].append, lambda *_: None)
    until(lambda: "early" in said(heard["anna"]) & said(heard["robotA"]))
    wide = []
    with zenoh.open(client_config(fleet.tls, read_bundle(fleet.own.bundle("robotB")))) as session:
        session.declare_subscriber("**", wide.append)
        time.sleep(0.3)
        give(writer, PLACE_DELTA, "psg/robotA/places", "later")
        until(lambda: "later" in said(heard["anna"]))
        time.sleep(0.3)
    assert heard["robotB"] == heard["stolen"] == wide == []


def test_questions_and_jobs_cross_and_nobody_answers_for_others(fleet, monkeypatch):
    edge = fleet.at(fleet.local)
    served, keys = [], (SCENE.key.format(robot="*"), job_key(ENCODE, "w", "*"))
    for key in keys:
        edge.serve(key, lambda request: (served.append(request.key), request.reply(b"edge")))
    edge.announce(worker_keys(ENCODE, "w", "space/x")[1])
    robot, alive = fleet.at(fleet.robot), []
    robot.watch(worker_keys(ENCODE, "*", "**")[1], lambda key, up: alive.append(key))
    archive = "psg/robotA/ask/keyframes"
    robot.serve(archive, lambda request: request.reply(b"robot"))
    thief = fleet.bus(fleet.own.bundle("robotB"), monkeypatch)
    for key in (archive, "psg/robotA/ask/voxels", keys[0], keys[1]):
        thief.serve(key, lambda request: request.reply(b"thief"))
    until(lambda: alive and answered(edge, archive) == b"robot")
    assert answered(robot, "psg/robotA/ask/scene") == b"edge"
    assert answered(robot, job_key(ENCODE, "w", "robotA")) == b"edge"
    viewer = fleet.bus(fleet.own.bundle("anna"), monkeypatch)
    assert answered(viewer, "psg/robotA/ask/scene") == b"edge"
    served.clear()
    asker = fleet.bus(fleet.own.bundle("robotB"), monkeypatch)
    for bus, key in [
        (asker, job_key(ENCODE, "w", "robotA")),
        (viewer, job_key(ENCODE, "w", "robotA")),
        (asker, "psg/robotA/ask/scene"),
        (edge, "psg/robotA/ask/voxels"),
    ]:
        assert answered(bus, key) is None
    assert served == []


def included(key, keys):
    return any(zenoh.KeyExpr(one).includes(zenoh.KeyExpr(key)) for one in keys)


def test_every_key_of_the_table_is_granted_to_whom_it_concerns():
    """What a topic or question that is added later must not be without."""
    robot, edge, viewer = grants_of("robot", "r"), grants_of("edge", "e"), grants_of("viewer", "v")
    for topic in TOPICS:
        key = topic.pattern("r").replace("*", "x")
        if topic.delivery == "job":
            assert included(job_key(topic, "w", "r"), robot.asks) and included(job_key(topic, "w", "*"), edge.answers)
            assert included(job_key(topic, "w", "*"), edge.asks), "what robots ask passes on to workers of other hosts"
            assert included(worker_keys(topic, "w", "a/b")[1], robot.reads) and not included(key, viewer.asks)
            continue
        assert included(key, (*robot.writes, *edge.writes)), topic.name
        assert included(topic.pattern("r"), robot.reads) and included(topic.pattern("*"), edge.reads), topic.name
        assert included(topic.pattern("*"), viewer.reads), topic.name
        assert not included(topic.pattern("other").replace("*", "x"), robot.writes), topic.name
    for query in QUERIES:
        key = query.key.replace("{robot}", "r").replace("{space}", "a/b")
        assert included(key, (*robot.answers, *edge.answers)), query.name
        assert all(included(key, grants.asks) for grants in (robot, edge, viewer)), query.name
    for key in (alive_key("segmenter", "x"), status_key("segmenter", "x")):
        assert included(key, (*robot.announces, *robot.answers)) and included(key, (*edge.announces, *edge.answers))
    assert included(alive_key("*", "*"), viewer.reads) and included(f"{STATUS.key}/segmenter/x", viewer.asks)
    assert viewer.writes == viewer.answers == viewer.announces == ()
    assert included(JOURNAL.pattern("fleet"), edge.writes)


def test_bundles_are_for_their_owner_and_names_are_names(tmp_path):
    authority = Authority.create(tmp_path / "keys")
    authority.add("robot", "r")
    modes = {path.name: path.stat().st_mode & 0o777 for path in (tmp_path / "keys").rglob("*") if path.is_file()}
    assert set(modes.values()) == {0o600}
    for name in ("..", ".r", "a/b", "*", "", "x" * 49, "fleet"):
        with pytest.raises(KeysError):
            authority.add("robot", name)
    with pytest.raises(KeysError, match="already"):
        authority.add("viewer", "r")
    authority.revoke("r")
    with pytest.raises(KeysError, match="does not take part"):
        authority.rotate("r")
    again = Authority(tmp_path / "keys").add("viewer", "r")
    assert again.issue == 2 and again == read_bundle(authority.bundle("r")).own
    (authority.bundle("r") / "key.pem").chmod(0o644)
    with pytest.raises(BusError, match="chmod 600"):
        read_bundle(authority.bundle("r"))
    with pytest.raises(BusError, match="no bundle"):
        read_bundle(tmp_path)
    assert msgspec.json.decode((authority.folder / "participants.json").read_bytes())[0]["role"] == "viewer"


def test_who_may_have_a_process_yield_runs_the_same_and_nobody_beyond_a_host_has_one_exchanged():
    asks = {role: grants_of(role, "robotA").asks for role in ("robot", "edge", "operator", "viewer")}
    yields = {role: {key for key in keys if "/yield/" in key} for role, keys in asks.items()}
    assert yields["robot"] == {f"psg/robotA/yield/{name}/*" for name in ("ingest", "place_graph", "segmenter")}
    assert "psg/*/yield/segmenter/*" in yields["edge"] and "psg/fleet/yield/scene_store/*" in yields["edge"]
    assert not yields["operator"] and not yields["viewer"]
    assert not [key for keys in asks.values() for key in keys if "/swap" in key]

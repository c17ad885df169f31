"""The same behaviour on the local bus and over a real Zenoh router."""

import threading
import time

import msgspec
import pytest
import zenoh

from prior_sg.schemas.codec import DecodeError, decode, encode
from prior_sg.schemas.frames import IngestState
from prior_sg.schemas.migrations import MIGRATIONS
from prior_sg.schemas.places import SnapshotRequest
from prior_sg.schemas.priors import Task
from prior_sg.schemas.topics import INGEST_STATE, KEYFRAME, PLACE_SNAPSHOT, TASK
from prior_sg.services.runtime import zenoh_router
from prior_sg.services.runtime.bus import Answer, BusError, Hub, LocalBus, key_matches, pack_header, unpack_header
from prior_sg.services.runtime.host.inbox import Inbox
from prior_sg.services.runtime.host.replays import Replays
from prior_sg.services.runtime.zenoh_bus import ZenohBus
from prior_sg.services.runtime.zenoh_session import client_config
from tests.help import reading
from tests.help.examples import KEYFRAME as FRAME


@pytest.fixture(params=["local", "zenoh"])
def new_bus(request):
    buses = []
    hub = Hub()
    address = request.getfixturevalue("endpoint") if request.param == "zenoh" else ""

    def new():
        buses.append(ZenohBus(address) if address else LocalBus(hub))
        return buses[-1]

    yield new
    for bus in buses:
        bus.close()


def eventually(condition, timeout_s=20.0):
    end_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end_s, "did not happen"
        time.sleep(0.01)


def put(bus, topic, message, writer, sequence):
    bus.put(topic, topic.key_of(message), encode(message), pack_header(writer, sequence, 123))


def task(robot, text):
    return Task(robot=robot, stamp_ns=1, environment="e", task=text)


def find_each_other(writer, robot, got):
    """Put until the reader has heard: of what is put before that, only the cache is left."""
    probe = 0
    while not got:
        put(writer, TASK, task(robot, "probe"), "probe", probe)
        time.sleep(0.05)
        probe += 1
        assert probe < 400, "nobody hears"
    eventually(lambda: got[-1].sequence == probe - 1)
    got.clear()


def test_samples_arrive_in_order_with_their_writer(new_bus):
    reader, writer, got = new_bus(), new_bus(), []
    reader.subscribe(TASK, TASK.pattern("order"), got.append, lambda topic, number: None)
    find_each_other(writer, "order", got)
    for index in range(50):
        put(writer, TASK, task("order", str(index)), "w", index)
    eventually(lambda: len(got) == 50)
    assert [(s.writer, s.sequence, s.sent_ns) for s in got] == [("w", i, 123) for i in range(50)]
    assert got[0].key == "psg/order/task"


def test_a_late_reader_of_every_gets_the_cache(new_bus):
    writer, got = new_bus(), []
    for index in range(10):
        put(writer, TASK, task("late", str(index)), "w", index)
    time.sleep(0.3)
    new_bus().subscribe(TASK, TASK.pattern("late"), got.append, lambda topic, number: None)
    eventually(lambda: len(got) >= TASK.cache)
    assert [s.sequence for s in got] == list(range(10 - TASK.cache, 10))


def test_a_late_reader_of_latest_gets_nothing_old(new_bus):
    writer, got = new_bus(), []
    state = IngestState(
        robot="old", stamp_ns=0, frames_read=0, frames_total=0, keyframes=0, encoded=0, rejected=0, finished=False
    )
    put(writer, INGEST_STATE, state, "w", 0)
    time.sleep(0.2)
    new_bus().subscribe(INGEST_STATE, INGEST_STATE.pattern("old"), got.append, lambda topic, number: None)
    eventually(lambda: got or put(writer, INGEST_STATE, state, "w", 1))
    assert {s.sequence for s in got} == {1}


def test_robots_do_not_see_each_other(new_bus):
    reader, writer, mine, all_of_them = new_bus(), new_bus(), [], []
    reader.subscribe(TASK, TASK.pattern("mine"), mine.append, lambda topic, number: None)
    reader.subscribe(TASK, TASK.pattern("*"), all_of_them.append, lambda topic, number: None)
    put(writer, TASK, task("mine", "a"), "w", 0)
    put(writer, TASK, task("yours", "b"), "w", 0)
    eventually(lambda: {s.key for s in all_of_them} >= {"psg/mine/task", "psg/yours/task"})
    assert {s.key for s in mine} == {"psg/mine/task"}


def test_a_subscription_ends(new_bus):
    reader, writer, ended, all_of_them = new_bus(), new_bus(), [], []
    end = reader.subscribe(TASK, TASK.pattern("end"), ended.append, lambda topic, number: None)
    reader.subscribe(TASK, TASK.pattern("end"), all_of_them.append, lambda topic, number: None)
    find_each_other(writer, "end", ended)
    end()
    all_of_them.clear()
    put(writer, TASK, task("end", "last"), "w", 0)
    eventually(lambda: [s.writer for s in all_of_them][-1:] == ["w"])
    assert not ended


def call(bus, key, payload, timeout_s=20.0):
    answers, arrived = [], threading.Event()

    def receive(answer):
        answers.append(answer)
        arrived.set()

    bus.call(key, payload, timeout_s, receive)
    assert arrived.wait(timeout_s + 3)
    time.sleep(0.05)
    assert len(answers) == 1
    return answers[0]


def test_calls_are_answered_refused_or_nobody(new_bus):
    server, caller = new_bus(), new_bus()
    server.serve("psg/test/echo/*", lambda request: request.reply(request.payload[::-1]))
    server.serve("psg/test/no", lambda request: request.refuse("busy"))
    eventually(lambda: call(caller, "psg/test/no", b"") == Answer(None, "busy"))
    assert call(caller, "psg/test/echo/x", b"abc") == Answer(b"cba")
    assert call(caller, "psg/test/no", b"") == Answer(None, "busy")
    assert call(caller, "psg/test/nobody", b"") == Answer(None, "nobody")


def test_a_call_may_be_answered_later_from_another_thread(new_bus):
    server, caller = new_bus(), new_bus()
    server.serve("psg/test/later", lambda request: threading.Timer(0.2, request.reply, [b"done"]).start())
    eventually(lambda: call(caller, "psg/test/later", b"") == Answer(b"done"))


def test_a_server_that_dies_does_not_leave_the_caller_waiting(endpoint):
    server, caller = ZenohBus(endpoint), ZenohBus(endpoint)
    held = []
    server.serve("psg/test/dies", held.append)
    time.sleep(0.2)
    threading.Timer(0.3, server.close).start()
    answer = call(caller, "psg/test/dies", b"")
    assert answer == Answer(None, "nobody")  # not the time-out
    caller.close()


def test_who_is_alive(new_bus):
    watcher, other, seen = new_bus(), new_bus(), []
    other.announce("psg/alive/svc/one")
    watcher.watch("psg/alive/*/*", lambda key, alive: seen.append((key, alive)))
    eventually(lambda: ("psg/alive/svc/one", True) in seen)
    other.close()
    eventually(lambda: ("psg/alive/svc/one", False) in seen)


def test_no_router_is_one_clear_sentence():
    with pytest.raises(BusError, match=r"no router answers on tcp/127.0.0.1:1; start one with"):
        ZenohBus("tcp/127.0.0.1:1", wait_s=0.1)


@pytest.mark.parametrize(
    "pattern, key, matches",
    [
        ("a/*/c", "a/b/c", True),
        ("a/*/c", "a/b/d", False),
        ("a/*", "a/b/c", False),
        ("a/**", "a/b/c", True),
        ("a/b", "a/b", True),
    ],
)
def test_key_patterns(pattern, key, matches):
    assert key_matches(pattern, key) is matches


@pytest.mark.parametrize("header", [None, b"", b"short", pack_header("", 1, 2), b"\xff" * 40])
def test_damaged_headers_mean_an_unknown_writer(header):
    assert unpack_header(header)[0] == ""


def test_header_round_trip():
    assert unpack_header(pack_header("segmenter/1/2", 5, 6)) == ("segmenter/1/2", 5, 6, "")
    assert KEYFRAME.pattern("*") == "psg/*/keyframe"


@pytest.fixture
def foreign(endpoint):
    """A program of another version: a bare session, which names the schema of what it sends."""
    with zenoh.open(client_config(endpoint)) as session:
        yield session


def encoding(schema):
    return zenoh.Encoding("application/msgpack").with_schema(schema)


def put_until_heard(session, key, payload, schema, got):
    end_s = time.monotonic() + 20
    while not got:
        assert time.monotonic() < end_s, "nobody hears"
        session.put(key, payload, encoding=encoding(schema))
        time.sleep(0.05)
    return got[0].payload


def test_a_sample_of_an_older_version_arrives_as_ours(endpoint, foreign, monkeypatch):
    for step, function in reading.MIGRATIONS.items():
        monkeypatch.setitem(MIGRATIONS, step, function)
    bus, got = ZenohBus(endpoint), []
    bus.subscribe(reading.READING, "psg/r/reading", got.append, lambda topic, number: None)
    payload = put_until_heard(foreign, "psg/r/reading", encode(reading.FIRST), "Reading/1", got)
    assert decode(reading.Reading, payload) == reading.THIRD
    bus.close()


@pytest.mark.parametrize(
    ("schema", "why"),
    [("Task/2", "newer than this program's Task/1; update it"), ("Keyframe/1", "where a Task/1 belongs")],
)
def test_a_sample_of_a_newer_version_or_another_message_is_refused(endpoint, foreign, schema, why):
    bus, got = ZenohBus(endpoint), []
    bus.subscribe(TASK, TASK.pattern("newer"), got.append, lambda topic, number: None)
    payload = put_until_heard(foreign, TASK.pattern("newer"), encode(task("newer", "t")), schema, got)
    with pytest.raises(DecodeError, match=why):
        decode(TASK.type, payload)
    bus.close()


def told(answers):
    return [answer for answer in answers if answer.payload is not None]


def test_questions_and_answers_name_their_schema_and_are_refused_like_samples(endpoint, foreign):
    bus, key, asked, answers = ZenohBus(endpoint), "psg/versions/ask/places", [], []
    payload = encode(SnapshotRequest(robot="versions"))

    def serve(request):
        asked.append(request.payload)
        request.reply(b"an answer")

    bus.serve(key, serve)
    eventually(lambda: list(foreign.get(key, payload=payload, encoding=encoding("SnapshotRequest/1"))))
    assert asked[-1] == payload
    (reply,) = foreign.get(key, payload=payload, encoding=encoding("SnapshotRequest/2"))
    assert str(reply.ok.encoding) == "application/msgpack;PlaceDelta/1"
    with pytest.raises(DecodeError, match="SnapshotRequest/2 is newer"):
        decode(SnapshotRequest, asked[-1])

    encodings = []

    def answer_newer(query):
        with query:
            encodings.append(str(query.encoding))
            query.reply(key, b"an answer", encoding=encoding("PlaceDelta/2"))

    bus.close()
    bus = ZenohBus(endpoint)
    with foreign.declare_queryable(key, answer_newer):
        eventually(
            lambda: bus.call(key, payload, 5.0, answers.append) or any(one.payload is not None for one in answers)
        )
    assert set(encodings) == {"application/msgpack;SnapshotRequest/1"}
    answer = told(answers)[0]
    with pytest.raises(DecodeError, match="PlaceDelta/2 is newer than this program's PlaceDelta/1"):
        decode(PLACE_SNAPSHOT.reply, answer.payload)
    bus.close()


def test_what_a_link_loses_comes_later_and_still_in_its_order(monkeypatch):
    settings = zenoh_router.router_settings

    def loses(endpoint, beyond=None):
        rules = [{"key_expr": KEYFRAME.pattern("*"), "freq": 10}]
        return settings(endpoint, beyond) | {
            "downsampling": [{"flows": ["ingress"], "messages": ["put"], "rules": rules}]
        }

    monkeypatch.setattr(zenoh_router, "router_settings", loses)
    endpoint, stop = zenoh_router.open_free_router("tcp/127.0.0.1:0")
    reader, writer, got, live = ZenohBus(endpoint), ZenohBus(endpoint), [], []
    inbox, replays = Inbox(wake=lambda: None), Replays()
    try:
        reader.subscribe(KEYFRAME, KEYFRAME.pattern("loses"), got.append, lambda topic, number: None)
        beside = reader._session.declare_subscriber(KEYFRAME.pattern("loses"), live.append)
        time.sleep(0.3)
        frames = [msgspec.structs.replace(FRAME, robot="loses", frame_id=number) for number in range(20)]
        for number, frame in enumerate(frames):
            put(writer, KEYFRAME, frame, "w", number)
            time.sleep(0.02)
        eventually(lambda: len(got) == 20)
        beside.undeclare()
        assert 0 < len(live) < 20  # most were taken off the link
        for sample, frame in zip(got, frames, strict=True):
            inbox.offer(sample)
            assert replays.fault_of(inbox.take(), frame) == ""
        counts = inbox.of(KEYFRAME.name)
        assert (counts.received, counts.duplicate, counts.missed) == (20, 0, 0)
    finally:
        for bus in (reader, writer):
            bus.close()
        stop()


def test_no_sample_carries_a_clock_that_others_could_refuse(endpoint):
    """Zenoh takes a stamp more than half a second ahead for an error, and says so at every hop."""
    writer, stamps = ZenohBus(endpoint), []
    session = zenoh.open(client_config(endpoint))
    try:
        session.declare_subscriber("psg/clock/**", lambda sample: stamps.append(sample.timestamp))
        state = IngestState(
            robot="clock", stamp_ns=1, frames_read=1, frames_total=2, keyframes=1, encoded=0, rejected=0, finished=False
        )

        def both_came() -> bool:
            put(writer, TASK, task("clock", "t"), "w", 0)
            put(writer, INGEST_STATE, state, "w", 0)
            return len(stamps) >= 4

        eventually(both_came)
        assert set(stamps) == {None}
    finally:
        writer.close()
        session.close()

"""A service on a bus: order, back-pressure, counting of bad input, questions, jobs; the same over Zenoh and locally."""

import asyncio
import contextlib
import time

import msgspec
import numpy as np
import pytest
import zenoh

from prior_sg.schemas.codec import Message, decode, encode
from prior_sg.schemas.frames import Intrinsics, Keyframe
from prior_sg.schemas.places import MapRequest, SnapshotRequest, VoxelMap
from prior_sg.schemas.priors import Task, TaskInForce
from prior_sg.schemas.status import Consumed, JobDone, ServiceStatus, Started, Tick
from prior_sg.schemas.topics import (
    ENCODE,
    JOURNAL,
    KEYFRAME,
    PLACE_SNAPSHOT,
    TASK,
    TASK_IN_FORCE,
    VOXEL_MAP,
    alive_key,
    job_key,
    status_key,
    worker_keys,
)
from prior_sg.services.refusals import InputRefused, fault_of_stamp
from prior_sg.services.runtime import heap
from prior_sg.services.runtime.bus import BusError, Hub, LocalBus, pack_header
from prior_sg.services.runtime.client import BusClient
from prior_sg.services.runtime.host.host import Host
from prior_sg.services.runtime.jobs.pool import JobPool
from prior_sg.services.runtime.service import Ask, Identity, Pause, Service, UndeclaredError
from prior_sg.services.runtime.zenoh_bus import ZenohBus
from prior_sg.services.runtime.zenoh_session import client_config

CAMERA = Intrinsics(4, 3, 5.0, 5.0, 2.0, 1.5)


class Config(msgspec.Struct, frozen=True):
    frames: int = 12
    work_s: float = 0.0


class Frame(Message, kw_only=True):
    frame_id: int


def keyframe(frame_id):
    return Keyframe(
        robot="r",
        frame_id=frame_id,
        stamp_ns=frame_id,
        intrinsics=CAMERA,
        world_from_camera=np.eye(4),
        color=b"",
        depth=b"",
        depth_scale_m=0.001,
    )


def source_step(state, message, cfg):
    match message:
        case Frame():
            state["lead"].append(message.frame_id)
            yield KEYFRAME, keyframe(message.frame_id)
            yield ENCODE, keyframe(message.frame_id)
        case JobDone():
            state["done"].append((message.frame_id, message.worker, message.attempts))


async def source_drive(port, cfg):
    for frame_id in range(cfg.frames):
        await port.room(2)
        await port.consume(Frame(frame_id=frame_id))


def reader_step(state, message, cfg):
    if isinstance(message, Keyframe):
        time.sleep(cfg.work_s)
        state.append(message.frame_id)
    yield from ()


SOURCE = Service(
    "source", "", "robot", Config, lambda cfg, me: {"lead": [], "done": []}, source_step,
    writes=(KEYFRAME, ENCODE), drive=source_drive,
)  # fmt: skip
READER = Service("reader", "", "robot", Config, lambda cfg, me: [], reader_step, reads=(KEYFRAME,))
WORKER = Service("worker", "", "fleet", Config, lambda cfg, me: [], reader_step, job=ENCODE)


@pytest.fixture(params=["local", "zenoh"])
def new_bus(request):
    if request.param == "local":
        hub = Hub()
        return lambda: LocalBus(hub)
    address = request.getfixturevalue("endpoint")
    return lambda: ZenohBus(address)


@contextlib.asynccontextmanager
async def running(new_bus, *services):
    """Hosts of (service, config, instance), started in order and stopped at the end."""
    hosts, tasks = [], []
    for service, cfg, instance in services:
        bus = await asyncio.to_thread(new_bus)
        robot = "r" if service.scope == "robot" else "*"
        hosts.append(Host(service, bus, cfg, Identity(robot, instance, time.time_ns())))
        tasks.append(asyncio.create_task(hosts[-1].run()))
        await asyncio.sleep(0.3)
    try:
        yield hosts
    finally:
        for host in hosts:
            host.stop()
        await asyncio.gather(*tasks)


async def until(condition, timeout_s=15.0):
    end_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end_s, "did not happen"
        await asyncio.sleep(0.01)


def test_a_slow_reader_holds_the_source_back_and_loses_nothing(new_bus):
    async def main():
        services = [(READER, Config(work_s=0.02), "a"), (WORKER, Config(), "w"), (SOURCE, Config(frames=12), "s")]
        async with running(new_bus, *services) as (reader, worker, source):
            while len(source._state["lead"]) < 12:
                assert len(source._state["lead"]) <= len(reader._state) + 3
                await asyncio.sleep(0.001)
            await until(lambda: len(source._state["done"]) == 12 and len(reader._state) == 12)
            assert reader._state == list(range(12))
            assert sorted(worker._state) == list(range(12))

    asyncio.run(main())


def test_jobs_are_shared_by_workers_and_survive_one(new_bus):
    async def main():
        services = [
            (READER, Config(), "a"),
            (WORKER, Config(work_s=0.05), "w1"),
            (WORKER, Config(work_s=0.05), "w2"),
            (SOURCE, Config(frames=16), "s"),
        ]
        async with running(new_bus, *services) as (_, first, second, source):
            await until(lambda: len(source._state["done"]) >= 4)
            first.stop()
            await until(lambda: len(source._state["done"]) == 16)
            assert sorted(frame_id for frame_id, _, _ in source._state["done"]) == list(range(16))
            assert len(second._state) >= 8
            assert set(first._state) | set(second._state) == set(range(16))

    asyncio.run(main())


def test_a_source_waits_for_its_first_reader_and_worker(new_bus):
    async def main():
        async with running(new_bus, (SOURCE, Config(frames=3), "s")) as (source,):
            await asyncio.sleep(0.5)
            assert source._state["lead"] == []
            async with running(new_bus, (READER, Config(), "a"), (WORKER, Config(), "w")) as (reader, _):
                await until(lambda: len(source._state["done"]) == 3)
                await until(lambda: reader._state == [0, 1, 2])

    asyncio.run(main())


def test_what_a_start_has_freed_is_given_back_before_the_first_input(monkeypatch):
    happened = []
    monkeypatch.setattr(heap, "give_back", lambda: happened.append("given back"))
    hub = Hub()

    def init(cfg, me):
        happened.append("built")
        return []

    async def main():
        service = Service("reader", "", "robot", Config, init, reader_step, reads=(KEYFRAME,))
        async with running(lambda: LocalBus(hub), (service, Config(), "a")):
            assert happened == ["built", "given back"]

    asyncio.run(main())


def test_bad_input_is_counted_and_stops_nothing(new_bus):
    async def main():
        async with running(new_bus, (READER, Config(), "a")) as (reader,):
            bus = await asyncio.to_thread(new_bus)
            good = encode(keyframe(1))
            for payload, header in [
                (b"\x00\xff", b"?"),
                (good[:-5], pack_header("w", 0, 0)),
                (good, pack_header("w", 1, 0)),
            ]:
                bus.put(KEYFRAME, KEYFRAME.key_of(keyframe(1)), payload, header)
            bus.put(KEYFRAME, KEYFRAME.key_of(keyframe(1)), good, pack_header("w", 1, 0))
            await until(lambda: reader._state == [1] and reader.inbox.of("KEYFRAME").duplicate == 1)
            counts = {count.topic: count for count in reader.status().topics}["KEYFRAME"]
            assert (counts.malformed, counts.consumed, counts.duplicate) == (2, 1, 1)
            await asyncio.to_thread(bus.close)

    asyncio.run(main())


def refusing_step(state, message, cfg):
    if message.frame_id < 3:
        raise InputRefused(f"frame {message.frame_id} cannot be")
    if message.frame_id == 9:
        raise ValueError("a fault of the program")
    state.append(message.frame_id)
    yield from ()


REFUSING = Service("reader", "", "robot", Config, lambda cfg, me: [], refusing_step, reads=(KEYFRAME,))


def test_a_refused_input_is_counted_logged_and_stops_nothing_but_a_fault_does(new_bus, caplog):
    async def main():
        with pytest.raises(ValueError, match="a fault of the program"):
            async with running(new_bus, (REFUSING, Config(), "a")) as (reader,):
                bus = await asyncio.to_thread(new_bus)
                for frame_id in (1, 2, 3, 4):
                    header = pack_header("w", frame_id, 0)
                    bus.put(KEYFRAME, KEYFRAME.key_of(keyframe(1)), encode(keyframe(frame_id)), header)
                await until(lambda: reader._state == [3, 4])
                counts = {count.topic: count for count in reader.status().topics}["KEYFRAME"]
                assert (counts.malformed, counts.consumed) == (2, 4)
                bus.put(KEYFRAME, KEYFRAME.key_of(keyframe(1)), encode(keyframe(9)), pack_header("w", 5, 0))
                await asyncio.sleep(0.3)
                await asyncio.to_thread(bus.close)

    with caplog.at_level("WARNING"):
        asyncio.run(main())
    told = [record.why for record in caplog.records if record.getMessage() == "message refused"]
    assert told == ["frame 1 cannot be", "frame 2 cannot be"]


def test_the_journal_tells_what_was_consumed_and_in_which_order(new_bus):
    async def main():
        entries = []
        journal = await asyncio.to_thread(new_bus)
        journal.subscribe(
            JOURNAL, JOURNAL.pattern("r"), lambda s: entries.append(decode(Consumed, s.payload)), lambda t, n: None
        )
        async with running(new_bus, (READER, Config(), "j1")):
            bus = await asyncio.to_thread(new_bus)
            for frame_id in range(3):
                bus.put(
                    KEYFRAME, KEYFRAME.key_of(keyframe(0)), encode(keyframe(frame_id)), pack_header("me", frame_id, 0)
                )
            anonymous = encode(keyframe(9))
            bus.put(KEYFRAME, KEYFRAME.key_of(keyframe(0)), anonymous, b"")
            await until(lambda: len([e for e in entries if e.instance == "j1"]) >= 5)
            await asyncio.to_thread(bus.close)
        await until(lambda: any(e.instance == "j1" and e.topic == "STOP" for e in entries))
        mine = [e for e in entries if e.instance == "j1"]
        assert [e.order for e in mine] == list(range(6))
        assert [e.topic for e in mine] == ["START", *["KEYFRAME"] * 4, "STOP"]
        assert [(e.writer, e.sequence) for e in mine[1:4]] == [("me", 0), ("me", 1), ("me", 2)]
        assert mine[4].writer == "" and mine[4].inline == anonymous
        await asyncio.to_thread(journal.close)

    asyncio.run(main())


def asking_step(state, message, cfg):
    match message:
        case Tick() if not state:
            yield Ask(VOXEL_MAP, MapRequest(robot="r"))
        case VoxelMap():
            state.append(message.voxel_m)


def answer(state, request, cfg):
    return VoxelMap(robot="r", voxel_m=0.25, free=np.zeros((0, 3), np.int16), occupied=np.zeros((0, 3), np.int16))


ASKER = Service("asker", "", "robot", Config, lambda cfg, me: [], asking_step, asks=(VOXEL_MAP,), tick_s=0.05)
ANSWERER = Service("answerer", "", "robot", Config, lambda cfg, me: [], reader_step, answers={VOXEL_MAP: answer})


def test_a_question_is_repeated_until_somebody_can_answer(new_bus):
    async def main():
        async with running(new_bus, (ASKER, Config(), "a")) as (asker,):
            await asyncio.sleep(0.3)
            assert asker.status().waiting_for == ["VOXEL_MAP"] and asker._state == []
            async with running(new_bus, (ANSWERER, Config(), "b")):
                await until(lambda: asker._state)
            assert set(asker._state) == {0.25}

    asyncio.run(main())


PARTS = 40


def sliced_step(state, message, cfg):
    for part in range(PARTS):
        time.sleep(0.01)
        state.append((message.frame_id, part))
        yield Pause()


def how_far(state, request, cfg):
    return VoxelMap(robot="r", voxel_m=float(len(state)), free=np.zeros((0, 3), np.int16), occupied=NO_VOXELS)


NO_VOXELS = np.zeros((0, 3), np.int16)
SLICED = Service(
    "sliced", "", "robot", Config, lambda cfg, me: [], sliced_step, reads=(KEYFRAME,), answers={VOXEL_MAP: how_far}
)  # fmt: skip


def test_questions_are_answered_where_a_step_pauses_and_inputs_wait_for_its_end(new_bus):
    async def main():
        async with running(new_bus, (SLICED, Config(), "a")) as (sliced,):
            bus = await asyncio.to_thread(new_bus)
            entries, answers = [], []
            bus.subscribe(JOURNAL, JOURNAL.pattern("r"), entries.append, lambda *_: None)
            for number in (1, 2):
                of_frame = keyframe(number)
                bus.put(KEYFRAME, KEYFRAME.key_of(of_frame), encode(of_frame), pack_header("w", number, 0))
            await until(lambda: len(sliced._state) > 2)
            bus.call(VOXEL_MAP.key_of(MapRequest(robot="r")), encode(MapRequest(robot="r")), 5.0, answers.append)
            await until(lambda: answers)
            assert 2 < decode(VoxelMap, answers[0].payload).voxel_m < PARTS
            assert not [e for e in entries if decode(Consumed, e.payload).topic == "KEYFRAME"]
            await until(lambda: len(sliced._state) == 2 * PARTS)
            assert sliced._state == [(number, part) for number in (1, 2) for part in range(PARTS)]
            bus.put(KEYFRAME, KEYFRAME.key_of(keyframe(3)), encode(keyframe(3)), pack_header("w", 3, 0))
            await until(lambda: len(sliced._state) > 2 * PARTS)
        await until(lambda: decode(Consumed, entries[-1].payload).topic == "STOP")
        assert len(sliced._state) == 3 * PARTS  # who is stopped finishes what it has begun
        assert [decode(Consumed, e.payload).frame_id for e in entries[-4:]] == [1, 2, 3, -1]
        await asyncio.to_thread(bus.close)

    asyncio.run(main())


def test_a_message_of_a_newer_version_is_malformed_for_a_reason_that_is_told(endpoint, caplog):
    newer = zenoh.Encoding("application/msgpack").with_schema("Keyframe/2")

    async def main():
        async with running(lambda: ZenohBus(endpoint), (READER, Config(), "a")) as (reader,):
            with await asyncio.to_thread(zenoh.open, client_config(endpoint)) as session:
                key = KEYFRAME.key_of(keyframe(1))
                session.put(key, encode(keyframe(1)), encoding=newer, attachment=pack_header("w", 0, 0))
                await until(lambda: reader.inbox.of("KEYFRAME").malformed == 1)
            assert reader._state == []

    asyncio.run(main())
    told = next(record for record in caplog.records if record.getMessage() == "malformed message dropped")
    assert told.why == "Keyframe/2 is newer than this program's Keyframe/1; update it"


def test_malformed_questions_are_refused(new_bus):
    async def main():
        async with running(new_bus, (ANSWERER, Config(), "b")) as (answerer,):
            bus = await asyncio.to_thread(new_bus)
            answers = []
            bus.call(VOXEL_MAP.key_of(MapRequest(robot="r")), b"\xc1junk", 2.0, answers.append)
            await until(lambda: answers)
            assert answers[0].payload is None and "not a valid MapRequest" in answers[0].reason
            assert answerer.inbox.of("VOXEL_MAP").malformed == 1
            await asyncio.to_thread(bus.close)

    asyncio.run(main())


def of(message, robot):
    return msgspec.structs.replace(message, robot=robot)


def test_a_message_counts_for_the_robot_of_its_key_only(new_bus, caplog):
    async def main():
        services = [(READER, Config(), "a"), (ANSWERER, Config(), "b"), (WORKER, Config(), "w")]
        async with running(new_bus, *services) as (reader, answerer, worker):
            bus = await asyncio.to_thread(new_bus)
            forged = of(keyframe(1), "other")
            bus.put(KEYFRAME, KEYFRAME.key_of(keyframe(1)), encode(forged), pack_header("x", 0, 0))
            bus.put(KEYFRAME, KEYFRAME.key_of(keyframe(1)), encode(keyframe(2)), pack_header("y", 0, 0))
            answers = []
            bus.call(VOXEL_MAP.key_of(MapRequest(robot="r")), encode(MapRequest(robot="other")), 2.0, answers.append)
            bus.call(job_key(ENCODE, "w", "r"), encode(forged), 2.0, answers.append)
            bus.call(job_key(ENCODE, "w", "r"), encode(keyframe(3)), 2.0, answers.append)
            await until(lambda: reader._state == [2] and len(answers) == 3)
            assert [answer.payload for answer in answers if answer.payload] == [b"done 1"] and worker._state == [3]
            refused = (reader, "KEYFRAME"), (answerer, "VOXEL_MAP"), (worker, "ENCODE")
            assert [host.inbox.of(name).malformed for host, name in refused] == [1, 1, 1]
            await asyncio.to_thread(bus.close)

    asyncio.run(main())
    told = [record.why for record in caplog.records if record.getMessage().startswith("message on a key")]
    assert "it came on psg/r/keyframe and says it belongs on psg/other/keyframe" in told and len(told) == 3


def test_a_reader_of_another_robot_is_not_waited_for(new_bus):
    def entry(robot):
        started = Started(robot=robot, service="x", instance="x", epoch=1, config=b"", reads=["KEYFRAME"])
        return Consumed(robot=robot, service="x", instance="x", order=0, topic="START", inline=encode(started))

    async def main():
        async with running(new_bus, (SOURCE, Config(frames=1), "s"), (WORKER, Config(), "w")) as (source, _):
            bus = await asyncio.to_thread(new_bus)
            bus.announce(alive_key("x", "x"))
            bus.put(JOURNAL, JOURNAL.pattern("r"), encode(entry("other")), pack_header("x", 0, 0))
            await until(lambda: source.inbox.of("JOURNAL").malformed == 1)
            assert source._state["lead"] == []
            bus.put(JOURNAL, JOURNAL.pattern("r"), encode(entry("r")), pack_header("x", 1, 0))
            await until(lambda: source._state["lead"] == [0])
            await asyncio.to_thread(bus.close)

    asyncio.run(main())


def telling_other(state, request, cfg):
    return of(answer(state, request, cfg), "other")


LIAR = Service("liar", "", "robot", Config, lambda cfg, me: [], reader_step, answers={VOXEL_MAP: telling_other})


def test_an_answer_about_another_robot_is_asked_again(new_bus):
    async def main():
        async with running(new_bus, (LIAR, Config(), "b"), (ASKER, Config(), "a")) as (_, asker):
            await until(lambda: asker.inbox.of("VOXEL_MAP").malformed >= 1)
            assert asker._state == []

    asyncio.run(main())


def test_the_client_asks_and_sees_health(new_bus):
    async def main():
        async with running(new_bus, (ANSWERER, Config(), "b1")):
            with await asyncio.to_thread(lambda: BusClient(new_bus())) as client:
                reply = await asyncio.to_thread(client.ask, VOXEL_MAP, MapRequest(robot="r"))
                assert reply.voxel_m == 0.25
                assert (await asyncio.to_thread(client.alive))["b1"] == "answerer"
                status = await asyncio.to_thread(client.status, "answerer", "b1")
                assert status.service == "answerer" and status.resident_mb > 1

    asyncio.run(main())


def task_ahead(state, request, cfg):
    return TaskInForce(robot="r", task=Task(robot="r", stamp_ns=2**62, environment="e", task="t"))


def test_a_busy_store_is_asked_again_before_a_task_is_stamped(monkeypatch):
    monkeypatch.setattr("prior_sg.services.runtime.client.STAMP_TIMEOUT_S", 0.05)
    answered = []

    def answer(request):
        answered.append(request)
        if len(answered) < wanted:
            request.refuse("timeout")
        else:
            request.reply(
                encode(TaskInForce(robot="r", task=Task(robot="r", stamp_ns=2**62, environment="e", task="t")))
            )

    wanted = 3
    bus = LocalBus(Hub())
    bus.serve("psg/r/ask/task", answer)
    client = BusClient(bus)
    assert client.task_stamp_ns("r") == 2**62 + 1 and len(answered) == 3
    wanted = 99
    with pytest.raises(BusError, match="busy"):  # stamped by the clock alone it would come before the one in force
        client.task_stamp_ns("r")


AHEAD = Service("ahead", "", "robot", Config, lambda cfg, me: [], reader_step, answers={TASK_IN_FORCE: task_ahead})


def test_a_task_is_stamped_after_the_one_in_force_though_that_was_given_by_a_clock_ahead():
    hub = Hub()

    async def main():
        with BusClient(LocalBus(hub)) as client:
            before_ns = time.time_ns()
            assert before_ns <= await asyncio.to_thread(client.task_stamp_ns, "r") <= time.time_ns()
            async with running(lambda: LocalBus(hub), (AHEAD, Config(), "a")):
                assert await asyncio.to_thread(client.task_stamp_ns, "r") == 2**62 + 1

    asyncio.run(main())


@pytest.mark.parametrize(
    "output",
    [(TASK, Task(robot="r", stamp_ns=0, environment="e", task="t")), Ask(PLACE_SNAPSHOT, SnapshotRequest(robot="r"))],
)
def test_undeclared_outputs_are_faults_of_the_service(output):
    service = Service("rogue", "", "robot", Config, lambda cfg, me: [], lambda s, m, c: iter([output]), tick_s=0.01)

    async def main():
        host = Host(service, LocalBus(Hub()), Config(), Identity("r", "x", 1))
        with pytest.raises(UndeclaredError, match="does not declare"):
            await asyncio.wait_for(host.run(), 5)

    asyncio.run(main())


def task_step(state, message, cfg):
    if isinstance(message, Task):
        state.append(message.stamp_ns)
    yield from ()


TASKED = Service("reader", "", "robot", Config, lambda cfg, me: [], task_step, reads=(TASK,))
DAY_NS = 86_400 * 10**9


def test_a_task_stamped_far_ahead_is_refused_in_a_sentence_and_one_by_a_clock_a_little_ahead_is_not(new_bus, caplog):
    now_ns = time.time_ns()
    stamps = [now_ns + 400 * DAY_NS, 2**63 - 1, 5, now_ns + 90 * 10**9]

    async def main():
        async with running(new_bus, (TASKED, Config(), "a")) as (reader,):
            with BusClient(await asyncio.to_thread(new_bus)) as client:
                for stamp_ns in stamps:
                    client.publish(TASK, Task(robot="r", stamp_ns=stamp_ns, environment="home", task="tidy"))
                await until(lambda: len(reader._state) == 2)
            assert reader._state == stamps[2:] and reader.inbox.of("TASK").malformed == 2

    asyncio.run(main())
    whys = [record.why for record in caplog.records if hasattr(record, "why")]
    assert any("the task is stamped 400 days ahead of the clock here: set the clock" in why for why in whys)


@pytest.mark.parametrize(("now_ns", "refused"), [(10**18, False), (1_800_000_000 * 10**9, True)])
def test_a_host_without_a_clock_judges_no_stamp(now_ns, refused):
    assert bool(fault_of_stamp("it", now_ns + 10**18, now_ns)) is refused


def result_step(state, message, cfg):
    if isinstance(message, Keyframe):
        state.append(message.frame_id)
        yield KEYFRAME, message


MAKER = Service("worker", "", "fleet", Config, lambda cfg, me: [], result_step, job=ENCODE, writes=(KEYFRAME,))
EMPTY = Service("worker", "", "fleet", Config, lambda cfg, me: [], reader_step, job=ENCODE, writes=(KEYFRAME,))


def test_a_worker_that_says_done_without_a_result_swallows_no_job(new_bus):
    async def main():
        services = [
            (READER, Config(), "a"),
            (EMPTY, Config(), "empty"),
            (MAKER, Config(), "good"),
            (SOURCE, Config(frames=8), "s"),
        ]
        liar = await asyncio.to_thread(new_bus)
        run_key, live_key = worker_keys(ENCODE, "liar")
        liar.serve(f"{run_key}/*", lambda request: request.reply(b"done"))
        liar.announce(live_key)
        async with running(new_bus, *services) as (_, empty, good, source):
            await until(lambda: len(source._state["done"]) == 8)
            assert {worker for _, worker, _ in source._state["done"]} == {"good"}
            assert sorted(set(good._state)) == list(range(8)) and len(empty._state) < 8
        await asyncio.to_thread(liar.close)

    asyncio.run(main())


def test_a_worker_of_a_release_that_counted_no_results_is_believed_and_one_of_ours_is_not():
    hub = Hub()

    def worker(name, release):
        bus = LocalBus(hub)
        run_key, live_key = worker_keys(ENCODE, name)
        bus.serve(f"{run_key}/*", lambda request: request.reply(b"done"))
        status = ServiceStatus(
            **{field.name: 0 for field in msgspec.structs.fields(ServiceStatus) if field.required}
            | {"service": "worker", "instance": name, "robot": "*", "topics": [], "waiting_for": [], "release": release}
        )
        bus.serve(status_key("*", name), lambda request: request.reply(encode(status)))
        bus.announce(live_key)

    ended = []
    pool = JobPool(LocalBus(hub), ENCODE, "r", time.monotonic, ended.append)
    worker("ours", "0.1.0")
    pool.submit(("r", 0), encode(keyframe(0)))
    assert ended == []
    worker("old", "")
    assert [(job.id, job.worker, job.error) for job in ended] == [(("r", 0), "old", "")]
    pool.close()


def test_a_job_that_was_done_is_answered_again_without_being_done_again_unless_that_is_wished(new_bus):
    async def main():
        async with running(new_bus, (MAKER, Config(), "good")) as (worker,):
            asking = await asyncio.to_thread(new_bus)
            answers = []
            wished = msgspec.structs.replace(keyframe(1), space="s")
            for sent in (keyframe(0), keyframe(0), keyframe(1), wished, wished):
                asking.call(job_key(ENCODE, "good", "r"), encode(sent), 10.0, answers.append)
                number = len(answers)
                await until(lambda number=number: len(answers) > number or len(answers) == 5)
            await until(lambda: len(answers) == 5)
            assert [answer.payload for answer in answers] == [b"done 1"] * 5
            assert worker._state == [0, 1, 1, 1]
            await asyncio.to_thread(asking.close)

    asyncio.run(main())

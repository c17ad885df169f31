"""What one key may carry, and old messages that are sent again as if they were new."""

import asyncio
import json
import time

import msgspec
import pytest
import zenoh

from prior_sg.schemas.codec import DecodeError, decode, encode
from prior_sg.schemas.priors import Task, TaskRequest
from prior_sg.schemas.topics import (
    LARGEST,
    MB,
    PRIOR,
    QUERIES,
    TASK,
    TASK_IN_FORCE,
    TOPICS,
    called_on,
    job_key,
)
from prior_sg.services.runtime.bus import BusError, Sample, pack_header
from prior_sg.services.runtime.client import BusClient
from prior_sg.services.runtime.endpoints import free_endpoint
from prior_sg.services.runtime.host import limits
from prior_sg.services.runtime.host.answering import MOST_QUESTIONS
from prior_sg.services.runtime.host.host import Host
from prior_sg.services.runtime.host.limits import Limits
from prior_sg.services.runtime.host.replays import Replays
from prior_sg.services.runtime.service import Identity, Service
from prior_sg.services.runtime.zenoh_bus import ZenohBus
from prior_sg.services.runtime.zenoh_router import router_settings
from prior_sg.services.runtime.zenoh_session import client_config


class Config(msgspec.Struct, frozen=True):
    pass


def reader(seen):
    def step(state, message, cfg):
        seen.append(message)
        return iter(())

    return Service(
        "reader", "", "fleet", Config, init=lambda cfg, identity: None, step=step, reads=(TASK,),
        answers={TASK_IN_FORCE: lambda state, request, cfg: time.sleep(0.05) or request},
    )  # fmt: skip


def task(robot, stamp_ns, text="t"):
    return Task(robot=robot, stamp_ns=stamp_ns, environment="e", task=text)


def sample(topic, robot, writer="w", sequence=0, payload=b""):
    key = topic.pattern(robot).replace("*", "x")
    return Sample(topic, key, payload, writer, sequence, 0)


def test_a_key_carries_a_burst_and_then_its_rate_and_another_key_its_own(caplog):
    now_s = [0.0]
    limit = Limits(lambda: now_s[0])
    allowed = [limit.allow(sample(TASK, "a")) for _ in range(TASK.most_at_once + 50)]
    assert sum(allowed) == TASK.most_at_once and not any(allowed[TASK.most_at_once :])
    assert limit.allow(sample(TASK, "b"))
    assert [record.getMessage() for record in caplog.records] == ["too many messages: dropped until there are fewer"]
    assert caplog.records[0].key == "psg/a/task"
    now_s[0] = 1.0
    assert sum(limit.allow(sample(TASK, "a")) for _ in range(50)) == TASK.most_hz
    now_s[0] = 100.0
    assert limit.allow(sample(TASK, "a"))
    assert caplog.records[-1].number == 50 + 50 - TASK.most_hz and len(caplog.records) == 2


def test_what_names_no_robot_in_its_key_has_one_rate_and_strangers_are_forgotten(monkeypatch):
    monkeypatch.setattr(limits, "MOST_KEYS", 3)
    limit = Limits(lambda: 0.0)
    priors = [Sample(PRIOR, f"psg/fleet/prior/{n:032x}", b"", "w", n, 0) for n in range(PRIOR.most_at_once + 9)]
    assert sum(map(limit.allow, priors)) == PRIOR.most_at_once
    assert all(limit.allow(sample(TASK, f"robot{n}")) for n in range(9)) and len(limit._buckets) == 3


def test_no_topic_is_limited_below_what_its_cache_gives_late_readers():
    for topic in TOPICS:
        assert topic.most_at_once >= 2 * topic.cache and topic.most_hz >= 10 * topic.rate_hz, topic.name
        assert topic.most_bytes <= LARGEST and (topic.priority != "bulk" or topic.delivery == "job")


def test_what_rises_and_falls_while_numbers_rise_is_a_replay():
    known = Replays()
    assert not known.fault_of(sample(TASK, "a", sequence=1), task("a", 10))
    assert not known.fault_of(sample(TASK, "a", sequence=2), task("a", 11))
    assert "a replay: stamp_ns" in known.fault_of(sample(TASK, "a", sequence=3), task("a", 10))
    assert "a replay" in known.fault_of(sample(TASK, "a", sequence=4), task("a", 11))
    assert not known.fault_of(sample(TASK, "a", writer="other", sequence=0), task("a", 10))  # which knew no better
    assert not known.fault_of(sample(TASK, "a", writer="", sequence=-1), task("a", 1))
    assert not known.fault_of(sample(TASK, "a", sequence=5), task("a", 12))


def test_every_call_and_message_of_the_table_has_a_limit_in_a_router():
    from prior_sg.services.runtime.shaping import size_filters

    filters = [(set(f["messages"]), zenoh.KeyExpr(f["key_exprs"][0]), f["size_limit"]) for f in size_filters()]
    for topic in TOPICS:
        kind, key = ("query", job_key(topic, "w", "r")) if topic.delivery == "job" else ("put", topic.pattern("r"))
        found = [size for kinds, keys, size in filters if kind in kinds and keys.includes(zenoh.KeyExpr(key))]
        assert [size // MB * MB for size in found if topic.most_bytes >= MB] in ([], [topic.most_bytes]), topic.name
        assert len(found) == 1
    for query in QUERIES:
        key = query.key.format(robot="r", space="a/b", topic="T", keeper="k")
        for kind in ("query", "reply"):
            assert sum(kind in kinds and keys.includes(zenoh.KeyExpr(key)) for kinds, keys, _ in filters) == 1
        assert called_on(key) is query


def test_a_flood_of_one_robot_costs_another_nothing(endpoint, caplog):
    """Forty thousand tasks of one robot, among them fifty of another: these are all consumed."""

    async def main():
        seen = []
        host = Host(reader(seen), ZenohBus(endpoint), Config(), Identity("*", "reader", 1))
        running = asyncio.create_task(host.run())
        with BusClient(ZenohBus(endpoint)) as client, zenoh.open(client_config(endpoint)) as flooder:
            client.alive()
            while "reader" not in client.alive():
                await asyncio.sleep(0.05)

            def flood():
                blocking = zenoh.CongestionControl.BLOCK
                for number in range(40_000):
                    header = pack_header(f"flood/{number % 7}/1", number // 7, time.time_ns())
                    payload = encode(task("bad", number + 1))
                    flooder.put("psg/bad/task", payload, attachment=header, congestion_control=blocking)
                    if number % 800 == 0:
                        client.publish(TASK, task("good", number + 1))

            await asyncio.to_thread(flood)
            end_s, counts = time.monotonic() + 60, host.inbox.of("TASK")
            while sum(one.robot == "good" for one in seen) < 50 or counts.limited <= 30_000:
                assert time.monotonic() < end_s
                await asyncio.sleep(0.05)
            assert sum(one.robot == "bad" for one in seen) < 5_000
            assert counts.missed == 0
        host.stop()
        await running

    asyncio.run(main())
    told = [record for record in caplog.records if record.getMessage().startswith("too many messages")]
    assert 1 <= len(told) <= 3 and told[0].key == "psg/bad/task"


def test_too_many_questions_at_once_are_refused_and_the_others_answered(endpoint):
    async def main():
        host = Host(reader([]), ZenohBus(endpoint), Config(), Identity("*", "asked", 1))
        running = asyncio.create_task(host.run())
        with BusClient(ZenohBus(endpoint)) as client:
            while "asked" not in client.alive():
                await asyncio.sleep(0.05)
            answers = []
            payload = encode(TaskRequest(robot="a"))
            for _ in range(MOST_QUESTIONS + 40):
                client.bus.call("psg/a/ask/task", payload, 60.0, answers.append)
            end_s = time.monotonic() + 20
            while sum("wait here already" in answer.reason for answer in answers) < 30:
                assert time.monotonic() < end_s, len(answers)
                await asyncio.sleep(0.05)
        host.stop()
        await running

    asyncio.run(main())


def test_what_is_too_large_is_not_sent_not_put_together_and_not_decoded(endpoint):
    bus, small = ZenohBus(endpoint), encode(task("a", 1))
    seen = []
    bus.subscribe(TASK, TASK.pattern("*"), seen.append, lambda *_: None)
    with pytest.raises(BusError, match="TASK: a message of"):
        bus.put(TASK, "psg/a/task", bytes(TASK.most_bytes + 1), b"")
    with zenoh.open(client_config(endpoint)) as liar:
        for number_of_bytes in (LARGEST + MB, TASK.most_bytes + MB):
            liar.put("psg/a/task", bytes(number_of_bytes), congestion_control=zenoh.CongestionControl.BLOCK)
        liar.put("psg/a/task", small, congestion_control=zenoh.CongestionControl.BLOCK)
        end_s = time.monotonic() + 20
        while not seen:
            assert time.monotonic() < end_s
            time.sleep(0.05)
    assert [one.payload for one in seen] == [small]
    bus.close()


def test_where_a_router_lets_large_messages_pass_a_reader_refuses_them(tmp_path):
    endpoint = free_endpoint("tcp/127.0.0.1:0")
    settings = router_settings(endpoint)
    del settings["low_pass_filter"]
    with zenoh.open(zenoh.Config.from_json5(json.dumps(settings))), zenoh.open(client_config(endpoint)) as liar:
        bus, seen = ZenohBus(endpoint), []
        bus.subscribe(TASK, TASK.pattern("*"), seen.append, lambda *_: None)
        end_s = time.monotonic() + 20
        while not seen:
            liar.put("psg/a/task", bytes(TASK.most_bytes + 1), congestion_control=zenoh.CongestionControl.BLOCK)
            assert time.monotonic() < end_s
            time.sleep(0.1)
        assert seen[0].payload == b""
        with pytest.raises(DecodeError, match=f"at most {TASK.most_bytes} are taken"):
            decode(Task, seen[0].payload)
        bus.close()

"""A process takes over from another over Zenoh: nothing is lost, nothing is done twice, one writes at a time."""

import asyncio
import contextlib
import re
import time

import msgspec
import pytest

from prior_sg.deploy.running.serve import _in_charge
from prior_sg.schemas.codec import decode, encode
from prior_sg.schemas.frames import Keyframe
from prior_sg.schemas.places import PlaceDelta
from prior_sg.schemas.status import Tick
from prior_sg.schemas.succession import Bequest, Succession, TakesOver
from prior_sg.schemas.topics import ENCODE, KEYFRAME, PLACE_DELTA, PYRAMID
from prior_sg.services.runtime.bus import NOBODY, Answer
from prior_sg.services.runtime.client import BusClient
from prior_sg.services.runtime.host import succession
from prior_sg.services.runtime.host.host import Host
from prior_sg.services.runtime.service import Handover, Identity, Service, ServiceError
from prior_sg.services.runtime.zenoh_bus import ZenohBus
from tests.help.examples import EXAMPLES
from tests.help.examples import KEYFRAME as FRAME

DELTA = next(example for example in EXAMPLES if isinstance(example, PlaceDelta))
PYRAMID_OF = next(example for example in EXAMPLES if type(example).__name__ == "Pyramid")


class Config(msgspec.Struct, frozen=True):
    work_s: float = 0.0


class Here:
    """Hosts of this test, each on a bus of its own, started as the service processes start theirs."""

    def __init__(self, endpoint, robot):
        self.endpoint, self.robot, self.tasks = endpoint, robot, {}

    async def start(self, service, instance, succeeds="", cfg=Config()):
        bus = await asyncio.to_thread(ZenohBus, self.endpoint)
        identity = Identity(self.robot if service.scope == "robot" else "*", instance, time.time_ns())
        host = await _in_charge(service, bus, cfg, identity, succeeds)
        self.tasks[host] = asyncio.create_task(host.run())
        return host

    async def ended(self, host):
        await asyncio.wait_for(self.tasks.pop(host), 20.0)


@contextlib.asynccontextmanager
async def hosts(endpoint, robot):
    here = Here(endpoint, robot)
    try:
        yield here
    finally:
        for host, task in here.tasks.items():
            host.stop()
            with contextlib.suppress(Exception):
                await task


async def until(condition, timeout_s=20.0):
    end_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end_s, "did not happen"
        await asyncio.sleep(0.02)


def of(robot, frame_id):
    return msgspec.structs.replace(FRAME, robot=robot, frame_id=frame_id, space="")


def works(state, message, cfg):
    time.sleep(cfg.work_s)
    state.append(message.frame_id)
    yield PYRAMID, msgspec.structs.replace(PYRAMID_OF, robot=message.robot, frame_id=message.frame_id)


def gives(state, message, cfg):
    if isinstance(message, Keyframe):
        yield ENCODE, message


WORKER = Service(
    "worker", "", "fleet", Config, lambda cfg, me: [], works, writes=(PYRAMID,), job=ENCODE, beside=True
)  # fmt: skip
GIVER = Service("giver", "", "robot", Config, lambda cfg, me: [], gives, reads=(KEYFRAME,), writes=(ENCODE,))


def test_a_worker_that_yields_finishes_its_jobs_and_no_job_is_done_twice(endpoint):
    async def main():
        async with hosts(endpoint, "yield1") as here:
            await here.start(GIVER, "giver")
            first = await here.start(WORKER, "w1", cfg=Config(work_s=0.05))
            client = BusClient(await asyncio.to_thread(ZenohBus, endpoint))
            with client:
                await until(lambda: "giver" in client.alive(0.1))  # before that it may not hear all
                for number in range(30):
                    client.publish(KEYFRAME, of("yield1", number))
                await until(lambda: len(first._state or ()) > 2)
                second = await here.start(WORKER, "w2", succeeds="w1")
                await here.ended(first)
                assert first.yielded and not second.yielded
                await until(lambda: len(first._state) + len(second._state or ()) >= 30)
            assert sorted(first._state + second._state) == list(range(30))
            assert len(second._state) > 2

    asyncio.run(main())


OPEN: list[str] = []  # of what may be open once only


def opens(cfg, me):
    assert not OPEN
    OPEN.append(me.instance)
    return []


KEEPER = Service("keeper", "", "fleet", Config, opens, gives, close=lambda state: OPEN.clear())


def test_what_can_be_open_once_is_closed_before_the_successor_opens_it(endpoint):
    async def main():
        async with hosts(endpoint, "yield2") as here:
            first = await here.start(KEEPER, "k1")
            await until(lambda: OPEN == ["k1"])
            await here.start(KEEPER, "k2", succeeds="k1")
            await here.ended(first)
            await until(lambda: OPEN == ["k2"])

    asyncio.run(main())


def follows(state, message, cfg):
    """Counts keyframes; tells of each what has come so far."""
    match message:
        case Keyframe():
            state["seen"].append(message.frame_id)
        case Succession():
            state["silent"] = True
        case TakesOver():
            state["silent"], state["told"] = False, message.bequest
        case Tick():
            return
    if not state["silent"] and state["seen"]:
        state["revision"] += 1
        yield PLACE_DELTA, delta_of(state)


def delta_of(state):
    changes = {"epoch": state["me"].epoch, "revision": state["revision"], "frame_id": max(state["seen"])}
    return msgspec.structs.replace(DELTA, robot=state["me"].robot, snapshot=False, **changes)


FOLLOWER = Service(
    "follower",
    "",
    "robot",
    Config,
    lambda cfg, me: {"me": me, "seen": [], "silent": False, "revision": -1, "told": None},
    follows,
    reads=(KEYFRAME,),
    writes=(PLACE_DELTA,),
    handover=Handover(
        lacks=lambda state, cfg: "" if len(state["seen"]) >= 5 else f"{5 - len(state['seen'])} keyframes",
        bequest=lambda state, me, cfg: Bequest(
            robot=me.robot, service="follower", instance=me.instance, next_ids={"places": max(state["seen"])}
        ),
    ),
)


def test_a_successor_tells_nothing_until_the_predecessor_has_said_its_last_word(endpoint):
    async def main():
        async with hosts(endpoint, "yield3") as here:
            first = await here.start(FOLLOWER, "f1")
            deltas = []
            client = BusClient(await asyncio.to_thread(ZenohBus, endpoint))
            with client:
                client.listen(PLACE_DELTA, "yield3", lambda sample: deltas.append(decode(PlaceDelta, sample.payload)))
                for number in range(4):
                    client.publish(KEYFRAME, of("yield3", number))
                await until(lambda: len(deltas) == 4)
                second = await here.start(FOLLOWER, "f2", succeeds="f1")
                await until(lambda: second._state is not None and len(second._state["seen"]) == 4)
                await asyncio.sleep(0.5)
                assert not first.yielded and second._state["silent"]
                for number in range(4, 12):
                    client.publish(KEYFRAME, of("yield3", number))
                await here.ended(first)
                await until(lambda: deltas and deltas[-1].epoch == second.identity.epoch and deltas[-1].frame_id == 11)
            epochs = [delta.epoch for delta in deltas]
            assert epochs == sorted(epochs) and set(epochs) == {first.identity.epoch, second.identity.epoch}
            last = max(delta.frame_id for delta in deltas if delta.epoch == first.identity.epoch)
            assert second._state["told"].next_ids == {"places": last}
            standings = [one.instance for one in await asyncio.to_thread(_standings, endpoint) if one.robot == "yield3"]
            assert standings == ["f2"]

    asyncio.run(main())


def _standings(endpoint):
    with BusClient(ZenohBus(endpoint)) as client:
        return [one for one in client.standings() if one.holder is not None]


def test_a_successor_that_goes_on_lacking_gives_up_and_the_predecessor_serves_on(endpoint, monkeypatch):
    monkeypatch.setattr(succession, "PATIENCE_S", 0.3)

    async def main():
        async with hosts(endpoint, "yield4") as here:
            first = await here.start(FOLLOWER, "f1")
            second = await here.start(FOLLOWER, "f2", succeeds="f1")
            with pytest.raises(ServiceError, match=r"it lacks 5 keyframes; its predecessor serves on"):
                await here.ended(second)
            assert not first.yielded and not here.tasks[first].done()

    asyncio.run(main())


def test_a_successor_takes_over_from_one_that_dies_while_it_stands_by(endpoint):
    async def main():
        async with hosts(endpoint, "yield5") as here:
            first = await here.start(FOLLOWER, "f1")
            second = await here.start(FOLLOWER, "f2", succeeds="f1")
            await until(lambda: second._state and second._state["silent"])
            here.tasks.pop(first).cancel()
            await until(lambda: not second._state["silent"])
            assert second._state["told"] is None

    asyncio.run(main())


def test_nobody_yields_twice(endpoint):
    async def main():
        async with hosts(endpoint, "yield6") as here:
            await here.start(KEEPER, "k1")
            bus = await asyncio.to_thread(ZenohBus, endpoint)
            other = succession.Predecessor(bus, "fleet", "keeper", "nobody", "me")
            assert await other.yields() is None
            host: Host = next(iter(here.tasks))
            host._yielding._heir = object()  # one has asked already
            said = "(nobody)"
            while "(nobody)" in said:  # until this session knows whom to ask
                with pytest.raises(ServiceError) as refused:
                    await succession.Predecessor(bus, "fleet", "keeper", "k1", "me").yields()
                said = str(refused.value)
            assert re.search("k1 does not yield .*to another already.* this process ends", said)
            host._yielding._heir = None
            await asyncio.to_thread(bus.close)

    asyncio.run(main())


class SlowToTell:
    """A bus whose session is told only after a while who answers."""

    def __init__(self, empty):
        self.empty, self.asked = empty, 0

    def call(self, key, payload, timeout_s, on_answer):
        self.asked += 1
        word = encode(Bequest(robot="fleet", service="keeper", instance="k1"))
        on_answer(Answer(None, NOBODY) if self.asked <= self.empty else Answer(word))

    def announced(self, pattern, timeout_s):
        return {pattern}


def test_who_is_alive_and_not_yet_known_is_asked_again():
    bus = SlowToTell(empty=3)
    bequest = asyncio.run(succession.Predecessor(bus, "fleet", "keeper", "k1", "me").yields())
    assert bequest is not None and bequest.instance == "k1" and bus.asked == 4

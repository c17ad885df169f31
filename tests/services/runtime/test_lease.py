"""One writer for each robot and service: the later epoch wins, the other stops itself, one takes over at the end."""

import asyncio
import contextlib
import time

import msgspec
import pytest

from prior_sg.schemas.codec import LAST_NUMBER, encode
from prior_sg.schemas.places import PlaceDelta
from prior_sg.schemas.status import EpochKnown
from prior_sg.schemas.topics import PLACE_DELTA, WAITING, lease_key
from prior_sg.services.deltas import BELIEVED_NS, BELIEVED_STEP, LAST_BELIEVED, next_epoch
from prior_sg.services.runtime.bus import BusError, Hub, LocalBus, pack_header
from prior_sg.services.runtime.host import lease as leases
from prior_sg.services.runtime.host.host import Host
from prior_sg.services.runtime.host.lease import Fence, Lease, SupersededError, standing
from prior_sg.services.runtime.service import Identity, Service
from prior_sg.services.runtime.zenoh_bus import ZenohBus
from tests.help.examples import EXAMPLES

DELTA = next(example for example in EXAMPLES if isinstance(example, PlaceDelta))


@pytest.fixture(params=["local", "zenoh"])
def new_bus(request):
    if request.param == "local":
        hub = Hub()
        return lambda: LocalBus(hub)
    address = request.getfixturevalue("endpoint")
    return lambda: ZenohBus(address)


@pytest.fixture(autouse=True)
def soon(monkeypatch):
    monkeypatch.setattr(leases, "GRACE_S", 0.1)
    monkeypatch.setattr(leases, "CHECK_S", 0.2)


class Writers:
    """Leases of one service and robot, each on a bus of its own."""

    def __init__(self, new_bus, robot):
        self.new_bus, self.robot, self.buses = new_bus, robot, []

    async def lease(self, instance, keepers=()):
        self.buses.append(await asyncio.to_thread(self.new_bus))
        return Lease(self.buses[-1], self.robot, "maker", instance, topics=[PLACE_DELTA], keepers=keepers)

    async def take(self, instance):
        lease = await self.lease(instance)
        return lease, await lease.take()


@contextlib.asynccontextmanager
async def writers(new_bus, robot):
    found = Writers(new_bus, robot)
    try:
        yield found
    finally:
        for bus in found.buses:
            await asyncio.to_thread(bus.close)


def test_the_second_waits_for_the_end_of_the_first_and_is_numbered_above_it(new_bus):
    async def main():
        async with writers(new_bus, "lease1") as those:
            _, first = await those.take("a")
            second = asyncio.create_task((await those.lease("b")).take())
            await asyncio.sleep(0.5)
            assert not second.done()
            bus = those.buses[1]
            assert lease_key("lease1", "maker", WAITING, "b") in bus.announced("psg/lease1/lease/**", 20.0)
            await asyncio.to_thread(those.buses[0].close)
            assert await asyncio.wait_for(second, 20.0) > first

    asyncio.run(main())


def test_of_two_that_come_to_see_each_other_the_lower_epoch_stops_itself(new_bus):
    async def main():
        async with writers(new_bus, "lease2") as those:
            lease, epoch = await those.take("a")
            keeping = asyncio.create_task(lease.keep())
            await asyncio.sleep(0.3)
            assert not keeping.done()
            healed = await asyncio.to_thread(new_bus)  # the other side of a link that was cut
            those.buses.append(healed)
            healed.announce(lease_key("lease2", "maker", str(epoch - 5), "older"))
            await asyncio.sleep(0.4)
            assert not keeping.done()
            healed.announce(lease_key("lease2", "maker", str(epoch + 5), "newer"))
            with pytest.raises(SupersededError, match=r"newer is in charge of maker of lease2 since epoch .* stops"):
                await asyncio.wait_for(keeping, 20.0)

    asyncio.run(main())


def test_of_five_that_start_at_once_one_is_in_charge(new_bus):
    async def main():
        async with writers(new_bus, "lease3") as those:
            all_ = [await those.lease(f"w{number}") for number in range(5)]

            async def work(lease, bus):
                await lease.take()
                with contextlib.suppress(SupersededError):
                    await lease.keep()
                await asyncio.to_thread(bus.close)

            tasks = [asyncio.create_task(work(*pair)) for pair in zip(all_, those.buses, strict=True)]
            those.buses.append(await asyncio.to_thread(new_bus))
            await asyncio.sleep(1.5)
            held = [key for key in those.buses[-1].announced("psg/lease3/lease/maker/*/*", 20.0) if "/0/" not in key]
            assert len(held) == 1
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    asyncio.run(main())


def test_an_epoch_lies_above_what_readers_follow_and_one_they_do_not_follow_is_drawn_again(new_bus):
    async def main():
        async with writers(new_bus, "lease4") as those:
            reader = await asyncio.to_thread(new_bus)
            those.buses.append(reader)
            followed = time.time_ns() + 10**15  # by a clock that was eleven days ahead
            reader.serve(
                "psg/lease4/ask/epoch/*/keeper",
                lambda request: request.reply(
                    encode(EpochKnown(robot="lease4", topic=PLACE_DELTA.name, epoch=followed, revision=0))
                ),
            )
            lease = await those.lease("a", keepers=["nobody", "keeper"])
            assert await lease.take() == followed + 1
            keeping = asyncio.create_task(lease.keep())
            await asyncio.sleep(0.5)
            assert not keeping.done()
            followed += 100  # of a stranger
            with pytest.raises(SupersededError, match=r"readers of PLACE_DELTA follow what .* starts again above it"):
                await asyncio.wait_for(keeping, 20.0)

    asyncio.run(main())


@pytest.mark.parametrize(
    ("now_ns", "known", "drawn"),
    [
        (100, -1, 100),
        (100, 60, 100),
        (100, 100, 101),
        (100, 5000, 5001),
        (60 + BELIEVED_NS, 60, 60 + BELIEVED_NS),
        (61 + BELIEVED_NS, 60, 61),
        (LAST_BELIEVED + 1, -1, 1),
        (LAST_BELIEVED + 1, LAST_BELIEVED - 1, LAST_BELIEVED),
    ],
)
def test_an_epoch_is_the_time_unless_that_says_nothing(now_ns, known, drawn):
    assert next_epoch(now_ns, known) == drawn


@pytest.mark.parametrize("epoch", ["", "-1", "01", "x", "1e9", "9" * 19, "9" * 5000, str(LAST_NUMBER + 1), "٣"])
def test_a_token_that_is_no_number_is_nobodys(epoch):
    found = standing(f"psg/r/lease/maker/{epoch}/a")
    assert found is None or found.holder is None
    assert standing(f"psg/r/lease/maker/{epoch}") is None


class Busy(LocalBus):
    """A router that is too busy to say who is there, so many times."""

    def __init__(self, hub, times):
        super().__init__(hub)
        self.times = times

    def announced(self, pattern, timeout_s):
        self.times -= 1
        if self.times >= 0:
            raise BusError("no answer")
        return super().announced(pattern, timeout_s)


def lying(hub, epoch):
    """A keeper that says it follows this epoch."""
    told = EpochKnown(robot="r", topic=PLACE_DELTA.name, epoch=epoch, revision=0)
    LocalBus(hub).serve("psg/r/ask/epoch/*/keeper", lambda request: request.reply(encode(told)))


def kept_by(hub, instance):
    return Lease(LocalBus(hub), "r", "maker", instance, topics=[PLACE_DELTA], keepers=["keeper"])


async def taken_and_kept(lease):
    epoch = await asyncio.wait_for(lease.take(), 20.0)
    keeping = asyncio.create_task(lease.keep())
    await asyncio.sleep(0.5)
    assert not keeping.done()
    keeping.cancel()
    return epoch


def test_no_answer_of_a_busy_router_is_not_nobody_in_charge(caplog):
    async def main():
        hub = Hub()
        other = LocalBus(hub)
        other.announce(lease_key("r", "maker", "7", "first"))
        starting = asyncio.create_task(Lease(Busy(hub, 2), "r", "maker", "second").take())
        end_s = time.monotonic() + 20
        while "first is in charge of maker of r: waiting" not in caplog.text and time.monotonic() < end_s:
            await asyncio.sleep(0.02)
        assert not starting.done()
        other.close()
        await asyncio.wait_for(starting, 20.0)
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(Lease(Busy(Hub(), 10**9), "r", "maker", "third").take(), 0.5)

    asyncio.run(main())
    assert "cannot be found out yet: no answer" in caplog.text and "first is in charge of maker of r:" in caplog.text


def test_who_is_in_charge_and_gets_no_answer_goes_on_until_it_hears_of_another():
    async def main():
        hub = Hub()
        bus = Busy(hub, 0)
        lease = Lease(bus, "r", "maker", "a")
        epoch = await lease.take()
        bus.times = 10**9
        keeping = asyncio.create_task(lease.keep())
        await asyncio.sleep(0.5)
        assert not keeping.done()
        LocalBus(hub).announce(lease_key("r", "maker", str(epoch + 1), "b"))
        with pytest.raises(SupersededError):
            await asyncio.wait_for(keeping, 20.0)

    asyncio.run(main())


@pytest.mark.parametrize("absurd", [LAST_BELIEVED + BELIEVED_STEP + 1, LAST_NUMBER - 1, LAST_NUMBER])
def test_a_token_that_no_reader_would_believe_keeps_nobody_from_writing(absurd, caplog):
    hub = Hub()
    LocalBus(hub).announce(lease_key("r", "maker", str(absurd), "liar"))

    async def main():
        return await taken_and_kept(Lease(LocalBus(hub), "r", "maker", "a"))

    assert asyncio.run(main()) <= LAST_BELIEVED
    assert f"liar poses as maker of r: epoch {absurd} leaves hardly a number above itself" in caplog.text


def test_an_answer_that_leaves_no_number_above_itself_is_not_believed(caplog):
    hub = Hub()
    lying(hub, LAST_NUMBER)

    async def main():
        return await taken_and_kept(kept_by(hub, "a"))

    assert asyncio.run(main()) <= LAST_BELIEVED
    assert caplog.text.count("keeper says of what it follows of maker of r: epoch") == 1


def test_who_goes_on_from_an_epoch_that_readers_follow_though_none_would_come_to_it_is_in_charge():
    hub = Hub()
    lying(hub, LAST_BELIEVED + 5)

    async def main():
        assert await kept_by(hub, "a").take() == LAST_BELIEVED + 6
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(kept_by(hub, "b").take(), 0.5)

    asyncio.run(main())


def reader_step(state, message, cfg):
    state.append(message.epoch)
    yield from ()


class Nothing(msgspec.Struct, frozen=True):
    pass


READER = Service("reader", "", "robot", Nothing, lambda cfg, me: [], reader_step, reads=(PLACE_DELTA,))


def test_what_a_stranger_numbers_above_the_one_in_charge_is_not_let_in(new_bus, caplog):
    async def main():
        async with writers(new_bus, "r") as those:
            _, epoch = await those.take("a")
            bus = await asyncio.to_thread(new_bus)
            fence = Fence(bus, "r", {PLACE_DELTA.name: ["maker"]})
            host = Host(READER, bus, Nothing(), Identity("r", "reader", 1), fence=fence)
            running = asyncio.create_task(host.run())
            await asyncio.sleep(0.3)
            for number, told in enumerate((epoch + 1, epoch - 1, epoch)):
                delta = msgspec.structs.replace(DELTA, epoch=told)
                those.buses[0].put(PLACE_DELTA, PLACE_DELTA.key_of(delta), encode(delta), pack_header("x", number, 0))
            end_s = time.monotonic() + 20
            while len(host._state) < 2 and time.monotonic() < end_s:
                await asyncio.sleep(0.02)
            host.stop()
            await running
            assert host._state == [epoch - 1, epoch]
            assert host.inbox.of(PLACE_DELTA.name).malformed == 1

    asyncio.run(main())
    assert "a is in charge of maker of r" in next(r.why for r in caplog.records if hasattr(r, "why"))


def test_a_host_that_loses_its_lease_ends_by_saying_so(new_bus):
    async def main():
        async with writers(new_bus, "r5") as those:
            lease, epoch = await those.take("a")
            host = Host(READER, those.buses[0], Nothing(), Identity("r5", "a", epoch), lease=lease)
            running = asyncio.create_task(host.run())
            await asyncio.sleep(0.2)
            other = await asyncio.to_thread(new_bus)
            those.buses.append(other)
            other.announce(lease_key("r5", "maker", str(epoch + 1), "b"))
            with pytest.raises(SupersededError):
                await asyncio.wait_for(running, 20.0)

    asyncio.run(main())

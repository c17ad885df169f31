"""Who is in charge when a service starts: the services and Hydra's bridge, each with the lease that it declares."""

import asyncio
import contextlib

import pytest

from prior_sg.deploy.hydra.bridge import SERVICE as HYDRA
from prior_sg.deploy.running.serve import _in_charge
from prior_sg.schemas.codec import encode
from prior_sg.schemas.status import EpochKnown
from prior_sg.schemas.topics import OBJECT_DELTA, PLACE_DELTA, REGION_DELTA
from prior_sg.services.registry import BY_NAME
from prior_sg.services.roles import WRITERS
from prior_sg.services.runtime.bus import Hub, LocalBus
from prior_sg.services.runtime.host import lease as leases
from prior_sg.services.runtime.host.lease import Fence, SupersededError
from prior_sg.services.runtime.service import Identity

PLACE_GRAPH, SEGMENTER = BY_NAME["place_graph"], BY_NAME["segmenter"]


@pytest.fixture(autouse=True)
def soon(monkeypatch):
    monkeypatch.setattr(leases, "GRACE_S", 0.05)
    monkeypatch.setattr(leases, "CHECK_S", 0.1)


async def host_of(service, bus, instance):
    return await _in_charge(service, bus, service.config(), Identity("robot1", instance, 0))


@pytest.mark.parametrize(("first", "second"), [(HYDRA, PLACE_GRAPH), (PLACE_GRAPH, HYDRA)])
def test_the_bridge_to_hydra_and_the_place_graph_exclude_each_other(first, second):
    async def main():
        hub = Hub()
        bus = LocalBus(hub)
        before = await host_of(first, bus, "a")
        starting = asyncio.create_task(host_of(second, LocalBus(hub), "b"))
        await asyncio.sleep(0.6)
        assert not starting.done()
        bus.close()
        after = await asyncio.wait_for(starting, 20.0)
        assert after.identity.epoch > before.identity.epoch

    asyncio.run(main())


def follows(bus, epochs):
    """A store that follows these epochs by topic."""

    def answer(request):
        topic = request.key.split("/")[-2]
        request.reply(encode(EpochKnown(robot="robot1", topic=topic, epoch=epochs.get(topic, -1), revision=0)))

    bus.serve("psg/robot1/ask/epoch/*/scene_store", answer)


@pytest.mark.parametrize("order", [(HYDRA, SEGMENTER), (SEGMENTER, HYDRA)])
def test_objects_of_hydra_are_let_in_above_those_of_the_segmenter_and_both_stay_in_charge(order):
    async def main():
        hub, epochs = Hub(), {}
        reader = LocalBus(hub)
        follows(reader, epochs)
        fence = Fence(reader, "robot1", WRITERS)
        hosts = {service.name: await host_of(service, LocalBus(hub), service.name) for service in order}
        newest = max(host.identity.epoch for host in hosts.values())
        assert not fence.fault_of(OBJECT_DELTA.name, "robot1", newest + 1)
        assert "is in charge of" in fence.fault_of(OBJECT_DELTA.name, "robot1", newest + 2)
        for topic, name in ((PLACE_DELTA, "hydra"), (REGION_DELTA, "segmenter")):
            own = hosts[name].identity.epoch
            assert not fence.fault_of(topic.name, "robot1", own) and fence.fault_of(topic.name, "robot1", own + 1)
        epochs[OBJECT_DELTA.name] = newest + 1
        keeping = [asyncio.create_task(host._lease.keep()) for host in hosts.values()]
        await asyncio.sleep(0.4)
        assert not any(task.done() for task in keeping)
        epochs[REGION_DELTA.name] = newest + 1  # of a stranger: the segmenter's alone
        done, pending = await asyncio.wait(keeping, timeout=2.0, return_when=asyncio.FIRST_COMPLETED)
        for task in pending:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task
        assert [type(task.exception()) for task in done] == [SupersededError]

    asyncio.run(main())

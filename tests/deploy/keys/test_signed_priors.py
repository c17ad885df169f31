"""Priors of a fleet: who may sign them, and that whoever reads one, from wherever, takes none that others have made."""

import asyncio
import contextlib
import dataclasses
import time
from pathlib import Path

import msgspec
import pytest

from prior_sg.deploy.cli.main import main
from prior_sg.deploy.keys.authority import LIST_FILE, Authority
from prior_sg.deploy.running.inprocess import InProcess
from prior_sg.schemas.codec import encode
from prior_sg.schemas.priors import Prior, PriorList, PriorRequest, Task
from prior_sg.schemas.status import Tick
from prior_sg.schemas.topics import PRIOR, PRIORS
from prior_sg.services.prior_gateway.core.config import Config
from prior_sg.services.prior_gateway.outside.library import load
from prior_sg.services.registry import SERVICES
from prior_sg.services.runtime.bus import BusError, Hub, LocalBus, pack_header
from prior_sg.services.runtime.client import BusClient
from prior_sg.services.runtime.host.host import Host
from prior_sg.services.runtime.keys import VARIABLE, About, read_bundle
from prior_sg.services.runtime.service import Ask, Identity
from prior_sg.services.runtime.signatures import Signatures, Unsigned, signatures_in_force

TASK = Task(robot="robot7", stamp_ns=1, environment="residential home", task="real-estate listing")
REQUEST = PriorRequest(environment=TASK.environment, task=TASK.task)


@pytest.fixture(scope="module")
def library_prior():
    return load().answer(TASK, Config())


@pytest.fixture
def fleet(tmp_path):
    made = Authority.create(tmp_path / "keys")
    for role, name in (("edge", "edge1"), ("robot", "robot7"), ("operator", "otto"), ("viewer", "anna")):
        made.add(role, name)
    return made


def of(fleet, name):
    return Signatures(read_bundle(fleet.bundle(name)))


def changed(prior):
    return msgspec.structs.replace(prior, task="another")


def test_edges_and_operators_sign_for_all_and_others_for_nobody_else(fleet, library_prior):
    for name, taken in (("edge1", True), ("otto", True), ("anna", False), ("robot7", False)):
        signed = of(fleet, name).signed(library_prior)
        assert signed.digest() == library_prior.digest()
        assert of(fleet, name).fault_of(signed) == ""
        assert (of(fleet, "edge1").fault_of(signed) == "") == taken, name
    assert "not signed" in of(fleet, "anna").fault_of(library_prior)
    assert "not signed" in of(fleet, "anna").fault_of(PriorList(priors=[library_prior]))


def test_what_was_changed_or_signed_by_strangers_is_not_taken(fleet, tmp_path, library_prior):
    signed = of(fleet, "edge1").signed(library_prior)
    assert "changed or forged" in of(fleet, "robot7").fault_of(changed(signed))
    foreign = Authority.create(tmp_path / "foreign")
    foreign.add("edge", "edge1")
    assert "changed or forged" in of(fleet, "robot7").fault_of(of(foreign, "edge1").signed(library_prior))
    foreign.add("edge", "edge9")
    assert "'edge9#1'" in of(fleet, "robot7").fault_of(of(foreign, "edge9").signed(library_prior))
    for signature in ("00ff", "no hexadecimal"):
        made = msgspec.structs.replace(signed.provenance, signature=signature)
        assert "forged" in of(fleet, "robot7").fault_of(msgspec.structs.replace(signed, provenance=made))


def test_a_key_that_was_replaced_or_revoked_counts_no_more_for_processes_that_run(fleet, library_prior):
    reader, before = of(fleet, "robot7"), of(fleet, "edge1").signed(library_prior)
    assert reader.fault_of(before) == ""
    fleet.rotate("edge1")
    assert "replaced" in reader.fault_of(before)
    after = of(fleet, "edge1").signed(library_prior)
    assert reader.fault_of(after) == ""
    fleet.revoke("edge1")
    assert "revoked" in reader.fault_of(after)


def test_a_list_of_before_is_completed_from_the_certificates(fleet, library_prior):
    def without_keys(path, kind):
        found = msgspec.json.decode(path.read_bytes(), type=kind)
        several = found if isinstance(found, list) else found.participants
        bare = [msgspec.structs.replace(one, public_key="") for one in several]
        found = bare if isinstance(found, list) else msgspec.structs.replace(found, participants=bare)
        path.write_bytes(msgspec.json.encode(found))

    without_keys(fleet.bundle("robot7") / "bundle.json", About)
    without_keys(fleet.folder / LIST_FILE, list[type(fleet.participants["edge1"])])
    signed = of(fleet, "edge1").signed(library_prior)
    assert "prior-sg keys rotate edge1" in of(fleet, "robot7").fault_of(signed)
    Authority(fleet.folder).rotate("anna")
    assert of(fleet, "robot7").fault_of(signed) == ""


def test_without_keys_nothing_is_signed_and_everything_taken(monkeypatch, library_prior):
    monkeypatch.setenv(VARIABLE, "")
    found = signatures_in_force()
    assert type(found) is Unsigned
    assert found.signed(library_prior) is library_prior and found.fault_of(library_prior) == ""


def step_that_notes(state, message, cfg):
    if isinstance(message, Tick):
        yield Ask(PRIORS, REQUEST)
    elif isinstance(message, Prior | PriorList):
        state.append(message)


def noting(service, asks):
    """The service with its declaration as it is, and a step that only notes the priors that get so far."""
    return dataclasses.replace(
        service, init=lambda cfg, me: [], step=step_that_notes, answers={}, errands=(), job=None, prepare=None,
        losses=lambda state: [], close=lambda state: None, tick_s=0.05 if asks else None,
    )  # fmt: skip


@contextlib.asynccontextmanager
async def running(service, hub):
    identity = Identity("robot7" if service.scope == "robot" else "*", "it", time.time_ns())
    host = Host(service, LocalBus(hub), service.config(), identity)
    task = asyncio.create_task(host.run())
    try:
        yield host
    finally:
        host.stop()
        await task


async def until(condition, timeout_s=15.0):
    end_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end_s, "did not happen"
        await asyncio.sleep(0.01)


@pytest.mark.parametrize("service", [one for one in SERVICES if PRIOR in one.reads], ids=lambda one: one.name)
def test_every_service_takes_only_signed_priors_that_are_published(service, fleet, monkeypatch, library_prior):
    monkeypatch.setenv(VARIABLE, str(fleet.bundle("robot7")))
    signed = of(fleet, "edge1").signed(library_prior)

    async def main():
        hub = Hub()
        async with running(noting(service, asks=False), hub) as host:
            await until(lambda: host._state is not None)
            with BusClient(LocalBus(hub)) as client:
                await until(lambda: "it" in client.alive(0.01))
                for prior in (library_prior, changed(signed), signed):
                    client.publish(PRIOR, prior)
                await until(lambda: host._state)
                assert host.inbox.of(PRIOR.name).malformed == 2
                assert [prior.provenance.signer for prior in host._state] == ["edge1#1"]

    asyncio.run(main())


@pytest.mark.parametrize("service", [one for one in SERVICES if PRIORS in one.asks], ids=lambda one: one.name)
def test_every_service_takes_only_signed_priors_that_it_asked_for(service, fleet, monkeypatch, library_prior):
    monkeypatch.setenv(VARIABLE, str(fleet.bundle("robot7")))
    answers = [PriorList(priors=[library_prior]), of(fleet, "edge1").signed(PriorList(priors=[library_prior]))]

    async def main():
        hub = Hub()
        LocalBus(hub).serve(PRIORS.key, lambda request: request.reply(encode(answers[0])))
        async with running(noting(service, asks=True), hub) as host:
            await until(lambda: host.inbox.of(PRIORS.name).malformed)
            assert host._state == []
            del answers[0]
            await until(lambda: host._state)

    asyncio.run(main())


def test_a_gateway_signs_what_it_says_and_a_client_takes_nothing_else(fleet, monkeypatch, tmp_path, library_prior):
    monkeypatch.setenv(VARIABLE, str(fleet.bundle("edge1")))
    gateway = InProcess("robot7", tmp_path, [f"prior_gateway.archive={tmp_path / 'archive'}"])
    gateway.start("prior_gateway")
    try:
        with BusClient(LocalBus(gateway.hub)) as client:
            while "prior_gateway" not in client.alive(0.05).values():
                gateway.check()
            unasked = client.ask(PRIORS, REQUEST)
            assert unasked.priors[0].provenance.signer == "edge1#1", "of a task that nobody has given yet"
            forged = msgspec.structs.replace(library_prior, objects=[], containment=library_prior.containment[:, :0])
            header = pack_header("stranger/1/1", 0, time.time_ns() + 10**10)
            heard = BusClient.listening

            @contextlib.contextmanager
            def listening(self, topic, robot, on_sample):
                with heard(self, topic, robot, on_sample):
                    client.bus.put(PRIOR, PRIOR.key_of(forged), encode(forged), header)
                    yield

            monkeypatch.setattr(BusClient, "listening", listening)
            assert client.give_task(TASK, 30.0).objects, "the gateway's, not the forged one"
        with BusClient(LocalBus(Hub())) as other:
            other.bus.serve("**", lambda request: request.reply(encode(PriorList(priors=[library_prior]))))
            with pytest.raises(BusError, match="not signed"):
                other.ask(PRIORS, REQUEST)
    finally:
        gateway.stop()


def test_an_import_takes_what_somebody_of_the_fleet_has_signed_or_the_user_stands_for(
    fleet, monkeypatch, tmp_path, capsys
):
    archive, file = ["--set", f"prior_gateway.archive={tmp_path / 'archive'}"], tmp_path / "prior.json"
    named = ["--environment", TASK.environment, "--task", TASK.task, "--out", str(file), *archive]

    def priors(*words):
        status = main(["priors", *map(str, words)])
        return status, " ".join("".join(capsys.readouterr()).split())

    monkeypatch.setenv(VARIABLE, "")
    assert priors("export", *named)[0] == 0
    assert priors("import", file, *archive)[0] == 0, "without keys nothing changes"
    monkeypatch.setenv(VARIABLE, str(fleet.bundle("edge1")))
    status, told = priors("import", file, *archive)
    assert status == 1 and "--vouch" in told
    assert priors("import", file, "--vouch", *archive)[0] == 0
    monkeypatch.setenv(VARIABLE, str(fleet.bundle("otto")))
    assert priors("export", *named)[0] == 0
    monkeypatch.setenv(VARIABLE, str(fleet.bundle("edge1")))
    status, told = priors("import", file, *archive)
    assert status == 0 and "signed by 'otto#1', verified" in told
    Path(file).write_text(file.read_text().replace('"kitchen"', '"cooking"'))
    assert "changed or forged" in priors("import", file, *archive)[1]

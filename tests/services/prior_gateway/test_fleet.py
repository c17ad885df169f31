"""Several gateways as processes on a real router, with a scripted model behind HTTP: sharing, failing over, secrets."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from prior_sg.deploy.inspecting.replay import compare, open_log
from prior_sg.deploy.running.recorder import Recorder
from prior_sg.schemas.codec import decode
from prior_sg.schemas.priors import Prior, PriorEvidence, PriorRequest, PriorRevision, Task
from prior_sg.schemas.topics import PRIOR, PRIOR_EVIDENCE, PRIOR_REVISION, PRIORS, TASK
from prior_sg.services.runtime.client import BusClient
from prior_sg.services.runtime.zenoh_bus import ZenohBus
from tests.help.model import good, serving, slow, status
from tests.help.paths import ROOT

KEY = "sk-fleet-0815-not-a-real-key"
DEADLINE_S = 60.0


class Fleet:
    """Gateways in processes of their own, each with its archive and log."""

    def __init__(self, endpoint: str, url: str, folder: Path) -> None:
        self.endpoint, self.url, self.folder, self.processes = endpoint, url, folder, {}

    def start(self, name: str, *settings: str) -> None:
        fixed = [
            "provider=openai", f"endpoint={self.url}", "model=fake", "key_env=FLEET_KEY", "lease_s=2",
            f"archive={self.folder / name}", 'synthesis={"samples": 1, "reason": false}',
            'calls={"backoff_s": 0.01, "requests_per_minute": 100000}', *settings,
        ]  # fmt: skip
        command = [sys.executable, "-m", "prior_sg.deploy.running.serve", "prior_gateway", "--connect", self.endpoint]
        command += ["--instance", name, "--log-level", "debug"]
        for setting in fixed:
            command += ["--set", f"prior_gateway.{setting}"]
        with (self.folder / f"{name}.log").open("wb") as log:
            self.processes[name] = subprocess.Popen(
                command, stdout=log, stderr=log, env=os.environ | {"FLEET_KEY": KEY}, cwd=ROOT
            )

    def end(self, name: str, how: int = signal.SIGTERM) -> None:
        process = self.processes.pop(name)
        process.send_signal(how)
        process.wait(20)

    def log(self, name: str) -> str:
        return (self.folder / f"{name}.log").read_text()


@pytest.fixture
def client(endpoint):
    with BusClient(ZenohBus(endpoint)) as client:
        yield client


def task(robot: str, name: str) -> Task:
    return Task(robot=robot, stamp_ns=time.time_ns(), environment="residential home", task=name)


def wait_for(condition, what: str, limit_s: float = DEADLINE_S) -> float:
    started_s = time.monotonic()
    while not condition():
        assert time.monotonic() - started_s < limit_s, what
        time.sleep(0.02)
    return time.monotonic() - started_s


def priors_of(client: BusClient) -> list[Prior]:
    found: list[Prior] = []
    client.listen(PRIOR, "*", lambda sample: found.append(decode(Prior, sample.payload)))
    return found


def alive(client: BusClient, *names: str) -> bool:
    return set(names) <= set(client.alive(0.0))


def conversations(model) -> int:
    """Each begins with a request of two messages about regions."""
    return sum("Into which regions" in body["messages"][-1]["content"] for _, _, body in model.requests)


def test_a_fleet_makes_one_call_shares_the_prior_and_keeps_the_key_secret(endpoint, client, tmp_path):
    with serving(good, status(500, f"cannot use {KEY}"), default=slow(0.3)) as model:
        fleet = Fleet(endpoint, model.url, tmp_path)
        recorder = Recorder(client, tmp_path / "log.mcap")
        try:
            fleet.start("a")
            fleet.start("b")
            wait_for(lambda: alive(client, "a", "b"), "two gateways alive")
            fleet.start("c")  # takes seconds to get up: it comes late
            found = priors_of(client)
            both = [threading.Thread(target=client.publish, args=(TASK, task(r, "clean"))) for r in ("r1", "r2")]
            [thread.start() for thread in both]
            wait_for(lambda: model.calls, "the model is asked")
            request = PriorRequest(environment="residential home", task="clean")
            pending = client.ask(PRIORS, request)
            assert (pending.priors, pending.pending) == ([], True), "a slow model holds up no question"
            wait_for(lambda: found, "a prior")
            assert conversations(model) == 1, "two robots, two gateways, one conversation"
            assert model.calls == 6, "five turns, one of them repeated"
            assert found[0].provenance.made_by in ("a", "b")
            wait_for(lambda: alive(client, "c"), "the third gateway")
            wait_for(lambda: list((tmp_path / "c").glob("*/*.prior")), "the third has the prior")
            fleet.end("a", signal.SIGKILL)
            fleet.end("b")
            found.clear()
            client.publish(TASK, task("r3", "clean"))
            seconds = wait_for(lambda: found, "the late one answers alone")
            assert seconds < 1
            assert model.calls == 6
        finally:
            for name in list(fleet.processes):
                fleet.end(name)
            recorder.close()
        assert {headers["authorization"] for _, headers, _ in model.requests} == {f"Bearer {KEY}"}
    written = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert {path.suffix for path in written} >= {".log", ".mcap", ".prior"}
    assert [path for path in written if KEY.encode() in path.read_bytes()] == []
    assert "cannot use ***" in fleet.log("a") + fleet.log("b"), "what the server said was told, without the key"
    log = open_log(tmp_path / "log.mcap", "prior_gateway")
    compared = {life.instance: compare(log, life) for life in log.lives}
    assert compared["c"].recorded >= 1
    assert all(result.differences == [] for result in compared.values()), compared


def test_when_the_one_at_work_dies_the_next_goes_on(endpoint, client, tmp_path):
    with serving(default=slow(1.5)) as model:
        fleet = Fleet(endpoint, model.url, tmp_path)
        try:
            fleet.start("a")
            fleet.start("b")
            wait_for(lambda: alive(client, "a", "b"), "two gateways alive")
            found = priors_of(client)
            client.publish(TASK, task("r1", "patrol"))
            wait_for(lambda: model.calls, "the model is asked")
            assert conversations(model) == 1
            fleet.end("a", signal.SIGKILL)  # of equals the first by name works
            model.default = good
            wait_for(lambda: found, "a prior")
            assert found[0].provenance.made_by == "b"
            assert conversations(model) == 2
        finally:
            for name in list(fleet.processes):
                fleet.end(name)


def unlikely(prior: Prior) -> int:
    """The object that the prior's first region holds least."""
    return int(prior.containment[0].argmin())


def explored(prior: Prior, robot: str, seen: int) -> PriorEvidence:
    """A map of regions, plainly the prior's first, each with an unlikely thing in it and the likeliest."""
    regions, objects = len(prior.regions), [item.name for item in prior.objects]
    nothing, count = np.zeros((regions, regions), np.float32), np.zeros(regions, np.float32)
    count[0] = seen
    contents = np.zeros((seen, len(objects)), np.float32)
    contents[:, [unlikely(prior), int(prior.containment[0].argmax())]] = 1.0
    looks = np.where(np.arange(regions) == 0, -0.1, -9.0)
    return PriorEvidence(
        robot=robot, epoch=1, stamp_ns=1, prior_digest=prior.digest(), environment=prior.environment, task=prior.task,
        regions=[region.name for region in prior.regions], objects=objects, places=16 * count, instances=count,
        holding=np.zeros((regions, len(objects)), np.float32), pairs=nothing, touching=nothing,
        sizes=np.full(seen, 16, np.float32), looks=np.tile(looks, (seen, 1)).astype(np.float32),
        contents=contents, links=np.zeros((0, 2), np.int32),
    )  # fmt: skip


def test_what_some_robots_saw_revises_the_prior_that_a_new_robot_starts_with(endpoint, client, tmp_path):
    fleet, library = Fleet(endpoint, "http://127.0.0.1:1/v1", tmp_path), ("provider=library", "model=", "key_env=")
    question = PriorRequest(environment="residential home", task="clean")
    try:
        fleet.start("a", *library)
        wait_for(lambda: alive(client, "a"), "the gateway alive")
        found = priors_of(client)
        client.publish(TASK, task("r1", "clean"))
        wait_for(lambda: found, "the library's prior")
        first = found[0]
        for robot in ("r1", "r2", "r3"):
            client.publish(PRIOR_EVIDENCE, explored(first, robot, 4))
        wait_for(lambda: len(list((tmp_path / "a").glob("*/*.evidence"))) == 3, "what was seen is kept")
        client.publish(PRIOR_REVISION, PriorRevision(environment="residential home", task="clean"))
        wait_for(lambda: found[-1].provenance.parent_digest, "a revised prior")
        revised = found[-1]
        assert revised.provenance.parent_digest == revised.provenance.root_digest == first.digest()
        assert revised.provenance.contributors == ["r1", "r2", "r3"]
        thing = unlikely(first)
        assert first.containment[0, thing] < 0.1 and revised.containment[0, thing] > 0.5
        found.clear()
        client.publish(TASK, task("r4", "clean"))
        wait_for(lambda: found, "the prior of a new robot")
        assert found[0].digest() == revised.digest()
        fleet.end("a")
        fleet.start("b", *library, f"archive={tmp_path / 'a'}")
        wait_for(lambda: alive(client, "b"), "its successor alive")
        found.clear()
        client.publish(TASK, task("r5", "clean"))
        wait_for(lambda: found, "the prior of a robot of another day")
        assert found[0].digest() == revised.digest()
        assert client.ask(PRIORS, question).priors[0].digest() == revised.digest()
    finally:
        for name in list(fleet.processes):
            fleet.end(name)


def test_a_missing_key_ends_the_start_with_one_sentence(endpoint, tmp_path):
    fleet = Fleet(endpoint, "http://127.0.0.1:1/v1", tmp_path)
    fleet.start("a", "key_env=NO_SUCH_KEY")
    assert fleet.processes["a"].wait(60) == 2
    assert "the environment variable NO_SUCH_KEY holds no key for openai" in fleet.log("a").splitlines()[-1]

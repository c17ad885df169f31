"""A supervisor exchanges a process when it is asked on the bus, and looks after the successor from then on."""

import contextlib
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import zenoh

from prior_sg.deploy.running import supervisor as supervisors
from prior_sg.deploy.running.supervisor import Child, Supervisor
from prior_sg.deploy.running.swaps import ROUTER, RouterHere, Swaps
from prior_sg.schemas.succession import SwapRequest
from prior_sg.services.runtime.bus import BusError
from prior_sg.services.runtime.client import BusClient, NobodyError
from prior_sg.services.runtime.endpoints import free_endpoint
from prior_sg.services.runtime.zenoh_bus import ZenohBus

STAYS = "import time; time.sleep(60)"
FAILS = "import sys; print('no such network'); sys.exit(2)"


def swapped(client, service, instance, request):
    """Ask for an exchange as soon as the router knows who answers, which it hears a moment after it is declared."""
    for _ in range(50):
        with contextlib.suppress(NobodyError):
            return client.swap(service, instance, request, 20.0)
        time.sleep(0.1)
    raise BusError("nobody has come")


class Stage:
    """A supervisor of a store that is a mere process, and whoever asks for its exchange."""

    def __init__(self, endpoint, folder, monkeypatch):
        self.program, self.heard, self.answers = STAYS, set(), []
        stage = self
        monkeypatch.setattr(Child, "start", lambda child: stage.begin(child))  # noqa: PLW0108 (a method of the child)
        self.supervisor = Supervisor(endpoint, "robot1", folder, ["segmenter.beta=2"])
        self.supervisor.hears = lambda unique: unique in self.heard
        self.bus, self.client = ZenohBus(endpoint), BusClient(ZenohBus(endpoint))
        self.swaps = Swaps(self.bus, self.supervisor, folder, None)
        self.supervisor.start("segmenter")
        self.first = self.supervisor.children[0]

    def begin(self, child):
        child.unique = f"{child.instance}-{len(self.heard)}{child.restarts}"
        with child.log_path.open("ab") as log:
            child.process = subprocess.Popen([sys.executable, "-c", self.program], stdout=log)
        child.started_s = time.monotonic()

    def ask(self, **changes):
        self.look()
        name = self.first.unique

        def wait():
            try:
                self.answers.append(swapped(self.client, "segmenter", name, SwapRequest(**changes)))
            except (BusError, zenoh.ZError) as error:  # also of a client that is being closed
                self.answers.append(error)

        threading.Thread(target=wait, daemon=True).start()

    def look(self):
        return [*self.swaps.check(), *self.supervisor.check()]

    def until(self, condition):
        end_s = time.monotonic() + 20.0
        while not condition():
            assert time.monotonic() < end_s, "did not happen"
            self.look()
            time.sleep(0.02)

    def close(self):
        for child in self.supervisor.children:
            child.kill()
            if child.process is not None:
                child.process.wait()
        self.client.bus.close()
        self.bus.close()


@pytest.fixture
def stage(endpoint, tmp_path, monkeypatch):
    monkeypatch.setattr(supervisors, "RESTART_DELAY_S", 0.05)
    found = Stage(endpoint, tmp_path, monkeypatch)
    yield found
    found.close()


def test_a_successor_is_adopted_once_the_former_has_ended(stage):
    stage.ask(settings=["segmenter.beta=3"], config="[segmenter]\nbeta = 1.0\n")
    stage.until(lambda: len(stage.supervisor.children) == 2)
    heir = stage.supervisor.children[1]
    assert heir.instance == "segmenter-2" and heir.succeeds == stage.first.unique
    given = " ".join(heir.arguments)
    assert given.endswith("--set segmenter.beta=2 --set segmenter.beta=3")
    config = heir.arguments[heir.arguments.index("--config") + 1]
    assert Path(config).read_text() == "[segmenter]\nbeta = 1.0\n"
    stage.look()
    assert not stage.answers and stage.first.runs
    stage.first.kill()
    stage.first.process.wait()
    stage.look()
    assert stage.first in stage.supervisor.children  # nobody has heard of the successor yet
    stage.heard.add(heir.unique)
    stage.until(lambda: stage.answers)
    assert stage.answers[0].successor == heir.unique and not stage.answers[0].error
    assert stage.supervisor.children == [heir] and not heir.succeeds
    heir.kill()
    heir.process.wait()
    stage.until(lambda: heir.restarts == 1)  # by itself, as any other


def test_where_the_successor_fails_the_former_stays_or_is_started_again(stage):
    stage.program = FAILS
    stage.ask()
    stage.until(lambda: stage.answers)
    assert "segmenter-1 stays: no such network" in stage.answers[0].error
    assert stage.supervisor.children == [stage.first] and stage.first.runs
    stage.ask()
    stage.until(lambda: len(stage.supervisor.children) == 2)
    stage.first.kill()
    stage.first.process.wait()
    stage.supervisor.children[1].process.wait()
    stage.program = STAYS
    stage.until(lambda: stage.first.restarts == 1 and stage.first.runs)
    assert stage.supervisor.children == [stage.first]


def test_what_cannot_be_exchanged_is_refused_in_a_sentence(stage):
    stage.ask(settings=["segmenter.bta=3"])
    stage.until(lambda: stage.answers)
    assert "bta" in stage.answers[0].error and stage.supervisor.children == [stage.first]
    stage.ask()
    stage.until(lambda: len(stage.supervisor.children) == 2)
    stage.ask()
    stage.until(lambda: len(stage.answers) == 2)
    assert "being exchanged already" in stage.answers[1].error
    with pytest.raises(BusError, match="nobody answers"):
        stage.client.swap("segmenter", "another", SwapRequest(), 2.0)


def test_a_router_is_started_again_in_its_place_and_everybody_comes_back(tmp_path):
    endpoint = free_endpoint("tcp/127.0.0.1:0")
    asked = []
    router = RouterHere(endpoint, lambda: asked.append(1))
    bus, client = ZenohBus(endpoint), BusClient(ZenohBus(endpoint))
    try:
        swaps = Swaps(bus, Supervisor(endpoint, "robot1", tmp_path), tmp_path, router)
        answers = []
        asking = threading.Thread(
            target=lambda: answers.append(swapped(client, ROUTER, ROUTER, SwapRequest())), daemon=True
        )
        asking.start()
        end_s = time.monotonic() + 20.0
        while len(asked) < 2:
            assert time.monotonic() < end_s
            swaps.check()
            time.sleep(0.02)
        asking.join(20.0)
        assert answers and answers[0].successor == ROUTER and len(asked) == 2
        while not (client.bus.connected() and bus.connected()):
            assert time.monotonic() < end_s
            time.sleep(0.02)
    finally:
        client.bus.close()
        bus.close()
        router.stop()

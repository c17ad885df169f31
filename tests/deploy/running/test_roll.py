"""A process that exists and is not heard is named, with what mends it."""

import os
import signal
import subprocess
import sys
import time

import pytest

from prior_sg.deploy.cli.live import _tell
from prior_sg.deploy.inspecting.health import Found, look
from prior_sg.deploy.running import roll as rolls
from prior_sg.deploy.running import supervisor as supervisors
from prior_sg.deploy.running.roll import Roll
from prior_sg.deploy.running.supervisor import Child, Supervisor
from prior_sg.schemas.status import Loss, PoolCount, ServiceStatus, TopicCount
from prior_sg.schemas.topics import WAITING, alive_key, lease_key
from prior_sg.services.runtime import client as clients
from prior_sg.services.runtime.bus import BusError
from prior_sg.services.runtime.client import BusClient
from prior_sg.services.runtime.endpoints import free_endpoint
from prior_sg.services.runtime.host.lease import standing
from prior_sg.services.runtime.zenoh_bus import ZenohBus

MUTE = """
import sys, time
from prior_sg.services.runtime.zenoh_bus import ZenohBus
bus = ZenohBus(sys.argv[1])
bus.announce(sys.argv[2])
time.sleep(60)
"""


@pytest.fixture
def child(endpoint, tmp_path, monkeypatch):
    monkeypatch.setattr(rolls, "HUNG_AFTER_S", 0.3)
    child = Child("maker", "maker-1", [], tmp_path / "log", 1, unique="maker-1-abc")
    child.process = subprocess.Popen([sys.executable, "-c", MUTE, endpoint, alive_key("maker", "maker-1-abc")])
    yield child
    child.kill()
    child.process.wait()


def until(condition, timeout_s=30.0):
    end_s = time.monotonic() + timeout_s
    while not (found := condition()):
        assert time.monotonic() < end_s, "did not happen"
        time.sleep(0.05)
    return found


def errors(client):
    return [entry["error"] for entry in look(client).silent]


def test_a_stopped_process_is_told_by_who_started_it_and_by_health_and_so_is_its_return(endpoint, child):
    with BusClient(ZenohBus(endpoint)) as starter, BusClient(ZenohBus(endpoint)) as anybody:
        roll = Roll(starter.bus)
        until(lambda: roll.check([child]) == ([], []) and anybody.on_the_roll())
        os.kill(child.pid, signal.SIGSTOP)
        events, hung = until(lambda: (found := roll.check([child]))[0] and found)
        assert hung == [child]
        assert events[0].startswith(f"maker-1 (pid {child.pid}) hangs") and f"kill -CONT {child.pid}" in events[0]
        assert roll.check([child]) == ([], [child])  # told once
        assert f"maker-1-abc (pid {child.pid}) exists on its host and is not heard" in str(errors(anybody))
        os.kill(child.pid, signal.SIGCONT)
        assert until(lambda: roll.check([child])[0]) == ["maker-1 is heard again"]
        child.kill()
        until(lambda: child.process.poll() is not None)
        assert roll.check([child]) == ([], []) and until(lambda: not anybody.on_the_roll())


ROUTER = """
import sys, time
from prior_sg.services.runtime.zenoh_router import open_router
stop = open_router(sys.argv[1])
time.sleep(60)
"""


def test_a_router_that_does_not_answer_is_not_one_on_which_nobody_is(monkeypatch):
    monkeypatch.setattr(clients, "ALIVE_TIMEOUT_S", 0.2)
    address = free_endpoint("tcp/127.0.0.1:7447")
    router = subprocess.Popen([sys.executable, "-c", ROUTER, address])
    try:
        with BusClient(ZenohBus(address)) as anybody:
            assert anybody.standings() == [] and look(anybody).remarks == []
            os.kill(router.pid, signal.SIGSTOP)
            os.waitpid(router.pid, os.WUNTRACED)  # until then some of its threads may go on
            with pytest.raises(BusError, match=r"has not said within 0.2 s who is there"):
                anybody.standings()
            found = look(anybody)
            assert not found.well and "has not said within 0.2 s" in str(found.remarks)
            assert "has not said" in str(found.plain())
    finally:
        router.kill()
        router.wait()


def status(**changes):
    fields = {"service": "maker", "instance": "m1", "robot": "r", "pid": 7, "uptime_s": 1.0, "backlog": 3}
    fields |= {"busy_share": 0.0, "step_ms_p50": 0.0, "step_ms_p99": 0.0, "resident_mb": 1.0, "waiting_for": []}
    return ServiceStatus(**(fields | {"topics": []} | changes))


def pool(waiting, workers):
    return PoolCount(topic="ENCODE", waiting=waiting, running=0, oldest_wait_s=12.0, workers=workers)


def count(**counts):
    return TopicCount(topic="KEYFRAME", **counts)


def loss(number):
    return Loss(what="frames refused", reason="dark", count=number, example="frame 1: dark")


def standings(*tokens):
    return [standing(lease_key("r", "maker", *token)) for token in tokens]


@pytest.mark.parametrize(
    ("found", "well", "said"),
    [
        (Found(), False, ""),
        (Found([status()]), True, ""),
        (Found([status(step_s=29.0)]), True, ""),
        (Found([status(step_s=59.0, step_compiling_s=29.5)]), True, ""),
        (
            Found([status(step_s=59.0, step_compiling_s=31.0)]),
            True,
            "m1 has compiled inner loops for 31 s, as a first run does, and 3 inputs wait: it goes on by itself",
        ),
        (
            Found([status(step_s=60.0, step_compiling_s=25.0)]),
            False,
            "m1 (pid 7) has been at one input for 35 s, 3 wait: if that goes on, `kill",
        ),
        (
            Found([status(step_s=45.0)]),
            False,
            "m1 (pid 7) has been at one input for 45 s, 3 wait: if that goes on, `kill",
        ),
        (Found([status()], [{"error": "x"}]), False, ""),
        (Found([status()], [], standings(("5", "a"))), True, ""),
        (Found([status()], [], standings(("5", "a"), (WAITING, "b"))), True, "b waits: a is in charge of maker of r"),
        (Found([status()], [], standings((WAITING, "b"))), False, "nobody is in charge of maker of r: b takes over"),
        (Found([status()], [], standings(("5", "a"), ("6", "b"))), False, "a and b are in charge of maker of r"),
        (Found([status(oldest_wait_s=9.0)]), True, ""),
        (Found([status(oldest_wait_s=11.0)]), False, "m1 is behind: 3 inputs wait, the oldest for 11 s"),
        (
            Found([status(pools=[pool(4, {})])]),
            False,
            "4 keyframes of r wait for a worker, the oldest for 12 s, and none",
        ),
        (Found([status(pools=[pool(4, {"a": 0, "b": 2})])]), False, "4 keyframes of r wait for 2 workers, the oldest"),
        (Found([status(pools=[pool(0, {})])]), True, ""),
        (Found([status(figures={"disk_free_bytes": 3e8})]), True, ""),
        (Found([status(figures={"disk_free_bytes": 1e8})]), False, "m1 (pid 7) has 100 MB left for its database"),
        (Found([status(topics=[count(missed=5)])]), True, ""),
        (Found([status(topics=[count(missed=5)])], before={"m1": status(topics=[count(missed=5)])}), True, ""),
        (
            Found([status(topics=[count(missed=5)])], before={"m1": status(topics=[count(missed=2)])}),
            False,
            "m1 loses what it gets now: 3 more KEYFRAME missed",
        ),
        (
            Found([status(topics=[count(malformed=2)])], before={"m1": status()}),
            False,
            "m1 loses what it gets now: 2 more KEYFRAME malformed; its log names the writer",
        ),
        (
            Found([status(losses=[loss(3)])], before={"m1": status(losses=[loss(2)])}),
            False,
            "m1 loses what it gets now: 1 more frames refused (dark); `prior-sg check SOURCE`",
        ),
    ],
)
def test_what_is_wrong_is_said_and_decides_whether_all_is_well(found, well, said):
    assert found.well is well
    told = " ".join(remark.text for remark in found.remarks)
    assert told.startswith(said) and bool(told) is bool(said)


def test_what_hangs_is_ended_and_started_again_only_where_that_is_wished(endpoint, child, tmp_path, monkeypatch):
    monkeypatch.setattr(Child, "start", lambda again: setattr(again, "process", subprocess.Popen(["sleep", "60"])))
    monkeypatch.setattr(supervisors, "RESTART_DELAY_S", 0.0)
    supervisor = Supervisor(endpoint, "robot1", tmp_path, children=[child])
    with BusClient(ZenohBus(endpoint)) as starter:
        roll, pid = Roll(starter.bus), child.pid
        until(lambda: roll.check([child]) == ([], []) and child.unique in roll._met)
        os.kill(pid, signal.SIGSTOP)
        until(lambda: roll.check([child])[1])
        for _ in range(3):
            _tell(supervisor, roll, restart_hung=False)
        assert child.pid == pid and child.process.poll() is None
        until(lambda: _tell(supervisor, roll, restart_hung=True) or child.pid not in (0, pid))
        assert child.restarts == 1

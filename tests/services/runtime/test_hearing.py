"""A process that is connected and hears nothing ends, and one that hears, or has no router, does not."""

import ctypes
import resource
import signal
import subprocess
import sys
import threading
import time
from contextlib import closing, contextmanager
from pathlib import Path

import psutil
import pytest

from prior_sg.schemas.topics import alive_key
from prior_sg.services.runtime.bus import BusError
from prior_sg.services.runtime.endpoints import free_endpoint
from prior_sg.services.runtime.hearing import EXIT_DEAF, NOBODY_KEY, watch_hearing
from prior_sg.services.runtime.zenoh_bus import ZenohBus

ROUTER = """
import sys, time
from prior_sg.services.runtime.zenoh_router import open_router
stop = open_router(sys.argv[1])
print("stands", flush=True)
time.sleep(300)
"""
SERVICE = """
import sys
from functools import partial
from prior_sg.services.runtime import hearing, zenoh_bus
zenoh_bus.watch_hearing = partial(hearing.watch_hearing, ask_every_s=0.5, deaf_after_s=8.0)
from prior_sg.deploy.running.serve import main
sys.exit(main())
"""
COMMAND = """
import ctypes, signal, sys
from functools import partial
from prior_sg.services.runtime import hearing, zenoh_bus
zenoh_bus.watch_hearing = partial(hearing.watch_hearing, ask_every_s=0.5, deaf_after_s=8.0)
libc = ctypes.CDLL(None)
libc.signal(signal.SIGUSR2, ctypes.cast(libc.pause, ctypes.c_void_p))  # a thread that gets it does nothing any more
from prior_sg.deploy.cli.main import main
sys.exit(main(sys.argv[1:]))
"""
MARGIN_B = 2 << 20  # less than a thread's stack takes


class Router:
    """As a bus sees it: `answers` and `stands` are set from outside."""

    def __init__(self, answers, stands=True):
        self.answers, self.stands = answers, stands

    def announced(self, pattern, timeout_s):
        if not self.answers:
            raise BusError("no answer")
        return set()

    def connected(self):
        return self.stands


def deaf_within(router, seconds, deaf_after_s=0.2):
    """Whether, and how often, it is called deaf."""
    calls = []
    end = watch_hearing(router, lambda: calls.append(1), ask_every_s=0.01, deaf_after_s=deaf_after_s, look_every_s=0.05)
    time.sleep(seconds)
    end()
    return len(calls)


def test_only_a_bus_that_is_connected_and_never_answers_is_deaf():
    assert deaf_within(Router(answers=True), 0.6) == 0
    assert deaf_within(Router(answers=False, stands=False), 0.6) == 0
    assert deaf_within(Router(answers=False), 1.5) == 1  # once


def test_a_question_that_never_ends_hides_nothing():
    router, asked = Router(answers=True), threading.Event()
    router.announced = lambda pattern, timeout_s: asked.wait(5.0)
    assert deaf_within(router, 1.5) == 1
    asked.set()


@contextmanager
def running(script, *arguments):
    process = subprocess.Popen([sys.executable, "-c", script, *arguments], stdout=subprocess.PIPE, text=True)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="limits of another process")
def test_a_service_that_joined_a_router_again_without_memory_for_a_thread_ends_to_be_started_again(tmp_path):
    address = free_endpoint("tcp/127.0.0.1:0")
    arguments = ("scene_store", "--connect", address, "--set", f"scene_store.path={tmp_path / 'scenes.sqlite'}")
    with running(SERVICE, *arguments) as service:
        with running(ROUTER, address) as router:
            assert router.stdout.readline() == "stands\n"
            with closing(ZenohBus(address)) as bus:
                while not bus.announced(alive_key("scene_store", "*"), 2.0):
                    assert service.poll() is None
                    time.sleep(0.1)
            limit_b = psutil.Process(service.pid).memory_info().vms + MARGIN_B
            resource.prlimit(service.pid, resource.RLIMIT_AS, (limit_b, resource.RLIM_INFINITY))
        with running(ROUTER, address) as router:
            assert router.stdout.readline() == "stands\n"
            time.sleep(4.0)
            resource.prlimit(service.pid, resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
            assert service.wait(40.0) == EXIT_DEAF


def wait_for_router(process, address):
    """Until it has been asked and has answered."""
    end_s = time.monotonic() + 60.0
    while True:
        try:
            with closing(ZenohBus(address, 0.1)) as bus:
                if bus.announced(NOBODY_KEY, 2.0) == set():
                    return
        except BusError:
            assert process.poll() is None and time.monotonic() < end_s
            time.sleep(0.1)


def stop_receiving(pid):
    """What takes in what comes to the process does nothing any more, as if it had died."""
    tasks = [(task, (task / "comm").read_text()) for task in Path(f"/proc/{pid}/task").iterdir()]
    receivers = [int(task.name) for task, name in tasks if name.startswith("rx-")]
    assert receivers
    for receiver in receivers:
        assert ctypes.CDLL(None).tgkill(pid, receiver, signal.SIGUSR2) == 0


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="threads of another process")
@pytest.mark.parametrize("command", [["router"], ["up", "scene_store"]])
def test_a_process_whose_router_hears_nothing_ends_to_be_started_again(command, tmp_path):
    address = free_endpoint("tcp/127.0.0.1:0")
    folder = ["--out", str(tmp_path)] if command[0] == "up" else []
    with running(COMMAND, *command, "--connect", address, *folder) as process:
        wait_for_router(process, address)
        children = psutil.Process(process.pid).children()
        while command[0] == "up" and not children:
            time.sleep(0.1)
            children = psutil.Process(process.pid).children()
        stop_receiving(process.pid)
        assert process.wait(60.0) == EXIT_DEAF
        assert not psutil.wait_procs(children, 20.0)[1]


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="limits of another process")
def test_a_router_that_lacks_memory_when_its_first_client_joins_hears_it():
    """Its threads are there from the start."""
    address = free_endpoint("tcp/127.0.0.1:0")
    with running(COMMAND, "router", "--connect", address) as process:
        assert "Ctrl-C stops" in process.stdout.readline()
        limit_b = psutil.Process(process.pid).memory_info().vms + MARGIN_B
        resource.prlimit(process.pid, resource.RLIMIT_AS, (limit_b, resource.RLIM_INFINITY))
        with closing(ZenohBus(address)) as bus:
            assert bus.announced(NOBODY_KEY, 5.0) == set()

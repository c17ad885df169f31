"""What checks containers and units: `health --here`, what systemd is told, and the status `up` ends with."""

import asyncio
import contextlib
import os
import signal
import socket
import subprocess
import sys
import threading
import time

import pytest

from prior_sg.deploy.cli.main import main
from prior_sg.deploy.keys.access import access_control
from prior_sg.deploy.keys.authority import Authority
from prior_sg.deploy.running.here import FOLDER, noted, processes_here
from prior_sg.deploy.running.notify import Watchdog
from prior_sg.deploy.running.serve import EXIT_HOPELESS
from prior_sg.services.folders import temporary_cache
from prior_sg.services.registry import BY_NAME
from prior_sg.services.runtime.endpoints import free_endpoint
from prior_sg.services.runtime.host.host import Host
from prior_sg.services.runtime.keys import VARIABLE, Beyond, read_bundle
from prior_sg.services.runtime.service import Identity
from prior_sg.services.runtime.zenoh_bus import ZenohBus
from prior_sg.services.runtime.zenoh_router import open_router

PROGRAM = [sys.executable, "-m", "prior_sg.deploy.cli.main"]


@pytest.fixture
def own_folder(tmp_path, monkeypatch):
    """A temporary folder with nobody else's processes, as a container has."""
    (tmp_path / "tmp").mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "tmp"))
    monkeypatch.setattr("tempfile.tempdir", None)


def until(condition, timeout_s=90.0):
    end_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end_s, "did not happen"
        time.sleep(0.1)


@contextlib.contextmanager
def serving(connect, instance):
    """A gateway on a thread of its own, at a router."""
    service, loop = BY_NAME["prior_gateway"], asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever, daemon=True)
    thread.start()

    async def begin():
        bus = await asyncio.to_thread(ZenohBus, connect)
        host = Host(service, bus, service.config(archive=""), Identity("*", instance, time.time_ns()))
        return host, asyncio.ensure_future(host.run())

    host, task = asyncio.run_coroutine_threadsafe(begin(), loop).result(60)
    try:
        yield
    finally:
        loop.call_soon_threadsafe(host.stop)
        asyncio.run_coroutine_threadsafe(asyncio.wait([task]), loop).result(60)
        loop.call_soon_threadsafe(loop.stop)
        thread.join()
        loop.close()


def test_a_process_is_found_for_as_long_as_it_runs(own_folder):
    with noted("store-1"):
        assert processes_here() == {"store-1": os.getpid()}
    assert processes_here() == {}


def test_notes_of_processes_that_were_killed_are_removed(own_folder):
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    folder = temporary_cache(FOLDER)
    (folder / "killed").write_text(str(ended.pid))
    (folder / "another").write_text(str(os.getpid()))
    os.utime(folder / "another", (1, 1))  # written before the process of that number began
    (folder / "torn").write_text("no number")
    assert processes_here() == {}
    assert list(folder.iterdir()) == []


def test_health_here_is_of_this_host_alone_by_the_router_of_an_edge(own_folder, tmp_path, monkeypatch, capsys):
    """As pods do: the service and what checks it come by TLS with the edge's own keys, which access control lets in."""
    authority = Authority.create(tmp_path / "keys")
    authority.add("edge", "edge1")
    monkeypatch.setenv(VARIABLE, str(authority.bundle("edge1")))
    bundle, tls = read_bundle(authority.bundle("edge1")), free_endpoint("tls/127.0.0.1:0")
    access = access_control(bundle.about.participants, ["lo"])
    stop = open_router(free_endpoint("tcp/127.0.0.1:0"), Beyond(bundle=bundle, access=access, listen=(tls,)))

    def health(*words):
        status = main(["health", *words, "--connect", tls])
        return status, " ".join("".join(capsys.readouterr()).split())

    try:
        assert health("--router")[0] == 0
        status, said = health("--here")
        assert status == 1 and "no service is running" in said
        with noted("it"), serving(tls, "it"), serving(tls, "of another host"):
            until(lambda: health("--here")[0] == 0)
            said = health("--here")[1]
            assert "it pid" in said and "of another host" not in said
            with noted("elsewhere"):
                status, said = health("--here")
            assert status == 1 and "elsewhere" in said and "is not heard" in said
    finally:
        stop()


def test_systemd_is_told_once_that_all_is_ready_and_then_that_it_lives(tmp_path, monkeypatch):
    Watchdog().alive()  # nobody is there to be told
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as end:
        end.bind(str(tmp_path / "notify"))
        end.settimeout(5)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        watchdog = Watchdog()
        watchdog.alive()
        assert end.recv(100) == b"READY=1"
        watchdog.alive()  # too soon
        monkeypatch.setattr("prior_sg.deploy.running.notify.EVERY_S", 0.0)
        watchdog.alive()
        assert end.recv(100) == b"WATCHDOG=1"


@pytest.mark.parametrize("setting", ["archive=", "trusted_keys=/nowhere/at/all"])
def test_up_is_ready_when_services_are_started_and_ends_for_good_where_one_cannot(own_folder, tmp_path, setting):
    connect = free_endpoint("tcp/127.0.0.1:0")
    words = ["up", "prior_gateway", "--connect", connect, "--set", f"prior_gateway.{setting}", "--out"]
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as end:
        end.bind(str(tmp_path / "notify"))
        end.settimeout(90)
        environment = os.environ | {"NOTIFY_SOCKET": str(tmp_path / "notify")}
        up = subprocess.Popen([*PROGRAM, *words, str(tmp_path / "out")], env=environment)
        try:
            assert end.recv(100) == b"READY=1"
            if setting == "archive=":
                until(processes_here)
                up.send_signal(signal.SIGTERM)
            assert up.wait(90) == (0 if setting == "archive=" else EXIT_HOPELESS)
        finally:
            if up.poll() is None:
                up.kill()
                up.wait()

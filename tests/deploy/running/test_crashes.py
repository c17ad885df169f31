"""How services died is written down, without secrets, within bounds, and named to whoever looks."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import msgspec
import pytest

from prior_sg.deploy.cli.main import main
from prior_sg.deploy.inspecting.doctor.here import _crashes
from prior_sg.deploy.running.crashes import MOST_CHARACTERS, MOST_REPORTS, crashes, report, sentence, watched
from prior_sg.deploy.running.supervisor import Supervisor
from prior_sg.services.runtime.service import Identity
from tests.help.telling import passage

WHO = Identity("ada", "maker-1-abc", 1)
SEGFAULT = """
import ctypes, sys
from prior_sg.deploy.running.crashes import watched
with watched(sys.argv[1], "maker-1-abc"):
    ctypes.string_at(0)
"""
FAILS = """
import asyncio, sys
from dataclasses import replace
from prior_sg.deploy.running import serve
from prior_sg.services.scene_store import service as store
def step(state, message, cfg):
    raise RuntimeError("cannot go on, see postgresql://joe:hunter2@host/db")
    yield
store.SERVICE = replace(store.SERVICE, step=step)
sys.argv[0] = "serve"
sys.exit(serve.main())
"""


class Settings(msgspec.Struct):
    api_key: str = "sk-1234567890"
    max_tokens: int = 5
    url: str = "http://joe:hunter2@host/v1"
    inner: dict = msgspec.field(default_factory=lambda: {"password": "letmein", "empty_token": ""})


def failed(text="no " * 100):
    try:
        raise ValueError(text)
    except ValueError as error:
        return error


def test_a_report_says_what_happened_without_secrets(tmp_path):
    path = report(
        str(tmp_path), "maker", WHO, failed("bad ftp://a:b@c"), Settings(), [passage("KEYFRAME", 1, frame_id=7)]
    )
    told = json.loads(Path(path).read_text())
    assert told["error"] == "ValueError: bad ftp://c" and "test_crashes.py" in told["traceback"]
    assert told["config"]["max_tokens"] == 5 and told["config"]["url"] == "http://host/v1"
    assert told["last_inputs"][0]["frame_id"] == 7 and told["versions"]["python"] == sys.version.split()[0]
    text = json.dumps(told)
    assert not [secret for secret in ("sk-1234", "hunter2", "letmein", "a:b@") if secret in text]
    now_s = time.time()
    (one,) = crashes(tmp_path, now_s)
    assert sentence(one, now_s).startswith("maker-1-abc died 0 s ago: ValueError: bad ftp://c (report: ")
    (finding,) = _crashes(tmp_path, now_s)
    assert finding.topic == "crashes" and path in finding.text and finding.mend == f"rm -r {tmp_path}"
    assert crashes(tmp_path, now_s + 90_000) == []


def test_reports_are_few_and_short(tmp_path):
    began_s = time.time() - 1000.0
    for number in range(MOST_REPORTS + 5):
        path = report(str(tmp_path), "maker", Identity("ada", f"m{number}", 1), failed("x" * 10**6), Settings(), [])
        os.utime(path, (began_s + number,) * 2)
    kept = list(tmp_path.iterdir())
    assert len(kept) == MOST_REPORTS and not (tmp_path / "m0.json").exists() and (tmp_path / "m24.json").exists()
    assert max(path.stat().st_size for path in kept) < 2 * MOST_CHARACTERS
    (tmp_path / "killed.4194399.fault").touch()  # of a process that is gone
    with watched(str(tmp_path), "m"):
        assert not (tmp_path / "killed.4194399.fault").exists()
        assert crashes(tmp_path / "nowhere", 0.0) == []
    assert not list(tmp_path.glob("*.fault"))


def test_nothing_is_written_where_nothing_can_be(tmp_path):
    (tmp_path / "file").touch()
    assert report(str(tmp_path / "file"), "maker", WHO, failed(), Settings(), []) == ""
    assert report("", "maker", WHO, failed(), Settings(), []) == ""
    with watched(str(tmp_path / "file"), "m"):
        pass


def test_a_segmentation_fault_leaves_where_its_threads_were(tmp_path):
    died = subprocess.run(
        [sys.executable, "-c", SEGFAULT, str(tmp_path)], check=False, capture_output=True, timeout=120
    )
    assert died.returncode == -signal.SIGSEGV
    (one,) = crashes(tmp_path, time.time())
    assert (one.instance, one.error) == ("maker-1-abc", "Fatal Python error: Segmentation fault")
    assert "ctypes" in Path(one.path).read_text()


@pytest.fixture
def died(endpoint, tmp_path):
    """A service of `up` that has failed in its first step, and what was said of it."""
    supervisor = Supervisor(endpoint, "ada", tmp_path / "logs", [f"scene_store.path={tmp_path / 'scene.sqlite'}"])
    supervisor.start("scene_store")
    (child,) = supervisor.children
    child.kill()
    child.process.wait()
    command = [sys.executable, "-c", FAILS, *child.arguments]
    command[3:3] = ["scene_store"]
    with child.log_path.open("wb") as log:
        child.process = subprocess.Popen([*command, "--instance", child.unique], stderr=log)
    try:
        child.process.wait(120)
        (event,) = supervisor.check()
        yield event
    finally:
        supervisor.stop()


def test_up_and_health_name_the_report_of_a_service_that_died(died, endpoint, tmp_path, capsys):
    (path,) = (tmp_path / "crashes").glob("*.json")
    assert died.endswith(f"; report: {path}; restarting") and "cannot go on" in died
    told = json.loads(path.read_text())
    assert told["service"] == "scene_store" and "hunter2" not in path.read_text()
    assert told["last_inputs"][-1]["topic"] == "Tick" and "cannot go on" in told["last_inputs"][-1]["fault"]
    main(["health", "--connect", endpoint, "--out", str(tmp_path), "--seconds", "0"])
    assert str(path) in capsys.readouterr().out.replace("\n", "")

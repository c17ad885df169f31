"""A log that grows without end does not fill the disk."""

import subprocess
import sys

from prior_sg.deploy.running import logfiles, supervisor
from prior_sg.deploy.running.logfiles import ASIDE, bound
from prior_sg.deploy.running.supervisor import Child, Supervisor

WRITER = """
import sys
for line in sys.stdin:
    print(line * 100, end="", file=sys.stderr, flush=True)
    print("written", flush=True)
"""


def test_what_is_full_is_put_aside_and_its_writer_goes_on(tmp_path):
    log_path = tmp_path / "segmenter-1.log"

    def say(text):
        process.stdin.write(text + "\n")
        process.stdin.flush()
        assert process.stdout.readline() == "written\n"

    with (
        log_path.open("ab") as log,
        subprocess.Popen(
            [sys.executable, "-c", WRITER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, text=True
        ) as process,
    ):
        say("first")
        assert not bound(log_path, 1000)
        assert bound(log_path, 500)
        say("second")
        aside = log_path.with_name(log_path.name + ASIDE)
        assert aside.read_text() == "first\n" * 100
        assert log_path.read_text() == "second\n" * 100  # from its beginning, no hole before it
        assert bound(log_path, 500)
        assert aside.read_text() == "second\n" * 100
        process.stdin.close()


def test_a_log_that_is_not_there_is_no_reason_to_end(tmp_path):
    assert not bound(tmp_path / "none.log", 0)


def test_the_supervisor_looks_at_the_logs_of_its_children(tmp_path, monkeypatch):
    monkeypatch.setattr(supervisor, "bound", lambda log_path: logfiles.bound(log_path, 10))
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        child = Child("segmenter", "segmenter-1", [], tmp_path / "segmenter-1.log", 1, process=process)
        child.log_path.write_text("x" * 100)
        assert Supervisor("tcp/127.0.0.1:1", "robot1", tmp_path, children=[child]).check() == []
        assert child.log_path.read_text() == ""
        process.communicate(b"\n")

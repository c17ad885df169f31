"""Odd places and times to start: limits, signals, folders and arguments."""

import contextlib
import errno
import os
import resource
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

import prior_sg
from prior_sg.deploy import interrupts
from prior_sg.deploy.cli.faults import sentence_of
from prior_sg.deploy.cli.main import main
from prior_sg.deploy.running import job
from prior_sg.deploy.running.job import RunError, claimed_folder
from prior_sg.deploy.running.supervisor import Child, ChildFailed, Supervisor
from prior_sg.deploy.sample import SAMPLE
from prior_sg.services.runtime.client import BusClient
from prior_sg.services.runtime.endpoints import free_endpoint
from prior_sg.services.runtime.zenoh_bus import ZenohBus
from prior_sg.services.runtime.zenoh_router import open_free_router

COMMAND = [sys.executable, "-m", "prior_sg.deploy.cli.main"]
ENVIRONMENT = os.environ | {"PYTHONPATH": str(Path(prior_sg.__file__).parents[1])}


BEGUN = "import sys; from prior_sg.deploy.cli.main import main; print('begun', flush=True); sys.exit(main())"


def begun(*arguments):
    """A command that has got as far as our own code: what the interpreter says before that is not ours."""
    process = subprocess.Popen(
        [sys.executable, "-c", BEGUN, *arguments],
        env=ENVIRONMENT,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    assert process.stdout.readline() == "begun\n"
    return process


def started(*arguments, **options):
    return subprocess.Popen(
        [*COMMAND, *arguments], env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, **options
    )


def test_a_folder_is_one_runs_at_a_time(tmp_path):
    out = tmp_path / "out"
    with claimed_folder(out), pytest.raises(RunError, match="another run is writing to"), claimed_folder(out):
        pass
    with claimed_folder(tmp_path / "out"):
        assert list((tmp_path / "out").iterdir()) == []


RUN = ("run", str(SAMPLE), "--environment", "residential home", "--task", "tidy up", "--out", "{out}")
BENCH = ("bench", "segmenter")
EVAL = ("eval", "world:station:0,1", "--encoder", "sim:0.5", "--jobs", "2", "--out", "{out}")


@pytest.mark.parametrize(
    ("command", "delay_s"),
    [
        (("up", "scene_store", "--out", "{out}"), 0.3),
        (("up", "scene_store", "--out", "{out}"), 1.5),
        (RUN, 0.5),
        (RUN, 1.5),
        (RUN, 3.0),
        (("check", str(SAMPLE)), 0.5),
        (BENCH, 1.5),
        (EVAL, 1.5),
    ],
    ids=lambda value: value[0] if isinstance(value, tuple) else str(value),
)
def test_an_interrupt_at_any_moment_is_told_in_a_line(tmp_path, command, delay_s):
    where = ("--connect", free_endpoint("tcp/127.0.0.1:0")) if command[0] in ("up", "run") else ()
    process = begun(*(word.format(out=tmp_path) for word in command), *where)
    time.sleep(delay_s)
    process.send_signal(signal.SIGINT)
    said, _ = process.communicate(timeout=120)
    assert "Traceback" not in said
    assert process.returncode in ((0, 130, -signal.SIGINT) if command[0] == "up" else (130, -signal.SIGINT))


def test_a_second_interrupt_ends_processes_that_do_not_end_by_themselves(tmp_path):
    supervisor = Supervisor("tcp/127.0.0.1:1", "ada", tmp_path)
    for number in range(2):
        child = Child("segmenter", f"segmenter-{number}", [], tmp_path / "log", 1)
        child.process = subprocess.Popen(["/bin/sh", "-c", "trap '' TERM; echo; while :; do sleep 1; done"], stdout=-1)
        assert child.process.stdout.readline() == b"\n"  # it will not hear SIGTERM
        supervisor.children.append(child)
    threading.Timer(0.2, signal.raise_signal, (signal.SIGINT,)).start()
    with interrupts.remembered(), pytest.raises(KeyboardInterrupt):
        supervisor.stop()
    for child in supervisor.children:
        assert child.process.wait(20) == -signal.SIGKILL


def test_an_interrupt_that_an_import_swallowed_still_ends_the_run():
    stopping = threading.Event()
    with interrupts.remembered():
        with contextlib.suppress(BaseException):  # as some libraries do while they are imported
            signal.raise_signal(signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            interrupts.insist()
        with job._interrupt_sets(stopping):
            assert stopping.is_set()
    assert not interrupts.came()  # by what this process does next


class Interrupted:
    """Ctrl-C comes while it is finalized."""

    def __del__(self):
        signal.raise_signal(signal.SIGINT)


def test_an_interrupt_that_a_finalizer_swallowed_comes_again(capfd):
    with interrupts.remembered(), pytest.raises(KeyboardInterrupt):
        thing = Interrupted()
        del thing
        time.sleep(20)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(
    ("limit", "value", "said"),
    [(resource.RLIMIT_NOFILE, 24, "ulimit -n"), (resource.RLIMIT_AS, 1_000_000 * 1024, "ulimit -v")],
)
def test_a_limit_that_is_too_low_is_named(tmp_path, limit, value, said):
    process = started(
        *("up", "scene_store", "--out", str(tmp_path), "--connect", free_endpoint("tcp/127.0.0.1:0")),
        preexec_fn=lambda: resource.setrlimit(limit, (value, value)),
    )
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 1
    assert output.startswith("prior-sg: ") and output.count("\n") == 1 and said in output


def test_an_argument_that_is_no_text_is_one_sentence(tmp_path, capsys):
    assert main(["up", "--out", str(tmp_path / "o\udcff")]) == 2
    assert "\\udcff' is not valid UTF-8" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (OSError(errno.ENOSPC, "No space left on device", "/data/x"), "no space left for /data/x"),
        (OSError(errno.EROFS, "Read-only file system", "/data/x"), "/data/x"),
        (OSError(errno.EMFILE, "Too many open files"), "ulimit -n"),
        (BlockingIOError(errno.EAGAIN, "Resource temporarily unavailable"), "no more processes"),
        (OSError(errno.ENAMETOOLONG, "File name too long", "x" * 9), "too long"),
        (FileNotFoundError(errno.ENOENT, "No usable temporary directory found in ['/tmp']"), "TMPDIR"),
        (MemoryError(), "not enough memory"),
        (RuntimeError("can't start new thread"), "no more threads"),
    ],
)
def test_faults_of_the_system_are_one_sentence(error, said):
    assert said in sentence_of(error)
    assert "\n" not in sentence_of(error)


def test_faults_of_the_program_keep_their_traceback():
    assert sentence_of(RuntimeError("bad")) is None and sentence_of(KeyError("x")) is None


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("", "(empty log)"),
        ("Fatal Python error", "Fatal Python error"),
        ('{"level": "error"}', '{"level": "error"}'),
        ("[1]", "[1]"),
        ("3", "3"),
        ('{"event": "no disk"}', "no disk"),
    ],
)
def test_last_words_are_any_line(tmp_path, line, said):
    log = tmp_path / "x.log"
    log.write_text(line)
    assert Child("segmenter", "segmenter-1", [], log, 1).last_words() == said
    log.unlink()
    assert "no log" in Child("segmenter", "segmenter-1", [], log, 1).last_words()


def test_a_service_ended_by_a_signal_is_told_by_its_name(tmp_path):
    supervisor = Supervisor("tcp/127.0.0.1:1", "ada", tmp_path)
    child = Child("segmenter", "segmenter-1", [], tmp_path / "segmenter-1.log", 1)
    supervisor.children.append(child)
    for number, said in ((signal.SIGSEGV, "SIGSEGV"), (signal.SIGKILL, "too little memory"), (40, "signal 40")):
        child.process = subprocess.Popen(["/bin/sh", "-c", f"kill -{int(number)} $$"])
        child.process.wait()
        (event,) = supervisor.check()
        assert said in event
    child.deaths = 9
    child.process = subprocess.Popen(["/bin/sh", "-c", "kill -11 $$"])
    child.process.wait()
    child.started_s = time.monotonic()
    with pytest.raises(ChildFailed, match="ended by signal SIGSEGV"):
        supervisor.check()


def test_a_prepared_service_waits_until_it_is_started_and_ends_with_whom_it_waits_for(tmp_path):
    """It has loaded everything by then; what is prepared and never started leaves nothing behind."""
    endpoint, stop_router = open_free_router("tcp/127.0.0.1:0")
    supervisor = Supervisor(endpoint, "r", tmp_path / "logs")
    try:
        supervisor.prepare("prior_gateway")
        [child] = supervisor.children
        with BusClient(ZenohBus(endpoint)) as client:
            time.sleep(4.0)
            assert child.runs and supervisor.check() == [] and "prior_gateway" not in client.alive(0.5).values()
            supervisor.start("prior_gateway")
            assert supervisor.children == [child] and not child.held
            end_s = time.monotonic() + 30
            while "prior_gateway" not in client.alive(0.5).values():
                assert time.monotonic() < end_s and child.runs, child.last_words()
        supervisor.prepare("scene_store")
        waiting = supervisor.children[-1].process
        waiting.stdin.close()  # as when the supervisor has died
        assert waiting.wait(30) == 0
    finally:
        supervisor.stop()
        stop_router()


def test_an_interrupt_that_python_has_wrapped_is_told_as_one(monkeypatch, capsys):
    def wrapped(argv):
        try:
            interrupts.interrupt(signal.SIGINT, None)
        except KeyboardInterrupt as error:
            raise RuntimeError("Error calling __set_name__ on 'field' instance 'graph' in 'PlaceMap'") from error

    monkeypatch.setattr("prior_sg.deploy.cli.main._run", wrapped)
    assert main(["check"]) == interrupts.EXIT_INTERRUPTED
    assert capsys.readouterr().err == "prior-sg: interrupted\n"

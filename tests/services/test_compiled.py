"""Compiled code where little or nothing can be written."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from prior_sg.services import compiled

ONE_LOOP = """
from prior_sg.services.compiled import compiled

@compiled()
def twice(x):
    return 2 * x

print(twice(21))
"""


@pytest.fixture
def program(tmp_path):
    """A module whose folder cannot be written, for root neither: a file stands where its cache would be."""
    folder = tmp_path / "code"
    folder.mkdir()
    (folder / "loop.py").write_text(ONE_LOOP)
    (folder / "__pycache__").write_text("")
    return folder / "loop.py"


def run(program, **variables):
    environment = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    source = str(Path(compiled.__file__).parents[2])
    environment |= {
        "PYTHONPATH": source,
        "PYTHONDONTWRITEBYTECODE": "1",
        "HOME": "/proc/1",
        "XDG_CACHE_HOME": "/proc/1",
    }
    return subprocess.run(
        [sys.executable, str(program)],
        check=False,
        env=environment | variables,
        capture_output=True,
        text=True,
        timeout=120,
    )


def test_without_any_cache_it_is_kept_in_a_temporary_folder_and_said_once(program, tmp_path):
    done = run(program, TMPDIR=str(tmp_path))
    assert done.stdout == "42\n"
    folder = tmp_path / f"prior-sg-{os.getuid()}" / "compiled"
    assert list(folder.rglob("*.nbi")), "nothing was kept"
    assert done.stderr.count("\n") == 1 and str(folder) in done.stderr and "NUMBA_CACHE_DIR" in done.stderr


def test_the_time_that_it_takes_is_known_with_a_cache_and_without(program, tmp_path):
    seconds = "\nfrom prior_sg.services.compiling import CLOCK\nprint(CLOCK.seconds() > 0.01)\n"
    program.write_text(ONE_LOOP + seconds)
    first, again, without = (run(program, NUMBA_CACHE_DIR=str(where)) for where in (tmp_path, tmp_path, os.devnull))
    assert [done.stdout for done in (first, again, without)] == ["42\nTrue\n", "42\nFalse\n", "42\nTrue\n"]


def test_a_folder_of_the_users_choice_is_taken_in_silence(program, tmp_path):
    done = run(program, NUMBA_CACHE_DIR=str(tmp_path / "mine"))
    assert (done.stdout, done.stderr) == ("42\n", "")
    assert list((tmp_path / "mine").rglob("*.nbi"))


def test_where_nothing_can_be_written_it_is_compiled_all_the_same(program):
    done = run(program, NUMBA_CACHE_DIR="/dev/null")
    assert (done.returncode, done.stdout) == (0, "42\n")


CALLED_BY_LOOPS = """
import sys
from prior_sg.services.compiled import compiled

@compiled(inline="always")
def inlined(x):
    return 2 * x

@compiled()
def called(x):
    return x + 1

@compiled()
def loop(x):
    return inlined(called(x))

print("numba" in sys.modules, loop(20), loop.__name__)
"""


def test_numba_is_loaded_by_the_first_call_and_loops_call_and_inline_each_other(program, tmp_path):
    program.write_text(CALLED_BY_LOOPS)
    done = run(program, NUMBA_CACHE_DIR=str(tmp_path / "mine"))
    assert done.stdout == "False 42 loop\n", done.stderr
    kept = {file.name.split("-")[0].split(".")[1] for file in (tmp_path / "mine").rglob("*.nbi")}
    assert kept == {"called", "loop"}


CALLER = """
from prior_sg.services.compiled import compiled
import {module} as other
from {module} import LEAST, called

@compiled()
def loop(x):
    return called(x) + LEAST

@compiled()
def by_module(x):
    return other.called(x)

print(loop(20), by_module(20), *(sum(one.met()) for one in (loop, by_module)), loop.met()[1], by_module.met()[1])
print(*called.met())
"""
CALLED = """
from prior_sg.services.compiled import compiled

LEAST = {least}

@compiled()
def deepest(x):
    return {deepest}

@compiled()
def called(x):
    return deepest(x)
"""


def test_what_is_kept_is_made_anew_when_what_it_calls_or_names_has_changed_in_another_file(program, tmp_path):
    program.write_text(CALLER.format(module="called_by_it"))

    def tells(least, deepest):
        (program.parent / "called_by_it.py").write_text(CALLED.format(least=least, deepest=deepest))
        done = run(program, NUMBA_CACHE_DIR=str(tmp_path / "mine"))
        assert done.returncode == 0, done.stderr
        return done.stdout.split()

    assert tells(1, "x * 2") == ["41", "40", "1", "1", "0", "0", "1", "0"]
    assert tells(1, "x * 2") == ["41", "40", "1", "1", "1", "1", "0", "0"]  # read from the disk
    # What is called is compiled as well, though it could be read: else it would not be inlined.
    assert tells(2, "x * 2") == ["42", "40", "1", "1", "0", "1", "1", "0"]
    assert tells(2, "x * 3") == ["62", "60", "1", "1", "0", "0", "1", "0"]

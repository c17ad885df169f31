"""Names that nobody can take are one sentence at once, whatever the command and the way they are given."""

import os
import subprocess
import sys
import time
import unicodedata

import pytest

from prior_sg.deploy.cli.faults import sentence_of
from prior_sg.deploy.cli.main import main
from prior_sg.deploy.errors import UserError
from prior_sg.deploy.running.job import Job
from prior_sg.deploy.sample import SAMPLE
from prior_sg.services.runtime.host.lease import SupersededError
from tests.help.paths import ROOT

PLACE = ["--environment", "residential home"]
RUN = ["run", str(SAMPLE), *PLACE, "--task", "tidy up"]
OF_ROBOTS = {
    "run": RUN,
    "demo": ["demo"],
    "up": ["up"],
    "serve": ["serve", "segmenter"],
    "task": ["task", "tidy up"],
    "export": ["export", "--out", "x.json"],
    "explain": ["explain", "3"],
    "pose-update": ["pose-update", "poses.csv"],
}
ROBOTS = {
    "fleet/robot1": "holds '/'",
    "robot#1": "holds '#'",
    "": "is empty",
    " ": "is empty",
    "*": "holds '*'",
    "a$b": "holds '$'",
    "a?": "holds '?'",
    "{robot}": "holds '{'",
    "fleet": "is reserved",
    "jobs": "is reserved",
    "@adm": "is reserved",
    "x" * 65: "longer than 64",
    "a\x1b[2Jb": "control characters",
    "a\nb": "control characters",
    "\u202etobor": "control characters",
}


def said(arguments: list[str], capsys) -> str:
    started_s = time.monotonic()
    assert main(arguments) == 2
    assert time.monotonic() - started_s < 20
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("prior-sg: ") and err.count("\n") == 1 and err[:-1].isprintable()
    return err


@pytest.mark.parametrize("command", OF_ROBOTS)
def test_every_command_that_takes_a_robot_checks_its_name(command, capsys):
    for name in ("fleet/robot1", "robot#1", ""):
        assert "the robot's name" in said([*OF_ROBOTS[command], "--robot", name], capsys)


@pytest.mark.parametrize("name", ROBOTS)
def test_names_of_robots(name, capsys):
    assert ROBOTS[name] in said([*RUN, "--robot", name], capsys)
    with pytest.raises(UserError, match="robot's name"):
        Job(source="x", out=ROOT, environment="home", task="tidy", robot=name)


REGIONS = {
    "too many": (",".join(f"room {n}" for n in range(65)), "65 region names are given: at most 64"),
    "too long": ("x" * 81, "longer than 80"),
    "case": ("Kitchen,kitchen", "region names: 'Kitchen' and 'kitchen' are the same name; give each once"),
    "spaces": ("living room, living  room", "are the same name"),
    "Unicode form": (unicodedata.normalize("NFC", "café") + "," + unicodedata.normalize("NFD", "café"), "the same"),
    "escapes": ("a\x1b[31m", "control characters"),
}


@pytest.mark.parametrize("case", REGIONS)
def test_names_of_regions(case, capsys):
    regions, says = REGIONS[case]
    for command in (
        RUN,
        OF_ROBOTS["task"],
        ["priors", "make", *PLACE],
        ["priors", "export", *PLACE, "--out", "x.json"],
    ):
        assert says in said([*command, "--regions", regions], capsys)


def test_tasks_and_environments(capsys):
    assert "the task 'xxx" in said([*RUN[:-1], "x" * 2001], capsys)
    assert "control characters" in said([*RUN[:-1], "tidy\x1b[2J"], capsys)
    assert "the environment" in said(["priors", "show", "--environment", "a\x00b"], capsys)


@pytest.mark.parametrize("locale", [{"LC_ALL": "C"}, {"PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0"}])
@pytest.mark.parametrize("task", [b"caf\xe9", "Wäsche [/x]".encode()])
def test_any_bytes_on_any_terminal_end_in_a_sentence(task, locale):
    """In another process, whose arguments are bytes."""
    environment = os.environ | {"PYTHONPATH": str(ROOT / "src")} | locale
    command = [sys.executable, "-m", "prior_sg.deploy.cli.main", "priors", "show", "--environment", "moon", "--task"]
    done = subprocess.run([*command, task], capture_output=True, env=environment, check=False, timeout=120)
    assert done.returncode == (2 if task == b"caf\xe9" else 1)
    assert done.stderr.startswith(b"prior-sg: ") and done.stderr.count(b"\n") == 1, done.stderr
    assert (b"not valid UTF-8" in done.stderr) == (task == b"caf\xe9")


def test_markup_in_the_name_of_a_region_is_printed_as_it_is(capsys):
    names = "tv corner [/den],lounge [east]"
    assert main(["priors", "show", *PLACE, "--task", "sort [/x] bins", "--regions", names]) == 0
    out = capsys.readouterr().out
    assert "tv corner [/den]" in out and "lounge [east]" in out


def test_a_service_that_is_no_longer_in_charge_says_so():
    assert sentence_of(SupersededError("another is in charge: end it first")) == "another is in charge: end it first"


@pytest.mark.parametrize("command", [["ros", "rviz", "--out"], ["router", "--write"]])
def test_a_file_that_cannot_be_written_is_told(command, tmp_path, capsys):
    assert main([*command, str(tmp_path / "none" / "file")]) == 1
    assert "name another file" in capsys.readouterr().err

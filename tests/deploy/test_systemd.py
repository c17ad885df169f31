"""The units of systemd: what its own checker says, and that they agree with the program."""

import configparser
import shutil
import subprocess

import pytest

from prior_sg.deploy.cli.main import build_parser
from prior_sg.deploy.inspecting.compose import ON_ROBOT
from prior_sg.deploy.running.notify import EVERY_S
from prior_sg.deploy.running.serve import EXIT_HOPELESS, EXIT_YIELDED
from prior_sg.services.registry import BY_NAME
from tests.help.paths import ROOT

FOLDER = ROOT / "deploy/systemd"
UNIT = FOLDER / "prior-sg@.service"


def unit():
    parser = configparser.ConfigParser(interpolation=None, strict=False)
    parser.optionxform = str
    parser.read(UNIT)
    return parser["Service"]


def settings_of(name):
    lines = (FOLDER / name).read_text().splitlines()
    return dict(line.split("=", 1) for line in lines if not line.startswith("#"))


def test_the_unit_agrees_with_the_program():
    service = unit()
    assert service["RestartPreventExitStatus"] == f"{EXIT_HOPELESS} {EXIT_YIELDED}"
    assert float(service["WatchdogSec"]) > 2 * EVERY_S


@pytest.mark.parametrize("host", ["robot", "edge"])
def test_what_the_unit_starts_is_a_command_of_ours(host):
    start = unit()["ExecStart"].replace("$PSG_UP", settings_of(f"{host}.env")["PSG_UP"]).replace("%i", host)
    arguments = build_parser().parse_args(start.split()[1:])
    assert set(arguments.services) == (set(ON_ROBOT) if host == "robot" else set(BY_NAME) - set(ON_ROBOT))
    assert arguments.listen or arguments.join
    assert str(arguments.out).startswith("/var/lib/" + unit()["StateDirectory"].split()[0])


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="no systemd is installed")
def test_systemd_takes_the_unit_and_finds_it_well_guarded(tmp_path):
    text = UNIT.read_text().replace("/opt/prior-sg/bin/prior-sg", "/bin/true")  # that is there
    path = tmp_path / "prior-sg@robot.service"
    path.write_text(text)
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", path], capture_output=True, text=True, timeout=60, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    judged = subprocess.run(
        ["systemd-analyze", "security", "--offline=yes", "--threshold=25", path],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert judged.returncode == 0, judged.stdout

"""The files of Docker Compose: by whom they are generated, what each kind of host runs, and what a container may do."""

import shutil
import subprocess

import pytest

from prior_sg.deploy.inspecting.compose import (
    CACHE,
    COMPOSE,
    COMPOSE_CUDA,
    ON_ROBOT,
    ROUTERS,
    STATE,
    WEIGHT_PACKAGES,
    WEIGHTS,
)
from prior_sg.services.registry import BY_NAME
from tests.help.paths import ROOT

yaml = pytest.importorskip("yaml")
PARTS = yaml.safe_load((ROOT / COMPOSE).read_text())["services"]
ENGINE = shutil.which("docker-compose")
needs_engine = pytest.mark.skipif(ENGINE is None, reason="no docker-compose is installed")


def running_on(profile):
    return {name for name, part in PARTS.items() if profile in part["profiles"]}


def test_robot_and_edge_share_the_services_and_one_machine_has_all():
    robot, edge, everything = map(running_on, ("robot", "edge", "all"))
    assert robot - {"router-robot"} == set(ON_ROBOT)
    assert edge - {"router-edge"} == set(BY_NAME) - set(ON_ROBOT)
    assert everything - {"router-all"} == set(BY_NAME)
    assert running_on("segmenter") == {"segmenter"}, "what an edge needs once more for a second robot"


@pytest.mark.parametrize("name", PARTS)
def test_a_container_writes_its_volumes_and_nothing_else(name):
    part = PARTS[name]
    assert part["read_only"] is True and part["tmpfs"] == ["/tmp"]
    if name == "weights":
        return
    assert part["cap_drop"] == ["ALL"] and part["security_opt"] == ["no-new-privileges:true"]
    assert part["network_mode"] == "host" and part["init"] is True
    written = {volume.split(":")[1] for volume in part["volumes"] if not volume.endswith(":ro")}
    assert written == ({STATE, CACHE} if name in BY_NAME else set())
    assert (f"weights:{WEIGHTS}:ro" in part["volumes"]) == (name == "feature_pyramid")


def test_only_the_workers_are_given_cards():
    changed = yaml.safe_load((ROOT / COMPOSE_CUDA).read_text())["services"]
    assert set(changed) == {name for name, service in BY_NAME.items() if service.job is not None}


def test_the_weights_that_are_fetched_are_those_that_the_image_leaves_out():
    dockerfile = (ROOT / "deploy/Dockerfile").read_text()
    (removed,) = [line for line in dockerfile.replace("\\\n", " ").splitlines() if "pip uninstall --yes  " in line]
    assert set(WEIGHT_PACKAGES) <= set(removed.split())


@needs_engine
@pytest.mark.parametrize("profile", [*ROUTERS, "segmenter", "weights"])
def test_compose_itself_takes_the_files(profile):
    command = [ENGINE, "-f", COMPOSE, "-f", COMPOSE_CUDA, "--profile", profile, "config", "--services"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    assert set(done.stdout.split()) == running_on(profile)

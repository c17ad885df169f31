"""How many threads a command's matrix products take."""

import os
import subprocess
import sys

import pytest


@pytest.mark.parametrize(("said", "taken"), [({}, "1"), ({"OPENBLAS_NUM_THREADS": "2"}, "2")])
def test_a_command_sets_them_before_numpy_is_loaded_unless_the_user_has(said, taken):
    program = (
        "import os, sys; from prior_sg.deploy.cli import main; first = 'numpy' in sys.modules; main.main(['topics']); "
        "print(first, os.environ['OPENBLAS_NUM_THREADS'], file=sys.stderr)"
    )
    rest = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    told = subprocess.run([sys.executable, "-c", program], env=rest | said, capture_output=True, text=True, check=True)
    assert told.stderr.split() == ["False", taken]

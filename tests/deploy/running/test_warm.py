"""Inner loops compiled ahead of time."""

import os
import subprocess
import sys

from tests.help.long import long_run

USED = """
from prior_sg.deploy.api.mapper import Mapper
from prior_sg.deploy.running.warm import loops
from prior_sg.deploy.sample import SAMPLE
from prior_sg.services.ingest.sources import open_source

with Mapper("residential home", "real-estate listing") as mapper:
    for frame in list(open_source(SAMPLE))[:24]:
        mapper.add(frame)
    mapper.task("serve drinks to guests")
print(*(name for name, loop in loops().items() if loop.met()[0]))
"""


def done(folder, *command):
    return subprocess.run(
        [sys.executable, *command],
        env=os.environ | {"NUMBA_CACHE_DIR": str(folder)},
        capture_output=True,
        text=True,
        check=True,
    ).stdout


@long_run
def test_after_it_a_user_compiles_nothing(tmp_path):
    told = done(tmp_path, "-m", "prior_sg.deploy.cli.main", "warm")
    assert " 0 were kept" in told and not told.startswith("0 ")
    assert done(tmp_path, "-c", USED).split() == []
    assert "0 loops compiled" in done(tmp_path, "-m", "prior_sg.deploy.cli.main", "warm")

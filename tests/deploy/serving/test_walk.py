"""The commands of docs/api-http.md, in their order, as somebody would copy them."""

import re
import shutil
import subprocess
from pathlib import Path

import msgspec
import pytest

from prior_sg.deploy.serving.events import Feeds
from prior_sg.deploy.serving.gate import Entrance
from prior_sg.deploy.serving.http import http_app
from prior_sg.deploy.serving.system import System
from prior_sg.schemas.frames import IngestState
from prior_sg.schemas.topics import INGEST_STATE
from tests.help.homes import joined_home, region
from tests.help.served import served
from tests.help.store import StandIn

PAGE = Path(__file__).parents[3] / "docs" / "api-http.md"
READ = IngestState(
    robot="robot1", stamp_ns=1, frames_read=3, frames_total=3, keyframes=3, encoded=3, rejected=0, finished=True
)


def relabel(scene, task, digest):
    dining_room = region(3, "dining room", 0.9, (2.0, 1.5, 1.0), object_ids=[1])
    regions = [dining_room, scene.regions[1]]
    return msgspec.structs.replace(
        scene, regions=regions, labels=["bedroom", "dining room"], task=task, prior_digest=digest
    )


@pytest.mark.skipif(not shutil.which("curl") or not shutil.which("jq"), reason="needs curl and jq")
def test_the_commands_lead_to_a_way():
    blocks = "".join(re.findall(r"```sh\n(.*?)```", PAGE.read_text(), re.DOTALL))
    script = re.sub(r"^prior-sg up .*$", "", blocks, flags=re.MULTILINE)
    assert script.count("localhost:8000") == 4
    store = StandIn(joined_home(regions=[], objects=[], task=""), lambda _, *given: relabel(joined_home(), *given))
    system = System(store.open_bus, store.robot)
    feeds = Feeds(system)
    try:
        store.bus.publish(INGEST_STATE, READ)
        with served(http_app(system, feeds, Entrance()), feeds.close) as address:
            said = subprocess.run(
                ["bash", "-c", "set -eo pipefail\n" + script.replace("localhost:8000", address)],
                check=False,
                capture_output=True,
                text=True,
                timeout=60,
            )
    finally:
        system.close()
    assert said.returncode == 0 and not said.stderr, said.stderr
    assert store.tasks[0].regions == ["bathroom", "bedroom", "dining room", "kitchen", "living room"]
    assert '"dining room"' in said.stdout and '"found": true' in said.stdout

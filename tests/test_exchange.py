"""Services and the router exchanged while a stream goes on: real processes, a real router, nothing lost."""

import numpy as np
import pytest

from prior_sg.deploy.benches.exchange import ROUTER, ROWS, Running
from prior_sg.deploy.benches.same_scene import same
from prior_sg.services.runtime.jobs.dispatcher import CREDITS
from tests.help.long import long_run
from tests.test_pipeline import shortened

FRAMES = 30
BEGIN_AT = 0.3  # share of the stream
SPEED = 0.5
IN_TURN = [row for row in ROWS if row != "ingest"]  # whose successor needs what it has kept on disk


@long_run
@pytest.mark.timeout(1200)  # of many processes, on a machine as busy as may be
def test_every_service_is_exchanged_in_mid_run_and_nothing_is_lost(tmp_path):
    source = tmp_path / "source.mcap"
    shortened(source, FRAMES)
    with Running(source, SPEED).up() as running:
        running.start()
        running.until(lambda: running.heard.share >= BEGIN_AT, "the beginning of the stream")
        before = running.scene()
        for row in IN_TURN:
            running.exchange(row)
        running.until(lambda: running.heard.finished and running.heard.quiet_s() > 3.0, "the end of the stream")
        after = running.scene()
        children = [child.instance for child in running.supervisor.children]
    assert sorted(children) == sorted(f"{row}-{1 if row == 'ingest' else 2}" for row in ROWS if row != ROUTER)
    keyframes, encoded = running.heard.frames["KEYFRAME"], running.heard.frames["PYRAMID"]
    assert set(encoded) == set(keyframes) and len(after.trajectory) == len(set(keyframes))
    assert len(encoded) - len(set(encoded)) <= CREDITS  # jobs under way while the router was gone are given again
    alike = same(before, after)
    there = np.isin(before.place_ids, after.place_ids).mean()
    assert there > 0.8 and alike.place_ids > 0.95, alike
    names = {region.id: region.label for region in before.regions}
    assert names.keys() & {region.id for region in after.regions}

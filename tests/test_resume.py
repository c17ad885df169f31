"""An ingest that is killed in mid-stream, with real processes: it goes on where it was, and nothing is encoded again
that is known."""

import os
import signal
import threading
import time

import numpy as np
import pytest
from rich.console import Console

from prior_sg.deploy.running.job import KEYFRAMES, Job, run
from prior_sg.deploy.sample import SAMPLE
from prior_sg.schemas.codec import decode
from prior_sg.schemas.features import Pyramid
from prior_sg.schemas.places import SnapshotRequest
from prior_sg.schemas.topics import KEYFRAME, PLACE_SNAPSHOT, PYRAMID
from prior_sg.services.ingest.core.frames import RawFrame
from prior_sg.services.ingest.sources import open_source
from prior_sg.services.registry import BY_NAME
from prior_sg.services.runtime.bus import message_in
from prior_sg.services.runtime.client import BusClient
from prior_sg.services.runtime.jobs.dispatcher import CREDITS
from prior_sg.services.runtime.record import LogWriter, read_log
from prior_sg.services.runtime.runner import Runner
from prior_sg.services.runtime.zenoh_bus import ZenohBus

FRAMES, ENCODED_BEFORE, ENCODED_IN_ALL = 16, 8, 12
WORKERS = 2
CHEAP = ["feature_pyramid.detector=none", "feature_pyramid.layers=1"]


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    path = tmp_path_factory.mktemp("source") / "short.mcap"
    with LogWriter(path) as log:
        for one in list(read_log(SAMPLE, [KEYFRAME]))[:FRAMES]:
            log.add(one.topic, one.key, one.payload, one.writer, one.sequence, one.sent_ns, one.received_ns)
    return path


class Killer(threading.Thread):
    """Kills ingest, and then a worker, when so many keyframes are encoded."""

    def __init__(self, endpoint, pids):
        super().__init__(daemon=True)
        self.endpoint, self.pids, self.killed = endpoint, pids, {}

    def run(self):
        encoded = set()
        with BusClient(ZenohBus(self.endpoint)) as client:
            client.listen(PYRAMID, "*", lambda sample: encoded.add(message_in(sample).frame_id))
            for instance, number in (("ingest-1", ENCODED_BEFORE), ("feature_pyramid-1", ENCODED_IN_ALL)):
                while len(encoded) < number:
                    time.sleep(0.02)
                os.kill(self.pids[instance], signal.SIGKILL)
                self.killed[instance] = set(encoded)


@pytest.fixture(scope="module")
def killed(source, tmp_path_factory):
    out, killers = tmp_path_factory.mktemp("run"), []

    def on_started(endpoint, pids):
        killers.append(Killer(endpoint, pids))
        killers[0].start()

    job = Job(
        source=str(source),
        out=out,
        environment="residential home",
        task="serve drinks to guests",
        connect="tcp/127.0.0.1:0",
        workers=WORKERS,
        settings=CHEAP,
        on_started=on_started,
    )
    result = run(job, Console(quiet=True))
    assert list(killers[0].killed) == ["ingest-1", "feature_pyramid-1"]
    return result, out, killers[0].killed


def undisturbed(source):
    """What ingest selects and what the map is made of it, without processes."""
    with Runner(BY_NAME["ingest"]) as ingest, Runner(BY_NAME["place_graph"], wire=True) as place_graph:
        frames = [frame for frame in open_source(source) if isinstance(frame, RawFrame)]
        keyframes = [told for topic, told in ingest.feed(*frames) if topic is KEYFRAME]
        place_graph.feed(*keyframes)
        places = place_graph.answer(PLACE_SNAPSHOT, SnapshotRequest(robot="robot1"))
        return {keyframe.frame_id for keyframe in keyframes}, places


def test_it_goes_on_with_the_next_frame_and_all_keyframes_are_there_once(killed, source):
    result, out, _ = killed
    expected, _ = undisturbed(source)
    assert result.counts.keyframes == set(result.counts.pyramids) == expected
    ingest = result.counts.ingest
    assert (ingest.keyframes, ingest.encoded, ingest.skipped) == (len(expected), len(expected), 0)
    assert ingest.frames_read == FRAMES and not ingest.losses
    log = (out / "logs" / "ingest-1.log").read_text()
    assert "going on" in log
    assert (out / KEYFRAMES).stat().st_size > 100_000


def test_what_was_encoded_when_ingest_died_is_not_encoded_again(killed):
    result, _, at_death = killed
    before = at_death["ingest-1"]
    assert len(before) >= ENCODED_BEFORE > CREDITS * WORKERS
    written = list(read_log(result.log_path, (KEYFRAME, PYRAMID)))
    writers = [one.writer for one in written if one.topic is KEYFRAME]
    assert len(set(writers)) == 2
    begun = next(i for i, one in enumerate(written) if one.writer == writers[-1])
    later = [decode(Pyramid, one.payload).frame_id for one in written[begun:] if one.topic is PYRAMID]
    again = [frame_id for frame_id in later if frame_id in before]
    assert len(again) <= CREDITS * WORKERS  # whose word that they were done ingest may not have heard


def test_the_map_is_that_of_an_undisturbed_stream(killed, source):
    scene = killed[0].scene
    _, places = undisturbed(source)
    assert len(places.place_ids) > 20 and (scene.place_regions >= 0).all()
    np.testing.assert_array_equal(scene.place_ids, places.place_ids)
    np.testing.assert_array_equal(scene.positions_m, places.positions_m)
    np.testing.assert_array_equal(scene.edges, places.edges)

"""The whole pipeline as its users run it: real processes, a real router, a real recording, and real trouble."""

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections import Counter

import msgspec
import numpy as np
import pytest
import spark_dsg
import zenoh
from rich.console import Console

from prior_sg.deploy.cli import report
from prior_sg.deploy.cli.main import main
from prior_sg.deploy.inspecting.replay import compare, open_log
from prior_sg.deploy.running.job import Job, run
from prior_sg.deploy.sample import SAMPLE
from prior_sg.schemas.codec import DecodeError, decode, encode
from prior_sg.schemas.frames import Keyframe
from prior_sg.schemas.topics import (
    BACKFILL,
    ENCODE,
    JOURNAL,
    KEYFRAME,
    POSE_UPDATE,
    PRIOR_CLAIM,
    PRIOR_EVIDENCE,
    PRIOR_REVISION,
    PYRAMID,
    REGION_DELTA,
    TOPICS,
    job_key,
)
from prior_sg.services.runtime.client import BusClient
from prior_sg.services.runtime.jobs.dispatcher import CREDITS
from prior_sg.services.runtime.record import LogWriter, read_log, summary
from prior_sg.services.runtime.zenoh_bus import ZenohBus

FRAMES = 26
# Recorded, but sent only when there is something to correct, missing, to agree on with other gateways or to learn.
WHEN_NEEDED = (POSE_UPDATE, BACKFILL, PRIOR_CLAIM, PRIOR_EVIDENCE, PRIOR_REVISION)
GARBAGE = (b"", b"\x00", b"\xff" * 64, os.urandom(512))


def shortened(path, frames):
    """The first frames of the sample as a log of its own."""
    with LogWriter(path) as log:
        for logged in list(read_log(SAMPLE, [KEYFRAME]))[:frames]:
            log.add(
                logged.topic,
                logged.key,
                logged.payload,
                logged.writer,
                logged.sequence,
                logged.sent_ns,
                logged.received_ns,
            )
    return path


class Trouble(threading.Thread):
    """Disturbs a run once it is under way; `did` tells what happened, `health` what the processes said afterwards."""

    def __init__(self, endpoint, pids):
        super().__init__(daemon=True)
        self.endpoint, self.pids = endpoint, pids
        self.did, self.health, self.task_output = [], None, ""

    def run(self):
        with BusClient(ZenohBus(self.endpoint)) as client:
            frames, messages = [], {}

            def see(sample):
                with contextlib.suppress(DecodeError):
                    decode(sample.topic.type, sample.payload)
                    frames.append(sample)
                    messages.setdefault(sample.topic, sample)

            client.listen(PYRAMID, "*", see)
            client.listen(KEYFRAME, "*", lambda sample: messages.setdefault(sample.topic, sample))
            self.wait_for(frames, 5)
            os.kill(self.pids["feature_pyramid-1"], signal.SIGKILL)
            self.did.append("worker killed")
            self.publish_garbage(client, messages)
            self.did.append("garbage published")
            self.wait_for(frames, 9)
            told = self.command("health", "--json", "--seconds", "0", statuses=(0, 1))  # garbage may count as a fault
            self.health = json.loads(told)
            os.kill(self.pids["scene_store-1"], signal.SIGKILL)
            self.did.append("store killed")
            self.wait_for(frames, 14)
            self.task_output = self.command("task", "hospitality service", "--environment", "residential home")
            self.did.append("task switched")

    def publish_garbage(self, client, messages):
        """Random bytes and cut-off messages on every key, with and without a sender's header."""
        cut = [sample.payload[: len(sample.payload) // 2] for sample in messages.values()]
        for topic in TOPICS:
            key = topic.key.format(robot="robot1", digest="0" * 32, question="0" * 32)
            for payload in (*GARBAGE, *cut):
                for header in (b"", b"\xff" * 3, b"\x00" * 40):
                    if topic.delivery != "job":
                        client.bus._session.put(
                            key, payload, attachment=header, congestion_control=zenoh.CongestionControl.BLOCK
                        )
        for worker in [name for name, service in client.alive().items() if service == "feature_pyramid"]:
            for payload in GARBAGE:
                client.bus.call(job_key(ENCODE, worker, "garbage"), payload, 5.0, lambda answer: None)

    def command(self, *arguments, statuses=(0,)):
        command = [sys.executable, "-m", "prior_sg.deploy.cli.main", *arguments, "--connect", self.endpoint]
        done = subprocess.run(command, capture_output=True, text=True, timeout=90, check=False)
        assert done.returncode in statuses, done.stdout + done.stderr
        return done.stdout

    @staticmethod
    def wait_for(frames, number):
        end_s = time.monotonic() + 120
        while len(frames) < number:
            assert time.monotonic() < end_s
            time.sleep(0.05)


@pytest.fixture(scope="module")
def disturbed(tmp_path_factory):
    """One run with two workers in which a worker and the store are killed, garbage is sent and the task is switched."""
    folder = tmp_path_factory.mktemp("run")
    trouble = []

    def on_started(endpoint, pids):
        trouble.append(Trouble(endpoint, pids))
        trouble[0].start()

    job = Job(
        source=str(shortened(folder / "short.mcap", FRAMES)),
        out=folder / "out",
        environment="residential home",
        task="real-estate listing",
        connect="tcp/127.0.0.1:0",
        workers=2,
        speed=0.35,  # slow enough for the trouble to happen in mid-stream on a fast machine
        on_started=on_started,
    )
    result = run(job, Console(quiet=True))
    report.write(result, job.out, None, Console(quiet=True))
    trouble[0].join(10)
    return result, job.out, trouble[0]


def test_all_the_trouble_happened(disturbed):
    _, _, trouble = disturbed
    assert trouble.did == ["worker killed", "garbage published", "store killed", "task switched"]
    assert len(trouble.pids) == 7


def test_every_keyframe_is_encoded_once_in_the_result(disturbed):
    result, out, _ = disturbed
    assert result.counts.keyframes == set(range(FRAMES)) == set(result.counts.pyramids)
    log = open_log(out / "log.mcap", "segmenter")
    (life,) = log.lives
    used = {message.frame_id for entry in life.inputs if entry.topic == "PYRAMID" for message in [log.input(entry)]}
    assert used == set(range(FRAMES))


def test_all_places_are_labelled_with_the_new_task(disturbed):
    scene = disturbed[0].scene
    assert scene.task == "hospitality service"
    assert len(scene.place_ids) > 20 and (scene.place_regions >= 0).all()
    assert {region.label for region in scene.regions} <= set(scene.labels)
    np.testing.assert_allclose(scene.posteriors.astype(float).sum(axis=1), 1, atol=0.02)


def test_the_task_switch_encoded_nothing_again(disturbed):
    result, _, trouble = disturbed
    assert "regions for 'hospitality service' after" in trouble.task_output
    repeated = sum(result.counts.pyramids.values()) - FRAMES
    assert repeated <= CREDITS  # only what the killed worker had in hand, or a slow one seemed to have dropped


def test_garbage_is_counted_per_topic(disturbed):
    health = disturbed[2].health
    assert not health["silent"]
    malformed = {
        (process["service"], count["topic"]): count["malformed"]
        for process in health["processes"]
        for count in process["topics"]
    }
    for service, topic in [
        ("place_graph", "KEYFRAME"),
        ("segmenter", "PLACE_DELTA"),
        ("segmenter", "PYRAMID"),
        ("segmenter", "TASK"),
        ("segmenter", "PRIOR"),
        ("prior_gateway", "TASK"),
        ("ingest", "JOURNAL"),
        ("feature_pyramid", "ENCODE"),
    ]:
        assert malformed[service, topic] > 0, (service, topic)


def test_the_final_scene_equals_that_of_an_undisturbed_store(disturbed):
    out = disturbed[1]
    assert report.final_scene_difference(open_log(out / "log.mcap", "scene_store"), out / "log.mcap") == ""
    assert len(open_log(out / "log.mcap", "scene_store").lives) == 2


@pytest.mark.parametrize("service", ["segmenter", "place_graph", "prior_gateway"])
def test_replay_gives_the_same_outputs(disturbed, service):
    log = open_log(disturbed[1] / "log.mcap", service)
    for life in log.lives:
        found = compare(log, life)
        assert found.recorded > 0 and found.differences == []


def test_replay_notices_a_difference(disturbed, tmp_path):
    """The comparison itself can fail: a log in which one published radius was altered."""
    import msgspec

    from prior_sg.schemas.codec import encode
    from prior_sg.schemas.places import PlaceDelta
    from prior_sg.schemas.topics import PLACE_DELTA

    altered = tmp_path / "altered.mcap"
    done = False
    with LogWriter(altered) as log:
        for logged in read_log(disturbed[1] / "log.mcap"):
            payload = logged.payload
            if logged.topic is PLACE_DELTA and not done:
                delta = decode(PlaceDelta, payload)
                if len(delta.radii_m):
                    payload, done = (
                        encode(msgspec.structs.replace(delta, radii_m=delta.radii_m + np.float32(0.01))),
                        True,
                    )
            log.add(
                logged.topic, logged.key, payload, logged.writer, logged.sequence, logged.sent_ns, logged.received_ns
            )
    assert done
    log = open_log(altered, "place_graph")
    assert any("radii_m" in text for text in compare(log, log.lives[0]).differences)


def test_exports_agree(disturbed):
    out = disturbed[1]
    scene = json.loads((out / "scene.json").read_text())
    graph = spark_dsg.DynamicSceneGraph.load(str(out / "dsg.json"))
    places, rooms = graph.get_layer(spark_dsg.DsgLayers.PLACES), graph.get_layer(spark_dsg.DsgLayers.ROOMS)
    assert places.num_nodes() == len(scene["places"]) and places.num_edges() == len(scene["edges"])
    assert rooms.num_nodes() == len(scene["regions"])
    assert (out / "map.png").stat().st_size > 10_000


def test_regions_that_survive_an_update_keep_their_ids(disturbed):
    """A region survives where its places and those of one region after the update are mostly the same."""
    place_regions, survivals = {}, 0
    for logged in read_log(disturbed[1] / "log.mcap", [REGION_DELTA]):
        delta, before = decode(REGION_DELTA.type, logged.payload), dict(place_regions)
        place_regions = {} if delta.snapshot else place_regions
        for place in delta.removed_place_ids.tolist():
            place_regions.pop(place, None)
        place_regions.update(zip(delta.place_ids.tolist(), delta.place_regions.tolist(), strict=True))
        both = before.keys() & place_regions.keys()
        pairs = Counter((before[place], place_regions[place]) for place in both)
        then, now = Counter(before[place] for place in both), Counter(place_regions[place] for place in both)
        for (old, new), count in pairs.items():
            if 2 * count > then[old] and 2 * count > now[new]:
                assert old == new
                survivals += 1
    assert survivals > 20


def test_explain_from_the_log_adds_up(disturbed, capsys):
    """The segmenter at the end of the log holds the label of the final scene, and its costs add up to its belief."""
    scene, log = disturbed[0].scene, str(disturbed[0].log_path)
    row = int(np.argmax(scene.place_regions >= 0))
    place, names = int(scene.place_ids[row]), {region.id: region.label for region in scene.regions}
    assert main(["explain", str(place), "--log", log, "--json"]) == 0
    reply = json.loads(capsys.readouterr().out)
    assert (reply["place_id"], reply["label"]) == (place, names[int(scene.place_regions[row])])
    costs = (np.array(reply["unary"]) + reply["pull"]) / reply["temperature"]
    likelihoods = np.exp(costs.min() - costs)
    np.testing.assert_allclose(reply["posterior"], likelihoods / likelihoods.sum(), atol=1e-9)
    assert [vote["expert"] for vote in reply["votes"]][:2] == ["visual", "geometric"]
    assert main(["explain", str(place), "--log", log]) == 0
    text = capsys.readouterr().out
    assert f"place {place} at" in text and f"{reply['label']} before" in text and "neighbours" in text
    assert main(["explain", "999999", "--log", log]) == 1
    assert "scene.json lists their ids" in capsys.readouterr().err


def test_the_log_holds_everything_recorded(disturbed):
    counts = summary(disturbed[1] / "log.mcap")
    for topic in TOPICS:
        if topic not in WHEN_NEEDED:
            assert (counts.get(topic.name, 0) > 0) == topic.recorded, topic.name
    services = {
        decode(JOURNAL.type, logged.payload).service for logged in read_log(disturbed[1] / "log.mcap", [JOURNAL])
    }
    assert services == {"ingest", "place_graph", "feature_pyramid", "prior_gateway", "segmenter", "scene_store"}


def test_replay_and_export_on_the_command_line(disturbed, capsys, tmp_path):
    out = disturbed[1]
    assert main(["replay", str(out / "log.mcap"), "segmenter", "--diff"]) == 0
    assert "0 differences" in capsys.readouterr().out
    again = tmp_path / "again.json"
    assert main(["export", str(out / "scene.sqlite"), "--format", "json", "--out", str(again)]) == 0
    written = json.loads((out / "scene.json").read_text())
    assert json.loads(again.read_text()) | {"losses": written["losses"]} == written  # which the store does not keep


@pytest.mark.parametrize(
    "arguments, sentence",
    [
        (["run", "/nowhere", "--environment", "home", "--task", "t"], "/nowhere does not exist"),
        (["replay", "/nowhere.mcap", "segmenter"], "nowhere.mcap"),
        (["health", "--connect", "tcp/127.0.0.1:1"], "no router answers on tcp/127.0.0.1:1"),
        (["export", "/nowhere.sqlite", "--out", "x.json"], "nowhere.sqlite does not exist"),
    ],
)
def test_errors_are_one_sentence(arguments, sentence, capsys):
    assert main(arguments) == 1
    error = capsys.readouterr().err.strip()
    assert sentence in error and len(error.splitlines()) == 1


@pytest.mark.parametrize("arguments", [["replay", "x.mcap", "nobody"], ["up", "nobody"]])
def test_a_service_that_is_none_is_a_command_put_wrongly(arguments, capsys):
    assert main(arguments) == 2
    error = capsys.readouterr().err.strip()
    assert "there is no service 'nobody'; known: ingest" in error and len(error.splitlines()) == 1


def test_an_unknown_environment_ends_the_run_with_the_reason(tmp_path):
    command = [
        sys.executable,
        "-m",
        "prior_sg.deploy.cli.main",
        "run",
        str(SAMPLE),
        "--environment",
        "submarine",
        "--task",
        "dive",
    ]
    command += ["--out", str(tmp_path / "out"), "--connect", "tcp/127.0.0.1:0"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 1 and "Traceback" not in done.stderr
    assert "knows no environment like 'submarine'" in done.stderr


def test_ctrl_c_leaves_results_and_no_processes(tmp_path):
    command = [
        sys.executable,
        "-m",
        "prior_sg.deploy.cli.main",
        "demo",
        "--out",
        str(tmp_path / "out"),
        "--connect",
        "tcp/127.0.0.1:0",
    ]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    log = tmp_path / "out" / "log.mcap"
    end_s = time.monotonic() + 120
    while not (log.exists() and log.stat().st_size > 2_000_000):
        assert time.monotonic() < end_s and process.poll() is None
        time.sleep(0.2)
    process.send_signal(signal.SIGINT)
    output, error = process.communicate(timeout=60)
    assert process.returncode == 130, error
    assert "interrupted: writing what there is" in output
    told = re.search(r"interrupted: (\d+) of (\d+) keyframes were not encoded", output)
    assert told is not None and int(told[2]) > 0 and f"{told[1]} missing" in output
    assert json.loads((tmp_path / "out" / "scene.json").read_text())["places"]
    assert summary(log)["KEYFRAME"] > 0
    left = subprocess.run(["pgrep", "-f", "--", f"--parent {process.pid}"], capture_output=True, text=True, check=False)
    assert (left.returncode, left.stdout) == (1, "")  # 1: none found


def test_one_process_maps_the_same_places_as_six(disturbed, tmp_path):
    scene = disturbed[0].scene
    job = Job(
        source=str(shortened(tmp_path / "short.mcap", FRAMES)),
        out=tmp_path / "out",
        environment="residential home",
        task="hospitality service",
        in_process=True,
    )
    local = run(job, Console(quiet=True)).scene
    for name in ("place_ids", "positions_m", "radii_m", "edges", "clearances_m", "trajectory"):
        np.testing.assert_array_equal(getattr(local, name), getattr(scene, name))
    assert (local.place_regions >= 0).all() and local.labels == scene.labels


def test_a_run_tells_what_it_could_not_use(tmp_path):
    """Five frames, the third with a depth image that is cut off: it costs itself, and the closing lines say so."""
    source = tmp_path / "broken.mcap"
    with LogWriter(source) as log:
        for number, logged in enumerate(list(read_log(SAMPLE, [KEYFRAME]))[:5]):
            keyframe = decode(Keyframe, logged.payload)
            broken = msgspec.structs.replace(keyframe, depth=keyframe.depth[: len(keyframe.depth) // 2])
            log.add(
                logged.topic,
                logged.key,
                encode(broken if number == 2 else keyframe),
                logged.writer,
                logged.sequence,
                logged.sent_ns,
                logged.received_ns,
            )
    job = Job(str(source), tmp_path / "out", "residential home", "hospitality service", in_process=True)
    result = run(job, Console(quiet=True))
    assert len(result.counts.keyframes) == 4 and len(result.scene.place_ids)
    unreadable = [text for text in result.loss_lines if "unreadable" in text]
    assert (
        len(unreadable) == 1 and unreadable[0].startswith("1 of 5 frames unreadable: ") and "cut off" in unreadable[0]
    )

"""`prior-sg trace`: what became of a keyframe, and why something is missing."""

import json

import pytest

from prior_sg.deploy.cli.main import main
from prior_sg.deploy.inspecting.trace import Step, Story, missing, of_keyframe
from prior_sg.schemas.codec import encode
from prior_sg.schemas.status import Consumed, PoolCount
from prior_sg.schemas.topics import JOURNAL, KEYFRAME, PLACE_DELTA, PYRAMID, REGION_DELTA, alive_key, status_key
from prior_sg.services.runtime.client import BusClient
from prior_sg.services.runtime.record import LogWriter
from prior_sg.services.runtime.zenoh_bus import ZenohBus
from tests.help.examples import EXAMPLES
from tests.help.telling import journey, passage, status


def steps(without=(), pairs=None):
    return [
        Step(one.service, one.instance, made)
        for one, made in (pairs or journey())
        if (one.service, made.topic) not in without
    ]


def story(without=(), processes=(), **changes):
    return Story("ada", 4, of_keyframe(steps(without), 4), processes, **changes)


def test_a_whole_way_lacks_nothing_and_ends_in_the_store():
    told = story()
    assert list(missing(told)) == []
    assert [(step.service, step.passage.topic) for step in told.steps][-2:] == [
        ("segmenter", "Tick"),
        ("scene_store", "REGION_DELTA"),
    ]
    assert of_keyframe(steps(), 5) == []


ENDED = ("ingest", "JobDone")
ENCODED = ("feature_pyramid", "ENCODE")


@pytest.mark.parametrize(
    ("without", "processes", "said"),
    [
        ([("place_graph", "KEYFRAME")], [], "not mapped: no place_graph is there; `prior-sg up place_graph"),
        (
            [("place_graph", "KEYFRAME")],
            [status(service="place_graph", instance="p", backlog=6, oldest_wait_s=4.0)],
            "not mapped: 6 inputs wait in p, the oldest for 4.0 s",
        ),
        ([ENCODED, ENDED], [], "not encoded: its worker has died"),
        (
            [ENCODED, ENDED],
            [status(pools=[PoolCount(topic="ENCODE", waiting=3, running=0, oldest_wait_s=1, workers={})])],
            "not encoded: no worker is there",
        ),
        (
            [ENCODED, ENDED],
            [status(pools=[PoolCount(topic="ENCODE", waiting=3, running=2, oldest_wait_s=1, workers={"a": 1})])],
            "not encoded: 3 keyframes wait for 1 workers, 2 are there",
        ),
        ([("segmenter", "PYRAMID")], [status(backlog=0)], "not segmented: segmenter-1 started later or has lost it"),
        ([("segmenter", "Tick")], [], "no regions were told since"),
        ([("scene_store", "REGION_DELTA")], [], "its regions not stored: no scene_store is there"),
        ([("scene_store", "PLACE_DELTA")], [], "the map not stored: no scene_store is there"),
        ([("ingest", "frame")], [], "ingest does not remember it"),
    ],
)
def test_what_is_missing_is_said_with_its_reason(without, processes, said):
    assert any(text.startswith(said) for text in missing(story(without, processes))), list(
        missing(story(without, processes))
    )


def test_refusals_and_jobs_given_up_are_said():
    pairs = [
        (
            status(service="ingest", instance="i"),
            passage("frame", 1, frame_id=4, published={"KEYFRAME": -1, "ENCODE": -1}),
        ),
        (status(service="ingest", instance="i"), passage("JobDone", 2, frame_id=4, fault="skipped for a newer one")),
        (
            status(service="place_graph", instance="p"),
            passage("KEYFRAME", 2, frame_id=4, fault="it has no depth", published={"PLACE_DELTA": 1}),
        ),
    ]
    said = list(missing(Story("ada", 4, of_keyframe(steps(pairs=pairs), 4))))
    assert said[:3] == [
        "i on JobDone: skipped for a newer one",
        "p on KEYFRAME: it has no depth",
        "not encoded: the job was given up, see above",
    ]


def test_the_running_system_is_asked(endpoint, capsys):
    told = {}
    for one, made in journey():
        told.setdefault(one.service, (one, []))[1].append(made)
    with BusClient(ZenohBus(endpoint)) as service:
        for name, (one, passages) in told.items():

            def answer(request, one=one, passages=passages):
                fields = {field: getattr(one, field) for field in one.__struct_fields__}
                request.reply(encode(type(one)(**(fields | {"passages": passages}))))

            service.bus.serve(status_key(name, one.instance), answer)
            service.bus.announce(alive_key(name, one.instance))
        assert main(["trace", "4", "--robot", "ada", "--connect", endpoint]) == 0
        text = " ".join(capsys.readouterr().out.split())
        assert "keyframe 4 of ada" in text and "feature_pyramid-1, 1 attempt" in text and "REGION_DELTA 3" in text
        assert main(["trace", "4", "--robot", "bob", "--connect", endpoint]) == 1
        assert "no process remembers keyframe 4 of bob" in capsys.readouterr().err


def example(kind, **changes):
    message = next(one for one in EXAMPLES if type(one) is kind)
    return type(message)(**({f: getattr(message, f) for f in message.__struct_fields__} | {"robot": "ada"} | changes))


@pytest.fixture
def log(tmp_path):
    """Keyframe 4 was mapped and encoded, and the log ended before the segmenter took it in; 5 was refused."""
    path = tmp_path / "log.mcap"
    with LogWriter(path) as writer:

        def add(topic, message, service, sequence, second):
            writer.add(
                topic, topic.key_of(message), encode(message), f"{service}/{service}-1/1", sequence, second * 10**9, 0
            )

        def consumed(topic, frame_id):
            return Consumed(
                robot="ada", service="s", instance="i", order=0, topic=topic, frame_id=frame_id, key="psg/ada/keyframe"
            )

        add(KEYFRAME, example(KEYFRAME.type, frame_id=4), "ingest", 0, 10)
        add(KEYFRAME, example(KEYFRAME.type, frame_id=5), "ingest", 1, 11)
        add(PLACE_DELTA, example(PLACE_DELTA.type, frame_id=4, event=""), "place_graph", 0, 12)
        add(JOURNAL, consumed("KEYFRAME", 4), "place_graph", 0, 13)
        add(PLACE_DELTA, example(PLACE_DELTA.type, frame_id=5, event="its pose jumps"), "place_graph", 1, 13)
        add(PYRAMID, example(PYRAMID.type, frame_id=4), "feature_pyramid", 0, 14)
        add(JOURNAL, consumed("ENCODE", 4), "feature_pyramid", 0, 15)
        add(REGION_DELTA, example(REGION_DELTA.type), "segmenter", 0, 16)
    return path


def test_a_log_tells_the_same(log, capsys):
    assert main(["trace", "4", "--robot", "ada", "--log", str(log), "--json"]) == 1
    told = json.loads(capsys.readouterr().out)
    found = [(step["service"], step["topic"], step["published"]) for step in told["steps"]]
    assert found == [
        ("ingest", "frame", {"KEYFRAME": -1}),
        ("place_graph", "KEYFRAME", {"PLACE_DELTA": -1}),
        ("feature_pyramid", "ENCODE", {"PYRAMID": -1}),
    ]
    assert told["missing"][0].startswith("not segmented: segmenter had not finished with it when the log ended")
    assert main(["trace", "5", "--robot", "ada", "--log", str(log)]) == 1
    assert "place_graph-1 on KEYFRAME: its pose jumps" in capsys.readouterr().out
    assert main(["trace", "9", "--robot", "ada", "--log", str(log)]) == 1
    assert "holds no keyframe 9 of ada; the nearest are 4, 5" in capsys.readouterr().err

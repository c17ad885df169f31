"""What a process remembers of keyframes, and what waits in it and at its workers."""

import time

import pytest

from prior_sg.schemas.codec import encode
from prior_sg.schemas.frames import Keyframe
from prior_sg.schemas.places import PlaceDelta
from prior_sg.schemas.regions import RegionDelta
from prior_sg.schemas.status import JobDone, StatusRequest, Tick
from prior_sg.schemas.topics import CAMERA_STATE, ENCODE, KEYFRAME, PLACE_DELTA, REGION_DELTA, worker_keys
from prior_sg.services.runtime.bus import Hub, LocalBus, Sample, pack_header, unpack_header
from prior_sg.services.runtime.client import BusClient
from prior_sg.services.runtime.host.inbox import Inbox
from prior_sg.services.runtime.host.trail import LONGEST_FAULT, MOST_OF_A_STEP, MOST_PASSAGES, Trail
from prior_sg.services.runtime.jobs.pool import JobPool
from tests.help.examples import EXAMPLES

CONTEXT = f"00-{'ab' * 16}-{'cd' * 8}-01"


def example(kind, **changes):
    message = next(one for one in EXAMPLES if type(one) is kind)
    return type(message)(**({f: getattr(message, f) for f in message.__struct_fields__} | {"robot": "ada"} | changes))


def all_of(trail):
    return trail.asked(StatusRequest(since_ns=1))


def test_an_input_is_kept_with_its_times_and_what_was_published_for_it():
    trail, keyframe = Trail("ada"), example(Keyframe, frame_id=4, stamp_ns=9)
    sample = Sample(KEYFRAME, "psg/ada/keyframe", b"", "ingest/i/1", 0, 5, CONTEXT)
    with trail.passing(keyframe, "KEYFRAME", 0.5, sample):
        trail.published(PLACE_DELTA, example(PlaceDelta, frame_id=4, stamp_ns=9, revision=7, event=""))
    (one,) = trail.asked(StatusRequest(frame_id=4))
    assert (one.robot, one.topic, one.frame_id, one.published) == ("ada", "KEYFRAME", 4, {"PLACE_DELTA": 7})
    assert (one.writer, one.sent_ns, one.traceparent) == ("ingest/i/1", 5, CONTEXT)
    assert one.began_ns - one.received_ns == 500_000_000 and one.ended_ns >= one.began_ns
    assert trail.asked(StatusRequest(frame_id=5)) == trail.asked(StatusRequest()) == []
    assert trail.asked(StatusRequest(since_ns=one.ended_ns)) == []


def test_a_frame_is_kept_when_it_becomes_a_keyframe_and_under_its_number():
    trail, raw = Trail("ada"), Tick(stamp_ns=1)
    with trail.passing(raw, "frame", 0.0, None):
        trail.published(CAMERA_STATE, example(CAMERA_STATE.type))
    assert all_of(trail) == []
    with trail.passing(raw, "frame", 0.0, None):
        for topic in (KEYFRAME, ENCODE):
            trail.published(topic, example(Keyframe, frame_id=12))
    assert [(one.frame_id, one.published) for one in all_of(trail)] == [(12, {"KEYFRAME": -1, "ENCODE": -1})]
    with trail.passing(raw, "BACKFILL", 0.0, None):
        for number in range(200):
            trail.published(ENCODE, example(Keyframe, frame_id=number))
    assert len(all_of(trail)) == 1 + MOST_OF_A_STEP


def test_deltas_are_told_by_their_revisions_and_ticks_that_do_nothing_not_at_all():
    trail = Trail("ada")
    with trail.passing(Tick(stamp_ns=1), "Tick", 0.0, None):
        pass
    with trail.passing(Tick(stamp_ns=1), "Tick", 0.0, None):
        trail.published(REGION_DELTA, example(RegionDelta, revision=3))
    with trail.passing(example(RegionDelta, revision=3), "REGION_DELTA", 0.0, None):
        pass
    found = [(one.topic, one.frame_id, one.revision, one.published) for one in all_of(trail)]
    assert found == [("Tick", -1, -1, {"REGION_DELTA": 3}), ("REGION_DELTA", -1, 3, {})]


def test_faults_are_kept():
    trail, keyframe = Trail("ada"), example(Keyframe, frame_id=4)
    with pytest.raises(ValueError), trail.passing(keyframe, "ENCODE", 0.0, None):
        raise ValueError("x" * 1000)
    with trail.passing(keyframe, "KEYFRAME", 0.0, None):
        trail.published(PLACE_DELTA, example(PlaceDelta, frame_id=4, event="it has no depth"))
    done = JobDone(topic="ENCODE", frame_id=4, worker="w", attempts=2, error="skipped")
    with trail.passing(done, "JobDone", 0.0, None):
        pass
    told = all_of(trail)
    assert [one.fault for one in told] == ["x" * LONGEST_FAULT, "it has no depth", "skipped"]
    assert (told[2].robot, told[2].worker, told[2].attempts) == ("ada", "w", 2)


def test_the_trail_is_bounded():
    trail = Trail("ada")
    for number in range(MOST_PASSAGES + 10):
        with trail.passing(example(Keyframe, frame_id=number), "KEYFRAME", 0.0, None):
            pass
    assert [one.frame_id for one in (all_of(trail)[0], *trail.newest(1))] == [10, MOST_PASSAGES + 9]
    assert len(all_of(trail)) == MOST_PASSAGES


def test_an_inbox_says_how_long_its_inputs_wait():
    inbox = Inbox(wake=lambda: None)
    assert inbox.oldest_wait_s == 0.0
    inbox.put("old")
    time.sleep(0.05)
    inbox.put("new")
    inbox.put("question", first=True)
    assert inbox.oldest_wait_s >= 0.05
    assert inbox.take() == "question"
    waited_s = inbox.waited_s
    assert inbox.take() == "old" and inbox.waited_s >= waited_s + 0.05
    assert inbox.waiting() == ["new"]


def test_a_pool_counts_what_waits_for_whom():
    hub, now_s, ended = Hub(), [10.0], []
    pool = JobPool(LocalBus(hub), ENCODE, "ada", lambda: now_s[0], ended.append)
    pool.submit(("ada", 1), b"")
    now_s[0] = 14.0
    pool.submit(("ada", 2), b"")
    pool.submit(("ada", 3), b"", "other", later=True)
    told = pool.count()
    assert (told.topic, told.waiting, told.running, told.oldest_wait_s) == ("ENCODE", 2, 0, 4.0)
    worker, requests = LocalBus(hub), []
    run_key, live_key = worker_keys(ENCODE, "w", "space")
    worker.serve(f"{run_key}/*", requests.append)
    worker.announce(live_key)
    assert (pool.count().running, pool.count().workers["space"]) == (2, 1)
    for request in list(requests):
        request.reply(b"done 1")
    told = pool.count()
    assert (told.waiting, told.running, told.oldest_wait_s, len(ended)) == (0, 0, 0.0, 2)
    assert {job for job in pool._since_s} == {("ada", 3)}
    pool.close()


def test_a_context_travels_with_a_sample_and_nonsense_does_not():
    header = pack_header("client/a/1", 5, 6, CONTEXT)
    assert unpack_header(header) == ("client/a/1", 5, 6, CONTEXT)
    for bad in ("00-zz", CONTEXT.upper(), CONTEXT.replace("ab", "00"), CONTEXT + ";x"):
        assert unpack_header(pack_header("client/a/1", 5, 6, bad)) == ("client/a/1", 5, 6, "")
    seen, hub = [], Hub()
    with BusClient(LocalBus(hub)) as client:
        client.listen(KEYFRAME, "ada", seen.append)
        client.publish(KEYFRAME, example(Keyframe), CONTEXT)
        client.publish(KEYFRAME, example(Keyframe))
    assert [one.traceparent for one in seen] == [CONTEXT, ""] and encode(example(Keyframe)) == seen[0].payload

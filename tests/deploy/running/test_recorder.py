"""The recorder: what waits to be written has a limit, the log may have one, and what is left out is counted."""

import errno
import threading
import time

import numpy as np
import pytest

from prior_sg.deploy.running import recorder as recording
from prior_sg.deploy.running.recorder import Recorder, TapError, Waiting
from prior_sg.schemas.frames import PoseUpdate
from prior_sg.schemas.topics import POSE_UPDATE
from prior_sg.services.runtime.bus import Hub, LocalBus, Sample
from prior_sg.services.runtime.client import BusClient
from prior_sg.services.runtime.record import LogError, LogWriter, read_log, summary


def sample(size):
    return Sample(POSE_UPDATE, "k", bytes(size), "w", 0, 0)


def until(condition):
    end_s = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.005)


def update(count):
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, 3] = np.random.default_rng().normal(size=(count, 3))  # which no compression makes smaller
    ids = np.arange(count)
    return PoseUpdate(robot="r", epoch=1, revision=0, stamp_ns=0, frame_ids=ids, world_from_camera=poses)


def test_who_puts_waits_for_the_writer_and_nothing_is_lost():
    waiting, put = Waiting(most_bytes=1000, stuck_s=60.0), []

    def write():
        for number in range(30):
            waiting.put(sample(300))
            put.append(number)

    thread = threading.Thread(target=write)
    thread.start()
    until(lambda: len(put) == 3)
    time.sleep(0.05)
    assert len(put) == 3  # 900 bytes wait, and the fourth does not fit
    taken = 0
    while taken < 30:
        assert waiting.take(5.0) is not None
        taken += 1
        assert len(put) <= taken + 3
    thread.join(5)
    assert waiting.left_out == 0 and waiting.take(0.0) is None


def test_one_that_is_larger_than_all_that_may_wait_passes_alone():
    waiting = Waiting(most_bytes=10, stuck_s=60.0)
    waiting.put(sample(99))
    assert len(waiting.take(1.0).payload) == 99


def test_a_writer_that_takes_nothing_holds_nobody_up_for_ever():
    waiting = Waiting(most_bytes=1000, stuck_s=0.1)
    for _ in range(5):
        waiting.put(sample(600))
    assert waiting.left_out == 4
    assert waiting.take(1.0) is not None
    waiting.put(sample(600))
    assert waiting.left_out == 4  # it goes on


def test_closing_lets_everybody_go_and_keeps_what_has_come():
    waiting = Waiting(most_bytes=100, stuck_s=60.0)
    waiting.put(sample(90))
    threads = [threading.Thread(target=waiting.put, args=(sample(90),)) for _ in range(3)]
    [thread.start() for thread in threads]
    waiting.close()
    [thread.join(5) for thread in threads]
    assert not any(thread.is_alive() for thread in threads)
    assert not waiting.ended and waiting.take(0.0) is not None and waiting.ended


def test_a_log_ends_at_its_limit_and_says_so_while_the_taps_go_on(tmp_path):
    client, seen = BusClient(LocalBus(Hub())), []
    path = tmp_path / "log.mcap"
    recorder = Recorder(client, path, limit_mb=1.0)
    recorder.taps.append(lambda sample, message: seen.append(message))
    for _ in range(60):
        client.publish(POSE_UPDATE, update(2000))
    until(lambda: len(seen) == 60)
    recorder.close()
    written = summary(path)["POSE_UPDATE"]
    assert 0 < written < 60 and recorder.beyond == 60 - written
    assert recorder.lacks == f"{path} lacks the last {60 - written} messages: it has grown to 1 MB"
    assert len(list(read_log(path))) == written

    unlimited = Recorder(client, tmp_path / "other.mcap")
    client.publish(POSE_UPDATE, update(2000))
    unlimited.close()
    assert unlimited.lacks == ""


def test_a_full_disk_is_one_sentence_and_nobody_is_held_up(tmp_path, monkeypatch):
    monkeypatch.setattr(recording, "FLUSH_S", 0.02)
    client, seen = BusClient(LocalBus(Hub())), []
    recorder = Recorder(client, tmp_path / "log.mcap")
    recorder.taps.append(lambda sample, message: seen.append(message))

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(recorder._log._file, "write", full, raising=False)
    for _ in range(20):
        client.publish(POSE_UPDATE, update(2000))
    until(lambda: len(seen) == 20)
    until(lambda: recorder.error is not None)
    with pytest.raises(LogError, match=r"log\.mcap cannot be written: No space left on device"):
        recorder.close()


def test_a_writer_knows_how_large_its_file_is(tmp_path):
    with LogWriter(tmp_path / "log.mcap") as log:
        empty = log.size_bytes
        log.add(POSE_UPDATE, "k", np.random.default_rng(0).bytes(100_000), "w", 0, 0, 1)
        log.flush()
        assert log.size_bytes >= empty + 100_000
        assert log.size_bytes == (tmp_path / "log.mcap").stat().st_size


def test_a_fault_of_ours_ends_no_recording_in_silence(tmp_path, monkeypatch):
    client, seen = BusClient(LocalBus(Hub())), []
    recorder = Recorder(client, tmp_path / "log.mcap")
    recorder.taps.append(lambda sample, message: seen.append(message))

    def fails(*_):
        raise TypeError("no such schema")

    monkeypatch.setattr(recorder._log, "add", fails)
    for _ in range(3):
        client.publish(POSE_UPDATE, update(2))
    until(lambda: len(seen) == 3)
    with pytest.raises(LogError, match=r"log\.mcap cannot be written on: TypeError\('no such schema'\)"):
        recorder.close()


def test_a_tap_that_fails_is_no_log_that_cannot_be_written(tmp_path):
    client, seen = BusClient(LocalBus(Hub())), []
    recorder = Recorder(client, tmp_path / "log.mcap")

    def counts(sample, message):
        raise ValueError("a number too many")

    recorder.taps += [counts, lambda sample, message: seen.append(message)]
    for _ in range(3):
        client.publish(POSE_UPDATE, update(2))
    until(lambda: len(seen) == 3)
    said = r"counts, which follows .* POSE_UPDATE: ValueError\('a number too many'\); .*log\.mcap is whole"
    with pytest.raises(TapError, match=said):
        recorder.check()
    with pytest.raises(TapError, match=said):
        recorder.close()
    assert recorder.counts["POSE_UPDATE"] == 3 and len(list(read_log(tmp_path / "log.mcap"))) == 3

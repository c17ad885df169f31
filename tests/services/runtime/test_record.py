"""Logs: what goes in comes out, also from a log that was cut off, and the MCAP library itself can read it."""

import json
import os
import random
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from mcap.opcode import Opcode
from mcap.reader import make_reader

from prior_sg.schemas.codec import decode, encode
from prior_sg.schemas.frames import CameraState, IngestState
from prior_sg.schemas.migrations import MIGRATIONS
from prior_sg.schemas.topics import CAMERA_STATE, INGEST_STATE, KEYFRAME, TOPICS
from prior_sg.services.runtime.record import (
    LogError,
    LogWriter,
    attachments,
    contents,
    loss,
    metadata,
    read_log,
    summary,
)
from tests.help import reading
from tests.help.paths import ROOT

SECOND = 1_000_000_000


def camera(stamp_ns, robot="a"):
    return CameraState(robot=robot, stamp_ns=stamp_ns, world_from_camera=np.eye(4))


def entry(number, received_ns, topic=CAMERA_STATE, payload=b"x", *, writer="w", key="psg/a/camera"):
    return {
        "topic": topic,
        "key": key,
        "payload": payload,
        "writer": writer,
        "sequence": number,
        "sent_ns": received_ns // 2,
        "received_ns": received_ns,
    }


def as_dicts(path, topics=None):
    return [{name: getattr(m, name) for name in m.__slots__} for m in read_log(path, topics)]


def mixed_entries():
    """Two topics, two writers, receive times that also go back, payloads larger than a chunk."""
    noise = random.Random(1)
    entries = []
    for i in range(40):
        received_ns = SECOND + i * SECOND // 20 - (i % 3) * SECOND // 10
        if i % 4 == 0:
            state = noise.randbytes(400_000 if i != 20 else 1_500_000)
            entries.append(entry(i, received_ns, INGEST_STATE, state, writer="second", key="psg/b/ingest"))
        else:
            entries.append(entry(i, received_ns, payload=encode(camera(i))))
    return entries


def write(path, entries, **options):
    with LogWriter(path, **options) as log:
        for e in entries:
            log.add(**e)


def test_a_log_gives_back_what_was_added_in_the_same_order(tmp_path):
    path, entries = tmp_path / "a.mcap", mixed_entries()
    write(path, entries)
    assert as_dicts(path) == entries


def test_reading_selected_topics_leaves_the_others_out(tmp_path):
    path, entries = tmp_path / "a.mcap", mixed_entries()
    write(path, entries)
    assert as_dicts(path, (INGEST_STATE,)) == [e for e in entries if e["topic"] is INGEST_STATE]
    assert as_dicts(path, (KEYFRAME,)) == []


def test_the_mcap_library_reads_channels_schemas_and_times(tmp_path):
    path = tmp_path / "a.mcap"
    write(path, [entry(7, 123, payload=encode(camera(9)))])
    with path.open("rb") as file:
        ((schema, channel, message),) = make_reader(file, validate_crcs=True).iter_messages()
    assert (schema.name, schema.encoding) == ("CameraState/1", "jsonschema")
    assert "world_from_camera" in json.loads(schema.data)["$defs"]["CameraState"]["properties"]
    assert (channel.topic, channel.message_encoding) == ("psg/a/camera", "msgpack")
    assert channel.metadata == {"topic": "CAMERA_STATE", "writer": "w"}
    assert (message.sequence, message.log_time, message.publish_time) == (7, 123, 61)
    assert decode(CameraState, message.data) == camera(9)


def test_contents_and_summary_count_by_writer_and_topic(tmp_path):
    path = tmp_path / "a.mcap"
    write(path, [entry(0, 1), entry(1, 2), entry(0, 3, writer="other"), entry(0, 4, INGEST_STATE, key="psg/a/ingest")])
    assert [(c.topic, c.key, c.writer, c.messages) for c in contents(path)] == [
        ("CAMERA_STATE", "psg/a/camera", "w", 2),
        ("CAMERA_STATE", "psg/a/camera", "other", 1),
        ("INGEST_STATE", "psg/a/ingest", "w", 1),
    ]
    assert summary(path) == {"CAMERA_STATE": 3, "INGEST_STATE": 1}


def test_attachments_and_metadata_survive(tmp_path):
    path = tmp_path / "a.mcap"
    with LogWriter(path) as log:
        log.add(**entry(0, 1))
        log.attach("regions.json", "application/json", b'{"regions": []}')
        log.metadata("source", {"from": "here"})
        log.attach("empty", "text/plain", b"")
    assert attachments(path) == {"regions.json": b'{"regions": []}', "empty": b""}
    assert metadata(path) == {"source": {"from": "here"}}
    assert len(as_dicts(path)) == 1


@pytest.mark.parametrize("share", [0.02, 0.3, 0.5, 0.77, 0.9, 0.999])
def test_a_log_cut_anywhere_gives_its_beginning(tmp_path, caplog, share):
    path, entries = tmp_path / "a.mcap", mixed_entries()
    write(path, entries)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(len(whole) * share)])
    found = as_dicts(path)
    assert found == entries[: len(found)]
    assert "cut off" in caplog.text
    lost_bytes = sum(len(e["payload"]) for e in entries[len(found) :])
    assert lost_bytes <= len(whole) * (1 - share) + 3_000_000  # at most the chunk at the cut beyond what was cut


def test_a_log_missing_only_its_index_loses_nothing(tmp_path):
    path, entries = tmp_path / "a.mcap", mixed_entries()
    write(path, entries)
    path.write_bytes(path.read_bytes()[:-8])
    assert as_dicts(path) == entries
    assert summary(path) == {"INGEST_STATE": 10, "CAMERA_STATE": 30}


def test_zeros_after_a_power_failure_end_the_log(tmp_path):
    path, entries = tmp_path / "a.mcap", mixed_entries()
    write(path, entries)
    whole = path.read_bytes()
    half = len(whole) // 2
    path.write_bytes(whole[:half] + bytes(len(whole) - half))
    found = as_dicts(path)
    assert 0 < len(found) < len(entries)
    assert found == entries[: len(found)]


def test_a_damaged_chunk_of_a_complete_log_is_reported(tmp_path):
    path = tmp_path / "a.mcap"
    write(path, mixed_entries())
    whole = bytearray(path.read_bytes())
    middle = len(whole) // 2
    whole[middle : middle + 64] = bytes(64)
    path.write_bytes(whole)
    with pytest.raises(LogError, match="damaged"):
        as_dicts(path)


def places(data):
    """Kind, beginning and end of each record of a log."""
    found, at = [], 8
    while at + 17 <= len(data):
        end = at + 9 + int.from_bytes(data[at + 1 : at + 9], "little")
        found.append((data[at], at, end))
        at = end
    return found


def chunks_of(data):
    return [(begin, end) for kind, begin, end in places(data) if kind == Opcode.CHUNK]


def with_zeros(data, begin, length=64):
    return data[:begin] + bytes(length) + data[begin + length :]


def read_despite(path):
    faults = []
    return [(m.writer, m.sequence) for m in read_log(path, damaged=faults.append)], faults


def test_a_damaged_chunk_of_a_log_without_an_index_hides_nothing_behind_it(tmp_path):
    path, entries = tmp_path / "a.mcap", mixed_entries()
    write(path, entries)
    whole = path.read_bytes()
    (begin, end), last = chunks_of(whole)[1], chunks_of(whole)[-1]
    path.write_bytes(with_zeros(whole, (begin + end) // 2)[: last[0] + 50])
    found, faults = read_despite(path)
    assert len(faults) == 1 and "damaged" in str(faults[0])
    assert any(sequence < 10 for _, sequence in found) and any(sequence > 25 for _, sequence in found)
    assert loss(path) == "it was cut off; its last 50 bytes are not read; damaged parts left out: 1"
    with pytest.raises(LogError, match="damaged"):
        as_dicts(path)


def test_a_chunk_that_was_zeroed_is_told_of(tmp_path):
    path = tmp_path / "a.mcap"
    write(path, mixed_entries())
    whole = path.read_bytes()
    begin, end = chunks_of(whole)[2]
    path.write_bytes(with_zeros(whole, begin, end - begin))
    found, faults = read_despite(path)
    assert len(faults) == 1 and 0 < len(found) < 40


@pytest.mark.parametrize("cut", [0, 30])
def test_a_log_behind_another_is_told_of(tmp_path, cut):
    path, entries = tmp_path / "a.mcap", mixed_entries()
    write(path, entries)
    whole = path.read_bytes()
    first = whole[: -cut or None]
    path.write_bytes(first + whole)
    found, _ = read_despite(path)
    assert found == [(e["writer"], e["sequence"]) for e in entries]
    assert loss(path).startswith(f"another log begins at byte {len(first)}, whose {len(whole)} bytes are not read")
    (tmp_path / "b.mcap").write_bytes(path.read_bytes()[len(first) :])
    assert loss(tmp_path / "b.mcap") == ""


def test_bytes_behind_the_end_and_a_damaged_index_are_told_apart(tmp_path):
    path, entries = tmp_path / "a.mcap", mixed_entries()
    write(path, entries)
    whole = path.read_bytes()
    assert loss(path) == ""
    path.write_bytes(whole + b"more")
    assert loss(path) == "the 4 bytes behind its end are none of it, and not read"
    statistics = next(begin for kind, begin, _ in places(whole) if kind == Opcode.STATISTICS)
    path.write_bytes(whole[: statistics + 9] + b"\x07" + whole[statistics + 10 :])
    assert loss(path) == "its index is damaged"
    assert as_dicts(path) == entries and summary(path) == {"INGEST_STATE": 10, "CAMERA_STATE": 30}


def test_a_changed_attachment_is_told_of_and_others_are_found_behind_damage(tmp_path):
    path = tmp_path / "a.mcap"
    with LogWriter(path) as log:
        log.add(**entry(0, 1))
        log.flush()
        log.attach("regions.json", "application/json", b'{"regions": []}')
    whole = path.read_bytes()
    (begin, _) = chunks_of(whole)[0]
    path.write_bytes(whole[: begin + 1] + b"\xff" * 4 + whole[begin + 5 :])  # the chunk's length
    assert attachments(path) == {"regions.json": b'{"regions": []}'}
    path.write_bytes(whole.replace(b'"regions"', b'"religion"'[:9]))
    with pytest.raises(LogError, match="attachment cannot be read"):
        attachments(path)


KILLED_WRITER = """
import os, signal, sys
from prior_sg.schemas.topics import CAMERA_STATE
from prior_sg.services.runtime.record import LogWriter
log = LogWriter(sys.argv[1])
for i in range(25):
    log.add(CAMERA_STATE, "k", b"%d" % i, "w", i, sent_ns=0, received_ns=i * 100_000_000)
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_killed_writer_loses_less_than_a_second_of_received_time(tmp_path):
    path = tmp_path / "a.mcap"
    ended = subprocess.run(
        [sys.executable, "-c", KILLED_WRITER, path], check=False, env=os.environ | {"PYTHONPATH": str(ROOT)}
    )
    assert ended.returncode == -signal.SIGKILL
    assert [m.payload for m in read_log(path)] == [b"%d" % i for i in range(21)]  # 0 s to 2.0 s


def test_flush_makes_messages_readable_at_once(tmp_path):
    path = tmp_path / "a.mcap"
    log = LogWriter(path)
    log.add(**entry(0, 1))
    assert as_dicts(path) == []
    log.flush()
    assert as_dicts(path) == [entry(0, 1)]
    log.close()
    log.close()


def test_topics_of_another_version_are_passed_over(tmp_path):
    path = tmp_path / "a.mcap"
    unknown = type(CAMERA_STATE)("RETIRED", IngestState, "psg/{robot}/retired", "every", 1, recorded=True)
    write(path, [entry(0, 1, unknown), entry(1, 2)])
    assert [m.sequence for m in read_log(path)] == [1]
    assert summary(path) == {"RETIRED": 1, "CAMERA_STATE": 1}


def write_reading(path, message, kind=None, cut=False):
    topic = reading.topic_of_version(kind or type(message))
    write(path, [entry(7, 123, topic, encode(message), key="psg/r/reading")])
    if cut:
        path.write_bytes(path.read_bytes()[:-8])


@pytest.mark.parametrize("cut", [False, True])
@pytest.mark.parametrize("old", [reading.FIRST, reading.SECOND, reading.THIRD])
def test_messages_of_an_older_version_are_read_as_ours(tmp_path, monkeypatch, old, cut):
    for step, function in reading.MIGRATIONS.items():
        monkeypatch.setitem(MIGRATIONS, step, function)
    path = tmp_path / "a.mcap"
    write_reading(path, old, cut=cut)
    (logged,) = read_log(path, (reading.READING,))
    assert (logged.topic, logged.sequence) == (reading.READING, 7)
    assert decode(reading.Reading, logged.payload) == reading.THIRD


@pytest.mark.parametrize("cut", [False, True])
def test_a_log_of_a_newer_version_or_of_another_message_is_refused(tmp_path, cut):
    path = tmp_path / "a.mcap"
    write_reading(path, reading.SECOND, cut=cut)
    with pytest.raises(LogError, match=r"cannot be read: Reading/2 is newer than this program's Reading/1; update it"):
        list(read_log(path, (reading.topic_of_version(reading.First.Reading),)))
    assert summary(path) == {"READING": 1}
    assert as_dicts(path, (CAMERA_STATE,)) == []  # nobody asked for what cannot be read
    write_reading(path, camera(3), cut=cut)
    with pytest.raises(LogError, match="CameraState/1 stands where a Reading/3 belongs"):
        list(read_log(path, (reading.READING,)))
    with pytest.raises(LogError, match="Reading/1 is too old for this program's Reading/3"):
        write_reading(path, reading.FIRST, cut=cut)
        list(read_log(path, (reading.READING,)))


@pytest.mark.parametrize("content", [b"", b"\x89MCAP", b"a,b\n1,2\n"])
def test_other_files_are_refused_in_one_sentence(tmp_path, content):
    path = tmp_path / "a.mcap"
    path.write_bytes(content)
    with pytest.raises(LogError, match="is not a log"):
        as_dicts(path)


def test_a_missing_log_and_an_unwritable_place_are_named(tmp_path):
    with pytest.raises(LogError, match="cannot be read"):
        as_dicts(tmp_path / "none.mcap")
    with pytest.raises(LogError, match="cannot be written"):
        LogWriter(tmp_path / "none" / "a.mcap")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
def test_a_full_disk_is_named():
    with pytest.raises(LogError, match="No space left"):
        LogWriter("/dev/full")


def test_every_topic_has_a_schema_that_a_log_can_hold(tmp_path):
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        for topic in TOPICS:
            log.add(topic, topic.name, b"", "w", 0, 0, 1)
    with path.open("rb") as file:
        schemas = make_reader(file).get_summary().schemas.values()
    assert {schema.name.split("/")[0] for schema in schemas} >= {topic.type.__name__ for topic in TOPICS}

"""An ingest that is started again: what it kept on disk, where it goes on, and what it cannot go on with."""

import asyncio
import os
import sqlite3
from contextlib import closing
from pathlib import Path

import msgspec
import numpy as np
import pytest

from prior_sg.schemas.features import Backfill
from prior_sg.schemas.frames import ArchiveRequest, PoseUpdate
from prior_sg.schemas.status import JobDone
from prior_sg.schemas.topics import ARCHIVE, ENCODE, KEYFRAME
from prior_sg.services.ingest import archive_file
from prior_sg.services.ingest.core import selection
from prior_sg.services.ingest.core.config import Config
from prior_sg.services.ingest.core.frames import BegunAnew, Closure, EndOfSource, RawFrame, Resumed
from prior_sg.services.ingest.service import SERVICE, drive, step
from prior_sg.services.ingest.sources.base import Source
from prior_sg.services.runtime.service import Identity
from tests.services.ingest.test_ingest import SECOND, dataset_folder, frame, pose


def rows(count, start_s=0):
    """Frames half a metre apart; every third rests where the one before was."""
    return [f"{i},{(start_s + i) * SECOND},{0.5 * (i - (i + 1) // 3)},0,1,0,0,0,1" for i in range(count)]


@pytest.fixture
def cfg(tmp_path):
    folder = dataset_folder(tmp_path / "home", rows(12))
    return Config(source=str(folder), archive_path=str(tmp_path / "out" / "keyframes.sqlite"))


class Process:
    """What a process of ingest does between its start and its end, of which `killed` leaves nothing out."""

    def __init__(self, cfg, robot="tiago", epoch=1, killed_after=None):
        self.cfg, self.stopping, self.killed_after = cfg, asyncio.Event(), killed_after
        self.consumed, self.outputs = [], []
        self.state = SERVICE.init(cfg, Identity(robot, "ingest-1", epoch))

    async def consume(self, message):
        self.consumed.append(message)
        self.outputs += self.take(message)
        if len(self.consumed) == self.killed_after:
            self.stopping.set()

    def take(self, message):
        return list(step(self.state, message, self.cfg))

    async def room(self, window):
        pass

    def driven(self):
        async def main():
            self.stopping = asyncio.Event()
            await asyncio.wait_for(drive(self, self.cfg), 20)

        asyncio.run(main())
        return self

    def done(self, *frame_ids):
        for frame_id in frame_ids:
            self.take(JobDone(topic="ENCODE", frame_id=frame_id, worker="w", attempts=1))

    def told(self, topic):
        return [message.frame_id for written, message in self.outputs if written is topic]

    @property
    def frames(self):
        return [message.frame_id for message in self.consumed if isinstance(message, RawFrame)]

    @property
    def progress(self):
        return selection.progress(self.state)[1]


def test_it_goes_on_behind_the_newest_keyframe_with_the_jobs_that_are_not_done(cfg):
    undisturbed = Process(msgspec.structs.replace(cfg, archive_path="")).driven()
    before = Process(cfg, killed_after=6).driven()
    assert before.told(KEYFRAME) == [0, 1, 3, 4]
    before.done(0, 1, 3)

    after = Process(cfg, epoch=2).driven()
    assert isinstance(after.consumed[0], Resumed) and isinstance(after.consumed[-1], EndOfSource)
    assert after.frames == list(range(5, 12))
    assert after.told(KEYFRAME) == [0, 1, 3, 4, *undisturbed.told(KEYFRAME)[4:]]  # readers may have missed the first
    assert after.told(ENCODE) == [4, *undisturbed.told(ENCODE)[4:]]
    after.done(*after.told(ENCODE))
    assert (after.progress.frames_read, after.progress.encoded, after.progress.finished) == (12, 8, True)
    assert after.progress.keyframes == undisturbed.progress.keyframes == 8

    archived = SERVICE.answers[ARCHIVE](after.state, ArchiveRequest(robot="tiago"), cfg)
    ours = SERVICE.answers[ARCHIVE](undisturbed.state, ArchiveRequest(robot="tiago"), cfg)
    assert archived == ours

    ended = Process(cfg, epoch=3).driven()
    assert ended.frames == [11] and ended.told(ENCODE) == [] and ended.progress.finished


def test_the_archive_answers_before_the_source_is_open(cfg):
    Process(cfg, killed_after=6).driven()
    archived = SERVICE.answers[ARCHIVE](Process(cfg).state, ArchiveRequest(robot="tiago"), cfg)
    assert [keyframe.frame_id for keyframe in archived.keyframes] == [0, 1, 3, 4]


def test_a_keyframe_is_kept_before_anybody_hears_of_it(cfg):
    process = Process(cfg)
    for topic, _ in step(process.state, frame(0, 0), cfg):
        if topic is KEYFRAME:
            break
    assert archive_file.left_off(cfg).frame_id == 0


def test_corrected_poses_and_wishes_that_were_heard_are_kept(cfg):
    before = Process(cfg, killed_after=6).driven()
    before.done(0, 1, 3, 4)
    moved = PoseUpdate(
        robot="tiago",
        epoch=1,
        revision=0,
        stamp_ns=0,
        frame_ids=np.array([1, 99]),
        world_from_camera=np.stack([pose(7.0), pose(8.0)]),
    )
    before.take(moved)
    wish = Backfill(robot="tiago", space="s", frame_ids=np.zeros(0, int), settled=True, epoch=5, number=1)
    assert [job.frame_id for _, job in before.take(wish)] == [0, 1, 3, 4]

    after = Process(cfg)
    assert [keyframe.world_from_camera[0, 3] for keyframe in after.state.archive] == [0.0, 7.0, 1.0, 1.5]
    assert after.take(wish) == []  # from its writer's cache
    newer = msgspec.structs.replace(wish, number=2, frame_ids=np.array([0, 1, 4]))
    assert [job.frame_id for _, job in after.take(newer)] == [3]
    other = msgspec.structs.replace(wish, epoch=6, frame_ids=np.array([0, 1, 3]))
    assert [job.frame_id for _, job in after.take(other)] == [4]
    old = msgspec.structs.replace(wish, epoch=0, number=0, frame_ids=np.array([0, 1, 3]))  # of an older version
    assert [job.frame_id for _, job in after.take(old)] == [4]


def test_what_leaves_the_archive_leaves_the_file(cfg, tmp_path):
    size = len(frame(0, 0).color) + len(frame(0, 0).depth)
    small = msgspec.structs.replace(cfg, archive_mb=3.5 * size / 1e6)
    before = Process(small, killed_after=10).driven()
    before.done(*before.told(ENCODE))
    with closing(sqlite3.connect(cfg.archive_path)) as sql:
        assert [row[0] for row in sql.execute("SELECT frame_id FROM keyframes")] == [6, 7, 9]
    smaller = msgspec.structs.replace(cfg, archive_mb=1.5 * size / 1e6)
    assert [keyframe.frame_id for keyframe in Process(smaller).state.archive] == [9]


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"robot": "other"}, "its robot is tiago"),
        ({"source": True}, "its source is"),
        ({"min_translation_m": 0.1}, "other settings"),
        ({"depth_scale_m": 0.002}, "other settings"),
    ],
    ids=str,
)
def test_an_archive_of_something_else_is_put_aside(cfg, tmp_path, changes, said, caplog):
    Process(cfg, killed_after=6).driven()
    if "source" in changes:
        changes = {"source": str(dataset_folder(tmp_path / "other", rows(4)))}
    robot = changes.pop("robot", "tiago")
    other = msgspec.structs.replace(cfg, **changes)
    process = Process(other, robot=robot).driven()
    assert said in caplog.text and caplog.text.count("not gone on with") == 1
    assert process.frames[0] == 0
    assert Process(other, robot=robot).state.keyframes == len(process.told(KEYFRAME))


def test_pace_and_size_are_no_other_settings(cfg):
    Process(cfg, killed_after=6).driven()
    assert Process(msgspec.structs.replace(cfg, window=3, archive_mb=100.0, speed=2.0)).state.keyframes == 4


@pytest.mark.parametrize("fault", ["no database", "torn", "payload", "checkpoint"])
def test_a_damaged_archive_is_one_sentence_and_a_new_one(cfg, fault, caplog):
    before = Process(cfg, killed_after=6).driven()
    before.state.keeper.close()
    path = Path(cfg.archive_path)
    if fault == "no database":
        path.write_bytes(os.urandom(4096) + path.read_bytes()[4096:])
    elif fault == "torn":
        os.truncate(path, path.stat().st_size // 2)
    else:
        with closing(sqlite3.connect(path)) as sql, sql:
            sql.execute(
                "UPDATE keyframes SET payload = x'00'" if fault == "payload" else "UPDATE about SET value = 'x'"
            )
    process = Process(cfg).driven()
    assert process.frames == list(range(12))
    (warning,) = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert "keyframes.sqlite" in warning and "a new one begins" in warning
    assert Process(cfg).state.keyframes == 8


def test_a_file_of_another_program_is_left_alone(cfg, caplog):
    Path(cfg.archive_path).parent.mkdir()
    with closing(sqlite3.connect(cfg.archive_path)) as sql:
        sql.execute("CREATE TABLE theirs (x)")
    assert Process(cfg).driven().frames == list(range(12))
    assert "another program" in caplog.text
    with closing(sqlite3.connect(cfg.archive_path)) as sql:
        assert [row[0] for row in sql.execute("SELECT name FROM sqlite_master")] == ["theirs"]


def test_a_source_that_has_changed_is_read_from_its_beginning(cfg, tmp_path, caplog):
    Process(cfg, killed_after=6).driven()
    (tmp_path / "home" / "trajectory.csv").write_text(
        "\n".join(("frame,stamp_ns,x_m,y_m,z_m,qx,qy,qz,qw", *rows(12, start_s=5))) + "\n"
    )
    process = Process(cfg).driven()
    assert isinstance(process.consumed[0], BegunAnew) and process.frames == list(range(12))
    assert process.told(KEYFRAME) == [0, 1, 3, 4, 6, 7, 9, 10]
    assert "it has changed" in caplog.text
    assert Process(cfg).driven().frames == [11]


def test_a_full_disk_is_one_sentence_and_the_stream_goes_on(cfg, caplog):
    process = Process(cfg)
    pages = process.state.keeper._sql.execute("PRAGMA page_count").fetchone()[0]
    process.state.keeper._sql.execute(f"PRAGMA max_page_count = {pages + 1}")  # what SQLite says is as on a full disk
    process.driven()
    assert process.told(KEYFRAME) == [0, 1, 3, 4, 6, 7, 9, 10]
    (warning,) = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert "no longer kept" in warning and "full" in warning
    (loss,) = process.progress.losses
    assert loss.what == "keyframes not kept on disk" and 0 < loss.count < 8
    assert not Path(cfg.archive_path).exists()
    assert Process(cfg).driven().frames == list(range(12))


def test_a_folder_that_cannot_be_written_is_one_sentence(cfg, tmp_path, caplog):
    (tmp_path / "file").write_text("")
    process = Process(msgspec.structs.replace(cfg, archive_path=str(tmp_path / "file" / "k.sqlite"))).driven()
    assert process.frames == list(range(12))
    (warning,) = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert "no keyframes are kept" in warning


def robot_of(frames):
    """A running robot that sends these."""
    first = frames[0]
    return Source("ros2", None, first.intrinsics, 0, lambda: iter(()), live=lambda: iter(frames))


def test_a_robot_goes_on_with_numbers_that_rise(cfg, monkeypatch):
    live = msgspec.structs.replace(cfg, source="ros2:/tcp/127.0.0.1:7447")
    sent = [frame(i, 100 + i, x=0.5 * i, total=0) for i in range(4)]
    monkeypatch.setattr("prior_sg.services.ingest.service.open_source", lambda path, options: robot_of(sent))
    before = Process(live).driven()
    assert before.told(KEYFRAME) == [0, 1, 2, 3]
    before.done(0, 1, 2, 3)
    before.take(Closure(stamp_ns=0, after_from_before=pose(0.5)))  # its SLAM has moved the world

    sent = [frame(i, 200 + i, x=2.5 + 0.5 * i, total=0) for i in range(3)]
    monkeypatch.setattr("prior_sg.services.ingest.service.open_source", lambda path, options: robot_of(sent))
    after = Process(live).driven()
    assert after.told(KEYFRAME) == [0, 1, 2, 3, 4, 5, 6] and after.told(ENCODE) == [4, 5, 6]
    assert after.progress.rejected == 0
    assert after.state.trail[0].frame_id == 4  # those before are of the world as it was


def test_a_robot_that_was_away_for_long_begins_anew(cfg, monkeypatch, caplog):
    live = msgspec.structs.replace(cfg, source="ros2:/tcp/127.0.0.1:7447")
    sent = [frame(i, 100 + i, x=0.5 * i, total=0) for i in range(4)]
    monkeypatch.setattr("prior_sg.services.ingest.service.open_source", lambda path, options: robot_of(sent))
    Process(live).driven()
    now_s = Path(f"{cfg.archive_path}-wal").stat().st_mtime
    assert archive_file.opened(live, "tiago", lambda: now_s + 1.0)[1] is not None
    assert archive_file.opened(live, "tiago", lambda: now_s + archive_file.LIVE_GAP_S + 1.0)[1] is None
    assert "another world" in caplog.text
    assert Process(live).state.keyframes == 0

"""The past as programs ask for it: of a running store, of its file, of a log."""

import os
import sqlite3

import numpy as np
import pytest

import prior_sg
from prior_sg.deploy.api.client import Client
from prior_sg.schemas.codec import decode, encode
from prior_sg.schemas.topics import HISTORY, OBJECT_DELTA, PLACE_DELTA, REGION_DELTA, SCENE, TASK, topic_of
from prior_sg.services.runtime.bus import Hub, LocalBus
from prior_sg.services.runtime.record import LogWriter
from prior_sg.services.runtime.service import ServiceError
from tests.services.scene_store.test_history import whole_run
from tests.services.scene_store.test_scene_store import ROBOT, Store


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A store that goes on, its file, and a log of what it read."""
    folder = tmp_path_factory.mktemp("run")
    store = Store(folder / "scene.sqlite")
    with LogWriter(folder / "log.mcap") as log:
        for i, message in enumerate(whole_run(3, steps=8)):
            store.feed(message)
            topic = topic_of(type(message))
            assert topic in (PLACE_DELTA, REGION_DELTA, OBJECT_DELTA, TASK)
            log.add(topic, topic.key_of(message), encode(message), "w", i, i, i)
    yield store, folder
    store.runner.close()


@pytest.mark.parametrize("name", ["scene.sqlite", "log.mcap"])
def test_a_file_and_a_log_hold_what_the_store_answers(run, name):
    store, folder = run
    with prior_sg.open_history(folder / name) as history:
        assert history.robots == [ROBOT]
        revisions = [row.revision for row in history.revisions(ROBOT)]
        assert revisions == list(range(store.scene().revision + 1)) and len(revisions) > 10
        for revision in np.random.default_rng(0).permutation(revisions).tolist():
            assert encode(history.scene(ROBOT, revision).message) == encode(store.scene(revision=revision))
        assert encode(history.scene(ROBOT).message) == encode(store.scene())
        stamp_ns = history.scene(ROBOT, revisions[4]).stamp_ns
        assert encode(history.scene(ROBOT, stamp_ns=stamp_ns).message) == encode(store.scene(stamp_ns=stamp_ns))
        with pytest.raises(prior_sg.NotInSceneError, match="revision 9999 of spot is not kept"):
            history.scene(ROBOT, 9999)
        with pytest.raises(prior_sg.NotInSceneError, match="nothing is kept of spot at 0 ns"):
            history.scene(ROBOT, stamp_ns=0)
        assert history.revisions("nobody") == [] and history.scene("nobody").revision == -1


def test_what_is_not_there_is_said(tmp_path):
    with pytest.raises(ServiceError, match="does not exist or is no file"):
        prior_sg.open_history(tmp_path / "scene.sqlite")
    assert not (tmp_path / "scene.sqlite").exists()
    with pytest.raises(prior_sg.Error, match=r"log\.mcap cannot be read"):
        prior_sg.open_history(tmp_path / "log.mcap")


def test_reading_changes_no_file(run, tmp_path):
    _, folder = run
    empty = tmp_path / "empty.sqlite"
    empty.touch()
    with pytest.raises(ServiceError, match="it holds no scenes"):
        prior_sg.open_history(empty)
    assert empty.stat().st_size == 0
    source, copied = sqlite3.connect(folder / "scene.sqlite"), sqlite3.connect(tmp_path / "scene.sqlite")
    source.backup(copied)
    source.close(), copied.close()
    before = (tmp_path / "scene.sqlite").read_bytes()
    with prior_sg.open_history(tmp_path / "scene.sqlite") as history:
        assert history.revisions(ROBOT)
    assert (tmp_path / "scene.sqlite").read_bytes() == before
    assert sorted(file.name for file in tmp_path.iterdir()) == ["empty.sqlite", "scene.sqlite"]


def test_where_nothing_can_be_written_the_past_is_read(run, tmp_path, monkeypatch):
    store, folder = run
    shelf = tmp_path / "a shelf?"
    shelf.mkdir()
    source, copied = sqlite3.connect(folder / "scene.sqlite"), sqlite3.connect(shelf / "scene.sqlite")
    source.backup(copied)
    source.close(), copied.close()
    if os.geteuid():
        shelf.chmod(0o555)
    else:  # nothing is read-only for root
        monkeypatch.setattr(os, "access", lambda path, mode: False)
    with prior_sg.open_history(shelf / "scene.sqlite") as history:
        assert encode(history.scene(ROBOT).message) == encode(store.scene())
        assert [file.name for file in shelf.iterdir()] == ["scene.sqlite"]
    shelf.chmod(0o755)


def test_garbage_in_a_log_is_passed_over(tmp_path):
    with LogWriter(tmp_path / "log.mcap") as log:
        for i, message in enumerate(whole_run(3, steps=2)):
            topic = topic_of(type(message))
            log.add(topic, topic.key_of(message), b"garbage", "w", i, i, i)
            log.add(topic, topic.key_of(message), encode(message), "w", i, i, i)
    with prior_sg.open_history(tmp_path / "log.mcap") as history:
        assert history.revisions(ROBOT)


@pytest.mark.parametrize("size", [0, 7, 8, 1000, 20_000])
def test_a_log_that_is_cut_off_is_read_as_far_as_it_goes(run, tmp_path, size):
    _, folder = run
    (tmp_path / "log.mcap").write_bytes((folder / "log.mcap").read_bytes()[:size])
    if size < 8:
        with pytest.raises(prior_sg.Error, match="not a log"):
            prior_sg.open_history(tmp_path / "log.mcap")
    else:
        with prior_sg.open_history(tmp_path / "log.mcap") as history:
            assert history.robots in ([], [ROBOT])


def test_addresses_that_cannot_be_used_are_told():
    with pytest.raises(ServiceError, match="PGPASSWORD"):
        prior_sg.open_history("postgresql://me:secret@127.0.0.1/scenes")


def test_a_client_asks_a_running_store(run):
    store, _ = run
    hub = Hub()
    bus = LocalBus(hub)
    for query in (SCENE, HISTORY):
        answer = store.runner.service.answers[query]

        def reply(request, query=query, answer=answer):
            request.reply(encode(answer(store.state, decode(query.request, request.payload), store.cfg)))

        bus.serve(query.key.format(robot=ROBOT), reply)
    with Client(robot=ROBOT, bus=LocalBus(hub)) as client:
        present = client.scene()
        revisions = client.history()
        assert [row.revision for row in revisions] == list(range(present.revision + 1))
        assert [row.revision for row in client.history(limit=2, before=5)] == [3, 4]
        early = client.scene(revision=3)
        assert early.revision == 3 and encode(early.message) == encode(store.scene(revision=3))
        assert client.scene(stamp_ns=early.stamp_ns).stamp_ns == early.stamp_ns
        with pytest.raises(prior_sg.NotInSceneError):
            client.scene(revision=10**6)

"""Journals of another version: what has changed in the settings is told, what cannot be read is refused. And how the
scene at the end of a log is judged."""

import msgspec
import pytest

from prior_sg.deploy.cli.report import final_scene_difference
from prior_sg.deploy.inspecting.replay import Log, open_log, recorded_config, replay_life
from prior_sg.schemas.codec import encode
from prior_sg.schemas.priors import Task
from prior_sg.schemas.status import Consumed, Started
from prior_sg.schemas.topics import JOURNAL, TASK, topic_of
from prior_sg.services.runtime.record import LogError, LogWriter
from prior_sg.services.scene_store.service import SERVICE as SCENE_STORE
from prior_sg.services.segmenter.service import SERVICE
from tests.services.scene_store.test_history import object_delta
from tests.services.scene_store.test_scene_store import Store, random_run, snapshots_of


def journal(path, config, versions, inline):
    """A log of one life of the segmenter, which took one task of a writer that did not say who it is."""
    started = Started(robot="r", service="segmenter", instance="s1", epoch=5, config=config, versions=versions)
    with LogWriter(path) as log:
        for order, (topic, data) in enumerate([("START", encode(started)), (TASK.name, inline), ("STOP", b"")]):
            entry = Consumed(robot="r", service="segmenter", instance="s1", order=order, topic=topic, inline=data)
            log.add(JOURNAL, JOURNAL.pattern("r"), encode(entry), "segmenter/s1/5", order, 0, order)
    return open_log(path, "segmenter")


def config(**changes):
    return msgspec.json.encode(msgspec.to_builtins(SERVICE.config()) | changes)


TASK_INLINE = encode(Task(robot="r", stamp_ns=1, environment="e", task="t"))


def test_a_journal_with_other_settings_is_replayed_and_the_difference_told(tmp_path, caplog):
    values = msgspec.json.decode(config(retired=4))
    del values["space"]
    log = journal(tmp_path / "a.mcap", msgspec.json.encode(values), {}, TASK_INLINE)
    assert recorded_config(log, log.lives[0]) == SERVICE.replay_config(SERVICE.config())
    assert [record.getMessage() for record in caplog.records] == [
        "segmenter.retired = 4 was recorded, and is no setting any more: it is left out",
        "segmenter.space was not a setting yet: it gets its default",
    ]
    assert list(replay_life(log, log.lives[0])) == []


def test_a_recorded_setting_that_does_not_fit_is_one_sentence(tmp_path):
    log = journal(tmp_path / "a.mcap", config(space=[1]), {}, TASK_INLINE)
    with pytest.raises(LogError, match=r"the journal of s1 cannot be replayed: .* segmenter does not fit .*\$.space"):
        recorded_config(log, log.lives[0])


def test_what_a_journal_holds_inline_is_of_the_version_that_its_start_tells(tmp_path):
    log = journal(tmp_path / "a.mcap", config(), {"Task": 2}, TASK_INLINE)
    with pytest.raises(LogError, match="the journal of s1 cannot be replayed: Task/2 is newer"):
        list(replay_life(log, log.lives[0]))
    log = journal(tmp_path / "a.mcap", config(), {}, b"\xc1")
    with pytest.raises(LogError, match="the journal of s1 cannot be replayed: Task/1"):
        list(replay_life(log, log.lives[0]))


def difference_at_the_end(path, deltas, scene):
    """Of a scene from one where a store has read these deltas and nothing else."""
    with LogWriter(path) as log:
        for i, delta in enumerate(deltas):
            topic = topic_of(type(delta))
            log.add(topic, topic.key_of(delta), encode(delta), "w", i, i, i)
        log.attach("scene.msgpack", "application/msgpack", encode(scene))
    return final_scene_difference(Log(path, SCENE_STORE), path)


def test_a_store_that_took_snapshots_ends_with_the_scene_of_one_that_did_not(tmp_path):
    """Whether they stood for several deltas or were the answer of a writer that had told nothing yet."""
    deltas = [*random_run(1, steps=10)[0], object_delta(0, 2)]
    whole, jumping, early = Store(), Store(), Store()
    whole.feed(*deltas[:20])
    jumping.feed(*deltas[:8], *snapshots_of(whole, 9, 9), deltas[-1])
    early.feed(object_delta(-1, 0, snapshot=True), *deltas)
    scenes = [jumping.scene(), early.scene()]
    assert [scene.revision for scene in scenes] == [8 + 2 + 1 - 1, len(deltas) + 1 - 1]
    for i, scene in enumerate(scenes):
        assert difference_at_the_end(tmp_path / f"{i}.mcap", deltas, scene) == ""
    other = msgspec.structs.replace(scenes[0], task="other")
    assert difference_at_the_end(tmp_path / "o.mcap", deltas, other) == "final scene: task: 'other' became 'clean'"

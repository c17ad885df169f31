"""Journals of another version: what has changed in the settings is told, what cannot be read is refused."""

import msgspec
import pytest

from prior_sg.deploy.inspecting.replay import open_log, recorded_config, replay_life
from prior_sg.schemas.codec import encode
from prior_sg.schemas.priors import Task
from prior_sg.schemas.status import Consumed, Started
from prior_sg.schemas.topics import JOURNAL, TASK
from prior_sg.services.runtime.record import LogError, LogWriter
from prior_sg.services.segmenter.service import SERVICE


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

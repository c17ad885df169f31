"""Where inputs wait: bounded, whoever sends."""

from prior_sg.schemas.topics import CAMERA_STATE, TASK
from prior_sg.services.runtime.bus import Sample
from prior_sg.services.runtime.host import inbox as inboxes
from prior_sg.services.runtime.host.inbox import Inbox


def sample(topic, writer, sequence):
    return Sample(topic, topic.pattern("r"), b"", writer, sequence, 0)


def test_a_flood_fills_no_memory_and_what_is_lost_is_counted(monkeypatch):
    monkeypatch.setattr(inboxes, "MOST_WAITING", 10)
    inbox = Inbox(wake=lambda: None)
    for number in range(50):
        inbox.offer(sample(TASK, "w", number))
        inbox.offer(sample(CAMERA_STATE, "w", number))
    inbox.put("a question", first=True)
    assert len(inbox) == 10 + 1 and inbox.take() == "a question"
    assert inbox.of("TASK").missed == 41 and inbox.of("CAMERA_STATE").missed == 0
    newest = [one for one in inbox.waiting() if one.topic is CAMERA_STATE]
    assert [one.sequence for one in newest] == [49]


def test_only_what_comes_first_is_taken_out_by_its_kind():
    inbox = Inbox(wake=lambda: None)
    inbox.put(1)
    assert inbox.take_first(str) is None
    inbox.put("a question", first=True)
    assert inbox.take_first(str) == "a question" and inbox.take_first(str) is None and inbox.take() == 1


def test_writers_that_never_come_again_are_forgotten_and_the_busy_one_is_not(monkeypatch):
    monkeypatch.setattr(inboxes, "MOST_WRITERS", 4)
    inbox = Inbox(wake=lambda: None)
    for number in range(40):
        inbox.offer(sample(TASK, "busy", number))
        inbox.offer(sample(TASK, f"stranger{number}", 0))
    inbox.offer(sample(TASK, "busy", 39))
    assert inbox.of("TASK").duplicate == 1 and inbox.of("TASK").missed == 0
    assert len(inbox._sequences) <= 5

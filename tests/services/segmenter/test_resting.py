"""Labels of a resting map found in slices: as at once, given up for news, and unseen until they are found."""

import pytest

from prior_sg.schemas.codec import encode
from prior_sg.schemas.regions import PosteriorRequest
from prior_sg.schemas.topics import OBJECT_DELTA, POSTERIOR, REGION_DELTA
from prior_sg.services.segmenter.core import resting
from tests.help.world import ROBOT
from tests.services.segmenter.test_same_evidence import REST, TICK, assert_same, ended, inputs


def messages(given):
    return [*given.aim, *given.deltas, *(message for pair in given.frames for message in pair)]


def rested(runner):
    """Feed ticks until the labels are found anew; how many it took, and all that was told."""
    told = []
    for ticks in range(1, 200):
        told += runner.feed(TICK)
        if not runner.state.labelling.dirty:
            return ticks, [encode(message) for topic, message in told if topic in (REGION_DELTA, OBJECT_DELTA)]
    raise AssertionError("it never rests")


def hurried(given):
    """All was told, and nothing rests yet."""
    runner = ended([])
    runner.feed(*messages(given))
    return runner


def test_slices_hold_so_much_and_a_larger_part_is_one():
    done = []

    def parts():
        for visits in (3, 4, 4, 20, 1, 9, 2):
            yield visits
            done.append(visits)

    slices = [list(done) for _ in resting.sliced(parts(), 10)]
    assert slices == [[3, 4], [3, 4, 4], [3, 4, 4, 20], [3, 4, 4, 20, 1, 9]] and len(done) == 7


@pytest.mark.parametrize("contents", [False, True], ids=["looks", "contents"])
def test_slices_end_in_what_is_found_at_once(monkeypatch, contents):
    given = inputs(1, contents)
    whole, told = rested(hurried(given))
    monkeypatch.setattr(resting, "SLICE_VISITS", 400)
    ticks, told_in_slices = rested(hurried(given))
    assert ticks > whole + 4
    assert told_in_slices == told


def test_labels_in_force_answer_until_others_are_found(monkeypatch):
    monkeypatch.setattr(resting, "SLICE_VISITS", 400)
    runner = hurried(inputs(2))
    while runner.state.labelling.under_way is None:
        runner.feed(TICK)
    places = runner.state.map.graph.ids[::7].tolist()
    before = [runner.answer(POSTERIOR, PosteriorRequest(robot=ROBOT, place_id=place)) for place in places]
    while runner.state.labelling.under_way is not None:
        during = [runner.answer(POSTERIOR, PosteriorRequest(robot=ROBOT, place_id=place)) for place in places]
        assert during == before
        runner.feed(TICK)


@pytest.mark.parametrize("slices", [1, 3, 9])
def test_what_is_news_amid_slices_is_taken_in_at_once_and_the_work_done_again(monkeypatch, slices):
    given = inputs(3)
    undisturbed = ended(messages(given))
    monkeypatch.setattr(resting, "SLICE_VISITS", 400)
    runner = hurried(given._replace(frames=given.frames[:-1]))
    while runner.state.labelling.under_way is None:
        runner.feed(TICK)
    runner.feed(*[TICK] * (slices - 1))
    assert runner.state.labelling.under_way is not None
    former = runner.state.map.places
    told = runner.feed(*given.frames[-1])
    assert runner.state.labelling.under_way is None and runner.state.map.places is former
    assert [topic for topic, _ in told] == [REGION_DELTA]
    rested(runner)
    runner.feed(*REST)
    assert_same(undisturbed, runner)

"""Another encoder takes over in mid-run: it covers the map first, the old one serves until then, no place loses its
label."""

import msgspec
import numpy as np

from prior_sg.schemas.topics import BACKFILL, REGION_DELTA, TEXT
from prior_sg.services.segmenter.core.config import Config
from prior_sg.services.segmenter.core.evidence.handover import SpacesConfig
from tests.help.world import SPACE, place_delta, prior, task, text, walk
from tests.services.segmenter.test_update import ROOMS, TICK, Run, finished, world

NEW = "new/space"
CFG = Config(spaces=SpacesConfig(backfill_ticks=2, repeat_ticks=4, patience_ticks=6, silent_frames=3))


def turned(frames, space=NEW):
    """The same pyramids as another encoder would see them: the rooms lie in other dimensions of the embedding."""
    flipped = (np.ascontiguousarray(frame.embeddings[:, ::-1]) for frame in frames)
    return [
        msgspec.structs.replace(frame, space=space, embeddings=embeddings)
        for frame, embeddings in zip(frames, flipped, strict=True)
    ]


class TwoSpaces(Run):
    """A run whose text questions are answered in either space, and that keeps what it wants of ingest."""

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.wishes, self.asked_spaces, self.silent = [], [], set()

    def answer(self, query, request):
        if query is not TEXT:
            return None
        self.asked_spaces.append(request.space)
        return None if request.space in self.silent else self.text(request)

    def feed(self, *messages, answer_text=True):
        for topic, message in self.runner.feed(*messages):
            if topic is BACKFILL:
                self.wishes.append(message)
            elif topic is REGION_DELTA:
                self.deltas.append(message)
                self.reader.apply(message)
        return self

    def text(self, request):
        answer = text(self.concepts[: len(request.concepts)], space=request.space)
        turned_round = np.ascontiguousarray(answer.embeddings[:, ::-1]) if request.space == NEW else answer.embeddings
        return msgspec.structs.replace(answer, embeddings=turned_round)


def started():
    positions, edges, frames = world()
    run = TwoSpaces(cfg=CFG).feed(place_delta(positions, edges), task(), prior(ROOMS), *frames, TICK)
    assert len(set(run.labels().values())) == 3
    return run, frames


def test_a_new_space_is_filled_up_and_takes_over_without_a_label_lost():
    run, frames = started()
    before = run.labels()
    run.feed(TICK, TICK, TICK)
    first = run.wishes.pop()  # once after the start: what this process may have missed
    assert first.settled and not run.wishes
    assert first.space == SPACE and first.frame_ids.tolist() == [frame.frame_id for frame in frames]
    new = turned(frames)
    run.feed(*new[-3:])
    run.feed(TICK, TICK)
    (wish,) = run.wishes
    assert wish.space == NEW and wish.frame_ids.tolist() == [frame.frame_id for frame in frames[-3:]]
    for frame in new[:-3]:
        run.feed(frame, TICK)
        assert run.state.seen.spaces.force in (SPACE, NEW) and set(run.labels()) == set(before)
        assert all(label in ROOMS for label in run.labels().values())
        if frame is not new[-4]:
            assert run.state.seen.spaces.force == SPACE and run.deltas[-1].space == SPACE
    run.feed(TICK)
    assert run.state.seen.spaces.force == NEW and run.asked_spaces == [SPACE, NEW]
    assert run.labels() == before and run.deltas[-1].space == NEW
    assert run.state.seen.archive.frame_ids == {frame.frame_id for frame in frames}


def test_a_stream_that_goes_on_does_not_hold_up_the_change():
    """The newest keyframes reach the old space first, always: those on the way are not waited for, older ones are."""
    positions, edges, frames = world()
    new = turned(frames)
    run = TwoSpaces(cfg=CFG).feed(place_delta(positions, edges), task(), prior(ROOMS), *frames[:-2], TICK)
    run.feed(*new[:-6], *frames[-2:], TICK)  # six are missing, of which three may be on the way
    assert run.state.seen.spaces.force == SPACE
    run.feed(*new[-5:-3], TICK)  # three are newer than all it has, and an older one is missing
    assert run.state.seen.spaces.force == SPACE
    run.feed(new[-6], TICK, TICK)  # its words are asked for first
    assert run.state.seen.spaces.force == NEW
    run.feed(*new[-3:], TICK)
    assert run.state.seen.archive.frame_ids == {frame.frame_id for frame in frames}


def test_evidence_after_the_change_is_that_of_a_run_in_the_new_space():
    run, frames = started()
    run.feed(*turned(frames), TICK, TICK)
    assert run.state.seen.spaces.force == NEW
    alone = TwoSpaces(cfg=msgspec.structs.replace(CFG, space=NEW))
    positions, edges, _ = world()
    alone.feed(place_delta(positions, edges), task(), prior(ROOMS), *turned(frames), TICK)
    ids = run.state.map.graph.ids.tolist()
    ours, theirs = (r.state.seen.evidence.descriptors(r.state.seen.evidence.of(ids)) for r in (run, alone))
    np.testing.assert_allclose(ours, theirs, atol=1e-6)
    assert run.labels() == alone.labels()


def test_a_space_without_answers_never_takes_over():
    """Its workers are gone before they have embedded the prior's words: the old space serves on, tasks still change."""
    run, frames = started()
    run.silent = {NEW}
    run.feed(*turned(frames), *[TICK] * 5)
    assert run.state.seen.spaces.force == SPACE and run.asked_spaces.count(NEW) == 1
    run.feed(task("cook", stamp_ns=6), prior(ROOMS[::-1], name="cook"), TICK)
    assert run.state.aim.in_force.prior.task == "cook"


def test_frames_that_cannot_be_had_hinder_only_when_places_depend_on_them():
    run, frames = started()
    new = turned(frames)
    room = len(frames) // 3
    run.feed(*new[2 * room :], *[TICK] * 12)  # two rooms are missing, and the ring has forgotten them
    assert run.state.seen.spaces.force == SPACE
    assert len(run.wishes) >= 3  # asked again and again
    run.feed(*(frame for frame in new[: 2 * room] if frame.frame_id % 4), *[TICK] * 8)  # three quarters: enough to see
    assert run.state.seen.spaces.force == NEW


def test_two_pools_side_by_side_do_not_flicker_and_a_silent_one_gives_way():
    run, frames = started()
    run.feed(*turned(frames), TICK, TICK)
    assert run.state.seen.spaces.force == NEW
    again = [msgspec.structs.replace(frame, frame_id=100 + frame.frame_id) for frame in frames]
    for old, new in zip(again, turned(again), strict=True):  # the old workers go on beside the new
        run.feed(old, new, TICK)
        assert run.state.seen.spaces.force == NEW
    later = [msgspec.structs.replace(frame, frame_id=200 + frame.frame_id) for frame in frames]
    run.feed(*later, *[TICK] * 3)  # the new ones are gone
    assert run.wishes[-1].space == SPACE
    run.feed(*frames, *again, TICK, TICK)
    assert run.state.seen.spaces.force == SPACE and set(run.labels().values()) == set(ROOMS)


def test_another_space_that_was_there_from_the_start_waits():
    positions, edges, frames = world()
    run = TwoSpaces(cfg=CFG).feed(turned(frames)[0], place_delta(positions, edges), task(), prior(ROOMS))
    for old, new in zip(frames, turned(frames), strict=True):
        run.feed(new, old)
    run.feed(*[TICK] * 8)
    assert run.state.seen.spaces.force == SPACE


def test_following_can_be_switched_off():
    cfg = Config(spaces=SpacesConfig(follow=False))
    run, _ = finished(cfg=cfg)
    run.feed(*turned(walk(3)), TICK)
    assert run.state.seen.spaces.force == SPACE and not run.state.seen.spaces.rivals
    assert run.state.seen.losses.count("pyramids ignored") == len(walk(3))

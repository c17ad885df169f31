"""A segmenter goes on where another was: silent until it has caught up, with the same ids for regions and objects."""

import msgspec
import numpy as np
import pytest

from prior_sg.schemas.objects import SceneObject
from prior_sg.schemas.places import PlaceDelta, SnapshotRequest
from prior_sg.schemas.scene import Scene
from prior_sg.schemas.status import Tick
from prior_sg.schemas.succession import EvidenceRequest, Succession, TakesOver
from prior_sg.schemas.topics import (
    EVIDENCE,
    OBJECT_SNAPSHOT,
    PLACE_SNAPSHOT,
    REGION_DELTA,
    REGION_SNAPSHOT,
    SCENE,
    TEXT,
)
from prior_sg.services.refusals import NotYet
from prior_sg.services.runtime.runner import Runner
from prior_sg.services.runtime.service import Identity
from prior_sg.services.segmenter.core import succession
from prior_sg.services.segmenter.core.config import Config
from prior_sg.services.segmenter.core.update import lacking
from prior_sg.services.segmenter.service import SERVICE, bequest
from tests.help.examples import EXAMPLES
from tests.help.world import ROBOT, place_delta, place_grid, prior, task, text, walk

ROOMS = ["kitchen", "hall", "bedroom"]
CFG = Config()
POSITIONS, EDGES = place_grid(3)
FRAMES = walk(3)
SNAPSHOT = SnapshotRequest(robot=ROBOT)


def places(**changes) -> PlaceDelta:
    return place_delta(POSITIONS, EDGES, **changes)


def embed(request):
    return text(np.eye(3)[: len(request.concepts)])


def runner(instance, epoch):
    named = {TEXT: embed, PLACE_SNAPSHOT: lambda request: places(snapshot=True, revision=5)}
    return Runner(SERVICE, CFG, Identity(ROBOT, instance, epoch), named, wire=True)


def ticks(count):
    return [Tick(stamp_ns=10**18 + n) for n in range(count)]


def predecessor(frames=FRAMES):
    """One whose region ids are not what a newcomer would number first."""
    first = runner("first", 1)
    first.state.regions.next_id = 40
    first.feed(places(revision=0), task("x"), prior(["all"], "x"), *frames[:3], *ticks(2))
    first.feed(task(), prior(ROOMS), *frames[3:], *ticks(4))
    return first


@pytest.fixture
def first():
    return predecessor()


def successor(first):
    answers = {REGION_SNAPSHOT: first, OBJECT_SNAPSHOT: first, EVIDENCE: first}
    second = runner("second", 2)
    second.answers.update(answers)
    return second


def told(outputs):
    return [message for topic, message in outputs if topic is REGION_DELTA]


def regions_of(snapshot):
    names = {region.id: region.label for region in snapshot.regions}
    pairs = zip(snapshot.place_ids.tolist(), snapshot.place_regions.tolist(), strict=True)
    return {place: (region, names[region]) for place, region in pairs}


def test_a_successor_that_stands_by_tells_nothing_and_then_everything_under_the_same_names(first):
    before = regions_of(first.answer(REGION_SNAPSHOT, SNAPSHOT))
    assert min(region for region, _ in before.values()) > 0
    second = successor(first)
    outputs = second.feed(Succession(predecessor="first"), task(), prior(ROOMS), *FRAMES[-4:], *ticks(6))
    assert not outputs  # no wish for keyframes either: the predecessor has told what it has seen
    assert lacking(second.state, CFG) == ""
    assert len(second.state.seen.archive) == len(first.state.seen.archive)
    with pytest.raises(NotYet):
        second.answer(REGION_SNAPSHOT, SNAPSHOT)
    word = bequest(first.state, first.identity, CFG)
    [delta] = told(second.feed(TakesOver(bequest=word)))
    assert delta.snapshot and delta.epoch == 2
    after = regions_of(delta)
    assert np.mean([after[place] == before[place] for place in before]) > 0.97
    assert not [event for event in delta.events if event.kind in {"appeared", "removed"}]


def test_numbers_that_were_given_before_are_not_given_again(first):
    second = successor(first)
    second.feed(Succession(predecessor="first"), task(), prior(ROOMS), *ticks(6))
    word = msgspec.structs.replace(bequest(first.state, first.identity, CFG), next_ids={"regions": 90, "objects": 70})
    second.feed(TakesOver(bequest=word))
    assert second.state.regions.next_id >= 90 and second.state.objects.tracks.next_id >= 70


def test_what_is_lacking_is_said(first):
    second = runner("second", 2)
    second.feed(Succession(predecessor="first"))
    assert "evidence" in lacking(second.state, CFG) and "regions" in lacking(second.state, CFG)
    second.feed(first.answer(REGION_SNAPSHOT, SNAPSHOT), first.answer(OBJECT_SNAPSHOT, SNAPSHOT))
    second.feed(*_pages(first))
    assert "prior" in lacking(second.state, CFG)
    second.feed(task(), prior(ROOMS), *ticks(6))
    assert lacking(second.state, CFG) == ""


def _pages(first):
    after, pages = -1, []
    while True:
        pages.append(first.answer(EVIDENCE, EvidenceRequest(robot=ROBOT, after_frame_id=after)))
        after = pages[-1].last_frame_id
        if not pages[-1].pyramids:
            return pages


def test_evidence_comes_in_pages_and_gives_the_same_descriptors(first, monkeypatch):
    monkeypatch.setattr(succession, "PAGE_BYTES", 1.0)
    second = successor(first)
    second.feed(Succession(predecessor="first"))
    assert len(_pages(first)) == len(FRAMES) + 1
    mine, theirs = (one.state.seen.evidence for one in (second, first))
    slots = [one.of(first.state.map.graph.ids.tolist()) for one in (mine, theirs)]
    assert (mine.frames[slots[0]] == theirs.frames[slots[1]]).all()
    np.testing.assert_allclose(mine.descriptors(slots[0]), theirs.descriptors(slots[1]), atol=2e-3)


def scene_of(first):
    """What the store knows after the predecessor has died."""
    known = first.answer(REGION_SNAPSHOT, SNAPSHOT)
    example = next(one for one in EXAMPLES if isinstance(one, Scene))
    return msgspec.structs.replace(
        example,
        robot=ROBOT,
        prior_digest=known.prior_digest,
        space=known.space,
        labels=known.labels,
        regions=known.regions,
        place_ids=known.place_ids,
        place_regions=known.place_regions,
        posteriors=known.posteriors,
        unknown=known.unknown,
        predicted_ids=known.predicted_ids,
        positions_m=POSITIONS[known.place_ids].astype(np.float32),
        radii_m=np.ones(len(known.place_ids), np.float32),
        basis_points=np.ones(len(known.place_ids), np.int16),
        objects=[],
    )


def test_after_a_death_readers_keep_what_they_have_until_the_evidence_is_there_again(first):
    scene = scene_of(first)
    before = regions_of(scene)
    second = runner("second", 2)
    second.answers[SCENE] = lambda request: scene
    assert not told(second.feed(Succession(), task(), prior(ROOMS), *FRAMES[:4], *ticks(3)))
    [delta, *_] = told(second.feed(*FRAMES[4:], *ticks(4)))
    assert delta.snapshot
    after = regions_of(delta)
    assert np.mean([after[place][0] == before[place][0] for place in before]) > 0.95


def test_a_successor_of_the_dead_waits_within_a_bound_but_never_empties_a_map(first):
    scene = scene_of(first)
    second = runner("second", 2)
    second.answers[SCENE] = lambda request: scene
    outputs = second.feed(Succession(), task(), prior(ROOMS), *FRAMES[:4], *ticks(CFG.catch_up_ticks + 4))
    assert len(told(outputs)) >= 1
    lost = Runner(SERVICE, CFG, Identity(ROBOT, "third", 3), {SCENE: lambda request: scene, TEXT: embed}, wire=True)
    outputs = lost.feed(Succession(), task(), prior(ROOMS), *ticks(3 * CFG.catch_up_ticks))
    assert not told(outputs)


def test_another_map_is_not_waited_for(first):
    scene = msgspec.structs.replace(scene_of(first), place_ids=10_000 + scene_of(first).place_ids)
    second = runner("second", 2)
    second.answers[SCENE] = lambda request: scene
    outputs = second.feed(Succession(), task(), prior(ROOMS), *FRAMES[:4], *ticks(3))
    assert told(outputs)


def test_objects_keep_their_ids_by_the_box_that_overlaps_most():
    def thing(number, low):
        high = tuple(value + 1.0 for value in low)
        return SceneObject(
            id=number, label="", probability=0.0, known=0.0, position_m=low, min_m=low, max_m=high, frames=2
        )

    former = [thing(7, (0.0, 0.0, 0.0)), thing(9, (0.5, 0.0, 0.0)), thing(11, (9.0, 9.0, 9.0))]
    boxes = np.array([[(0.4, 0, 0), (1.4, 1, 1)], [(0.1, 0, 0), (1.1, 1, 1)], [(5.0, 5, 5), (6.0, 6, 6)]])
    assert succession.same_objects(former, [0, 1, 2], boxes) == {0: 9, 1: 7}

"""The same evidence gives the same regions, whatever came when: inputs in other orders, other rests, other ticks."""

import copy
from typing import NamedTuple

import msgspec
import numpy as np
import pytest

from prior_sg.schemas.places import SnapshotRequest
from prior_sg.schemas.priors import Counts
from prior_sg.schemas.status import Tick
from prior_sg.schemas.topics import OBJECT_SNAPSHOT, REGION_SNAPSHOT, TEXT
from prior_sg.services.runtime.runner import Runner
from prior_sg.services.runtime.service import Identity
from prior_sg.services.segmenter.core import inference
from prior_sg.services.segmenter.core.appearance.information import InformationConfig
from prior_sg.services.segmenter.core.config import Config
from prior_sg.services.segmenter.core.slices import at_once
from prior_sg.services.segmenter.service import SERVICE
from tests.help.world import ROBOT, ROOM_M, Reader, place_delta, place_grid, prior, task, text, walk
from tests.services.segmenter.test_objects import sight

ROOMS = ["kitchen", "hall", "bedroom", "bathroom"]
TICK = Tick(stamp_ns=10**18)
REST = [TICK] * 12
# An encoder as weak as those in use: crops tell little, so that the map as a whole corrects what they say.
CFG = Config(information=InformationConfig(least=0.5, full=1.5), region_cost=2.0)
COSTS = 1e-6  # rounding of sums in another order


class Inputs(NamedTuple):
    """What is to be told of a map, each kind in its own order."""

    deltas: list
    frames: list  # (pyramid, detections)
    aim: list


def weak(frame, rng):
    """The same pyramid of an encoder that sees a hall everywhere, and errs."""
    vectors = frame.embeddings.astype(np.float64) + 0.35 * rng.standard_normal(frame.embeddings.shape)
    vectors[:, 1] += 0.25
    return msgspec.structs.replace(
        frame, embeddings=(vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float16)
    )


def inputs(seed, contents=False):
    """Four rooms that a robot comes into one after the other; places it comes back to move a little."""
    rng, count = np.random.default_rng(seed), len(ROOMS)
    positions, edges = place_grid(count)
    deltas, gone = [], set()
    for room in range(count):
        held = (positions[:, 0] // ROOM_M).clip(max=count - 1) <= room
        positions[held] += rng.normal(0, 0.02, (held.sum(), 3)) * (rng.random((held.sum(), 1)) < 0.2)
        ids = np.setdiff1d(np.flatnonzero(held), list(gone))
        removed = rng.choice(ids, 1 if room else 0, replace=False)
        gone |= set(removed.tolist())
        ids = np.setdiff1d(ids, removed)
        inside = edges[np.isin(edges, ids).all(axis=1)]
        deltas.append(place_delta(positions[ids], inside, place_ids=ids, revision=room, removed_ids=removed))
    oven, bed = [(np.array((x, 1.5, 0.0)), np.array((x + 0.6, 2.3, 0.9)), axis) for x, axis in ((1.5, 0), (9.5, 2))]
    frames = []
    for frame in walk(count):
        box = oven if frame.frame_id % 3 else bed
        seen = sight(frame.frame_id, frame.world_from_camera, [box], surface_m=4.0)
        frames.append((weak(frame, rng), seen))
    said = np.full((count, 2), 0.05, np.float32)
    said[0, 0] = said[2, 1] = 0.9
    tested = Counts(regions=np.full(count, 8.0, np.float32)) if contents else None
    return Inputs(deltas, frames, [task(), prior(ROOMS, containment=said, tested=tested)])


def interleaved(given, rng):
    """A course that real timing can produce: places in order, pyramids and detections late and not in order, a prior at
    any time, ticks rare or frequent, and rests between."""
    lag, jitter, tick_s = rng.choice([0.1, 2.0, 15.0]), rng.choice([0.0, 1.0, 12.0]), rng.choice([0.3, 1.0, 5.0])
    end = len(given.frames)
    told = [(np.ceil(number * end / len(given.deltas)) + 0.4, delta) for number, delta in enumerate(given.deltas)]
    for number, (pyramid, detections) in enumerate(given.frames):
        at = number + lag + jitter * rng.random()
        told += [(at, pyramid), (at + 0.1 * rng.standard_normal(), detections)]
    told += [(rng.uniform(-1, end + 20), message) for message in given.aim]
    told += [(at, TICK) for at in np.arange(0, end + lag + jitter, tick_s)]
    told += [(at, TICK) for at in rng.uniform(0, end, 3) for _ in range(6)]
    order = np.argsort([at for at, _ in told], kind="stable")
    return [told[index][1] for index in order]


def ended(messages, cfg=CFG):
    """A segmenter that was told all this, and then nothing more for a while."""
    runner = Runner(
        SERVICE, cfg, Identity(ROBOT, "i", 1), {TEXT: lambda request: text(np.eye(4)[: len(request.concepts)])}
    )
    runner.feed(*messages, *REST)
    return runner


def assert_same(one, other):
    """Costs, labels, regions, beliefs and objects are the same, but for names of regions and objects."""
    places, others = one.state.map.places, other.state.map.places
    np.testing.assert_array_equal(one.state.map.graph.ids, other.state.map.graph.ids)
    np.testing.assert_allclose(places.unary, others.unary, atol=COSTS)
    np.testing.assert_array_equal(places.labels, others.labels)
    first, second = (reader_of(runner) for runner in (one, other))
    regions = {(first.beliefs[place][0], second.beliefs[place][0]) for place in first.beliefs | second.beliefs}
    assert len(regions) == len(first.regions) == len(second.regions)
    for here, there in regions:
        told = [reader.regions[number] for reader, number in ((first, here), (second, there))]
        assert told[0].label == told[1].label and told[0].place_count == told[1].place_count
        assert told[0].area_m2 == told[1].area_m2 and told[0].position_m == told[1].position_m
        assert abs(told[0].probability - told[1].probability) < 0.011  # told to two decimals
    for place, (_, posterior, _) in first.beliefs.items():
        np.testing.assert_allclose(posterior, second.beliefs[place][1], atol=2 * CFG.posterior_change + 1e-3)
    assert things(one) == things(other)


def reader_of(runner):
    reader = Reader()
    reader.apply(runner.answer(REGION_SNAPSHOT, SnapshotRequest(robot=ROBOT)))
    return reader


def things(runner):
    objects = runner.answer(OBJECT_SNAPSHOT, SnapshotRequest(robot=ROBOT)).objects
    return sorted((item.label, item.min_m, item.max_m) for item in objects)


@pytest.mark.parametrize("contents", [False, True], ids=["looks", "contents"])
@pytest.mark.parametrize("seed", range(4))
def test_the_same_evidence_ends_in_the_same_regions_whatever_came_when(seed, contents):
    given, rng = inputs(seed, contents), np.random.default_rng(seed)
    first = ended([*given.aim, *given.deltas, *(message for pair in given.frames for message in pair)])
    assert len(set(first.state.map.places.labels.tolist())) > 1 and len(first.state.objects.view.ids)
    assert first.state.map.places.contents.any() == contents
    for _ in range(5):
        assert_same(first, ended(interleaved(given, rng)))


def test_labels_after_a_rest_are_those_of_a_map_that_never_rested():
    """Whoever looks at the map in between does not change what it becomes."""
    given = inputs(5)
    hurried = [*given.aim, *given.deltas, *(message for pair in given.frames for message in pair)]
    rested = [message for item in hurried for message in (item, *REST)]
    assert_same(ended(hurried), ended(rested))


def test_labels_found_anew_do_not_depend_on_those_before():
    """A field that changes a little at a time leads to other labels that no swap betters than a start from scratch."""
    rooms, labels = 9, 8
    positions, edges = place_grid(rooms)
    names, rng = [f"room {number}" for number in range(labels)], np.random.default_rng(0)
    adjacency = rng.uniform(0.02, 1.0, (labels, labels))
    aim = [task(), prior(names, adjacency=(np.triu(adjacency) + np.triu(adjacency, 1).T).astype(np.float32))]
    runner = Runner(SERVICE, CFG, Identity(ROBOT, "i", 1), {TEXT: lambda request: text(np.ones((labels, 1)))})
    runner.feed(*aim, place_delta(positions, edges), *REST)
    places, gone_on, others = runner.state.map.places, [], 0
    places.unary = rng.normal(0, 2.0, places.unary.shape)
    for _ in range(25):
        rows = rng.choice(len(positions), 3, replace=False)
        places.unary[rows] += 2.0 * rng.standard_normal((3, labels))
        places.unsettled[rows] = True
        inference.settle(runner.state, CFG, hurried=False)
        gone_on.append(places.labels.copy())
        kept = copy.deepcopy(runner.state)
        at_once(inference.settling(kept, CFG, hurried=False, anew=True))
        found = kept.map.places.labels.copy()
        others += not np.array_equal(found, gone_on[-1])
        kept.map.places.cut_labels[:] = rng.integers(0, labels, len(positions))
        at_once(inference.settling(kept, CFG, hurried=False, anew=True))
        np.testing.assert_array_equal(kept.map.places.labels, found)
    assert others, "what was gone on from did not matter here"


def test_a_map_that_rests_is_labelled_once():
    given = inputs(6)
    runner = ended([*given.aim, *given.deltas, *(message for pair in given.frames for message in pair)])
    assert not runner.state.labelling.dirty
    solver = runner.state.labelling.solver
    assert runner.feed(*REST) == []
    assert runner.state.labelling.solver is solver
    inference.see_objects(runner.state, runner.state.objects.view, CFG)
    assert runner.feed(*REST) == [] and not runner.state.labelling.dirty


def test_a_map_whose_objects_are_told_again_as_they_were_stays_settled():
    """Nothing would have regions looked into again, and its prior's evidence would wait for ever."""
    given = inputs(6, contents=True)
    runner = ended([*given.aim, *given.deltas, *(message for pair in given.frames for message in pair)])
    assert runner.state.labelling.settled and not runner.state.labelling.dirty
    inference.see_objects(runner.state, runner.state.objects.view, CFG)
    assert runner.state.labelling.settled


def test_a_large_map_is_not_labelled_anew_between_the_keyframes_of_a_resting_camera():
    """These come every two seconds, which are four ticks, and finding all labels of 50 000 places takes 1.5 s."""
    runner = ended(inputs(6).aim)
    labelling = runner.state.labelling
    for ticks, small, large in ((1, False, False), (2, True, False), (4, True, False), (7, True, True)):
        labelling.still_ticks = ticks
        assert (labelling.still(9_999), labelling.still(50_000)) == (small, large)

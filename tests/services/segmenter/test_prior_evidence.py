"""What a map tells the prior gateway about its prior: counted in a world of three rooms in a row."""

import numpy as np

from prior_sg.schemas.codec import decode, encode
from prior_sg.schemas.priors import Counts, PriorEvidence
from prior_sg.schemas.status import Tick
from prior_sg.schemas.topics import PRIOR_EVIDENCE, TEXT
from prior_sg.services.prior_gateway.core import learning
from prior_sg.services.runtime.runner import Runner
from prior_sg.services.runtime.service import Identity
from prior_sg.services.segmenter.core import inference, prior_evidence
from prior_sg.services.segmenter.core.config import Config
from prior_sg.services.segmenter.core.experts.context import ObjectView
from prior_sg.services.segmenter.core.regions.contents import held, held_around
from prior_sg.services.segmenter.service import SERVICE
from tests.help.world import ROBOT, place_delta, place_grid, prior, task, text, walk

ROOMS = ["kitchen", "hall", "bedroom"]
TICK = Tick(stamp_ns=10**18)


def segmenter(cfg: Config, concepts=np.eye(3)) -> Runner:
    """A segmenter whose text requests are answered with these rows over the rooms' basis vectors."""

    def reply(request):
        return text(concepts[: len(request.concepts)])

    return Runner(SERVICE, cfg, Identity(ROBOT, "i", 1), {TEXT: reply}, wire=True)


def told(cfg: Config, ticks: int, names=ROOMS) -> list[PriorEvidence]:
    """Everything told about the prior by the given tick."""
    positions, edges = place_grid(3)
    messages = (place_delta(positions, edges), task(), prior(names), *walk(3), *[TICK] * ticks)
    return [message for topic, message in segmenter(cfg).feed(*messages) if topic is PRIOR_EVIDENCE]


def test_rooms_in_a_row_are_counted_once_and_only_neighbours_touch():
    [seen] = told(Config(evidence_ticks=4), 20)  # nothing new after the first time
    assert (seen.robot, seen.environment, seen.task, seen.prior_digest) == (
        ROBOT,
        "home",
        "tidy up",
        prior(ROOMS).digest(),
    )
    assert seen.regions == ROOMS
    assert seen.instances.tolist() == [1, 1, 1]
    np.testing.assert_array_equal(seen.pairs, 1 - np.eye(3))
    np.testing.assert_array_equal(seen.touching, [[0, 1, 0], [1, 0, 1], [0, 1, 0]])
    np.testing.assert_allclose(seen.places.sum(), 50, atol=0.1)  # 48 on the grid, two in doorways
    assert seen.objects == []


def test_regions_of_few_places_do_not_count():
    [seen] = told(Config(evidence_ticks=1, evidence_places=17), 20)[-1:]  # a room has 16, two of them a doorway more
    assert seen.instances.sum() < 3
    assert told(Config(evidence_ticks=1, evidence_places=51), 20) == []


def test_it_can_be_switched_off():
    assert told(Config(evidence_ticks=0), 20) == []


def test_the_gateway_learns_from_it():
    [seen] = told(Config(evidence_ticks=4), 20)
    before = prior(ROOMS)
    after = learning.revised(
        before, learning.estimate(before, [seen], learning.LearningConfig()).totals, 4.0, before.provenance
    )
    expected = (4 * 0.3 + np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]])) / 5  # P = (strength P + k) / (strength + n)
    off = ~np.eye(3, dtype=bool)
    np.testing.assert_allclose(after.adjacency[off], expected[off], rtol=1e-6)
    np.testing.assert_array_equal(after.containment, before.containment)


def test_objects_count_for_the_region_of_their_nearest_place_by_their_best_candidate():
    positions_m, regions = np.array([[0.0, 0, 0], [1, 0, 0], [10, 0, 0], [20, 0, 0]]), np.array([7, 7, 9, 8])
    view = ObjectView(
        ids=np.arange(5),
        positions_m=np.array([[0.2, 0, 0], [1.3, 0, 0], [9.5, 0, 0], [12.0, 0, 0], [20.0, 0, 0]]),
        concepts=np.array([[0.9, 0.1], [0.4, 0.6], [0.2, 0.8], [1.0, 0.0], [1.0, 0.0]]),
        weights=np.array([1.0, 1.0, 0.5, 1.0, 1.0]),
    )
    found = held(view, positions_m, regions, np.array([7, 9]))  # 8 is too small, the object at 12 too far
    np.testing.assert_allclose(found, [[0.9, 0.6], [0.1, 0.4]])


def seen_with(weight: float) -> PriorEvidence:
    """The evidence of three labelled rooms with an oven in the kitchen."""
    positions, edges = place_grid(3)
    cfg = Config(evidence_ticks=0)
    runner = segmenter(cfg)
    runner.feed(place_delta(positions, edges), task(), prior(ROOMS), *walk(3), TICK)
    state = runner.state
    state.objects.view = ObjectView(
        np.array([1]), np.array([[2.0, 2.0, 0.5]]), np.array([[0.9, 0.1]]), np.array([weight])
    )
    return decode(PriorEvidence, encode(prior_evidence.evidence(state, cfg)))


def test_what_a_region_holds_revises_containment():
    seen, before = seen_with(1.0), prior(ROOMS)
    assert seen.objects == ["oven", "bed"]
    np.testing.assert_allclose(seen.holding, [[0.9, 0.1], [0, 0], [0, 0]], rtol=1e-6)
    after = learning.revised(
        before, learning.estimate(before, [seen], learning.LearningConfig()).totals, 4.0, before.provenance
    )
    np.testing.assert_allclose(after.containment, (4 * 0.5 + np.array([[0.9, 0.1], [0, 0], [0, 0]])) / 5, rtol=1e-6)


def test_objects_without_a_say_are_no_sign_that_one_has_looked():
    seen, before = seen_with(0.0), prior(ROOMS)
    assert seen.objects == [] and seen.holding.shape == (3, 0)
    after = learning.revised(
        before, learning.estimate(before, [seen], learning.LearningConfig()).totals, 4.0, before.provenance
    )
    np.testing.assert_array_equal(after.containment, before.containment)


def test_each_region_is_told_of_apart_from_its_label():
    seen = seen_with(1.0)
    rooms = seen.looks.argmax(axis=1)
    assert seen.sizes.sum() == 50 and sorted(rooms) == [0, 1, 2] and (seen.looks <= 0).all()
    assert {tuple(sorted(rooms[link])) for link in seen.links} == {(0, 1), (1, 2)}
    np.testing.assert_allclose(seen.contents[np.argsort(rooms)], [[0.9, 0.1], [0, 0], [0, 0]], rtol=1e-6)


def rooms_under(
    counted: float,
    stove_in: str,
    ticks: int = 6,
    *,
    prior_last: bool = False,
    looks: float | None = None,
    likeness: float = 0.95,
) -> list[str]:
    """Labels of three rooms, the first of which holds an oven and looks by `likeness` like a bedroom, under a prior in
    whose regions `counted` were tested, beside which looks are worth so much, and which comes before anything is seen
    or, with `prior_last`, after all is."""
    positions, edges = place_grid(3)
    held = np.full((3, 2), 0.02, np.float32)
    held[ROOMS.index(stove_in), 0] = 0.98
    tested = Counts(regions=np.full(3, counted, np.float32), looks=looks) if counted else None
    concepts = np.array([[1.0, 0.0, likeness], [0.0, 1.0, 0.0], [likeness, 0.0, 1.0]])
    runner = segmenter(Config(evidence_ticks=0), concepts)
    aim = (task(), prior(ROOMS, containment=held, tested=tested))
    runner.feed(place_delta(positions, edges), *(() if prior_last else aim), *walk(3), TICK)
    view = ObjectView(np.array([1]), np.array([[2.0, 2.0, 0.5]]), np.array([[1.0, 0.0]]))
    inference.see_objects(runner.state, view, runner.cfg)
    runner.feed(*(aim if prior_last else ()), *[TICK] * ticks)
    assert not runner.state.labelling.dirty, "it rests"
    places = runner.state.map.places
    order = np.argsort(runner.state.map.graph.positions_m[:, 0], kind="stable")
    return [ROOMS[places.labels[row]] for row in (order[0], order[len(order) // 2], order[-1])]


def test_what_a_whole_region_holds_has_a_say_once_the_prior_was_tested():
    assert rooms_under(0, "bedroom") == ROOMS
    assert rooms_under(50, "bedroom") == ["bedroom", "hall", "bedroom"]
    assert rooms_under(50, "kitchen") == ROOMS


def test_looks_give_way_to_contents_as_far_as_they_are_worth():
    assert rooms_under(50, "bedroom", likeness=0.6) == ROOMS
    assert rooms_under(50, "bedroom", likeness=0.6, looks=0.3) == ["bedroom", "hall", "bedroom"]
    assert rooms_under(50, "kitchen", likeness=0.6, looks=0.3) == ROOMS


def test_it_has_a_say_where_the_prior_comes_to_a_map_that_has_no_regions_yet():
    assert rooms_under(50, "bedroom", prior_last=True) == ["bedroom", "hall", "bedroom"]


def test_each_place_hears_what_its_region_holds_and_the_nearest_most():
    """Two places of one region 0 and 2 m from an oven that counts half, one of another region at 1 m; decay 2 m."""
    view = ObjectView(np.array([1]), np.array([[0.0, 0, 0]]), np.array([[0.8, 0.2]]), np.array([0.5]))
    found = held_around(view, np.array([[0.0, 0, 0], [2, 0, 0], [0, 1, 0]]), np.array([3, 3, 4]))
    np.testing.assert_allclose(found, [[0.4, 0.1], [0.4 * np.exp(-1), 0.1 * np.exp(-1)], [0, 0]])
    assert held_around(ObjectView(), np.zeros((2, 3)), np.array([3, 3])).shape == (2, 0)

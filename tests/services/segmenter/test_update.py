"""The whole segmenter on a small world: right regions, lasting ids, task switch, deltas, questions, replay."""

from functools import partial

import msgspec
import numpy as np
import pytest

from prior_sg.schemas.codec import decode, encode
from prior_sg.schemas.features import TextRequest
from prior_sg.schemas.frames import PoseUpdate
from prior_sg.schemas.places import SnapshotRequest
from prior_sg.schemas.priors import PriorList, PriorRequest, RegionPrior, TaskInForce
from prior_sg.schemas.regions import PosteriorRequest, RegionDelta
from prior_sg.schemas.status import Tick
from prior_sg.schemas.topics import (
    BACKFILL,
    PLACE_SNAPSHOT,
    POSTERIOR,
    PRIORS,
    REGION_DELTA,
    REGION_SNAPSHOT,
    TASK_IN_FORCE,
    TEXT,
)
from prior_sg.services.runtime.runner import Runner
from prior_sg.services.runtime.service import Ask, Identity
from prior_sg.services.segmenter.core import inference, report
from prior_sg.services.segmenter.core.aim import border_costs, region_concepts
from prior_sg.services.segmenter.core.appearance.adaptation import Adaptation, AdaptationConfig
from prior_sg.services.segmenter.core.appearance.information import InformationConfig
from prior_sg.services.segmenter.core.appearance.label_bias import BalanceConfig
from prior_sg.services.segmenter.core.appearance.unmixing import UnmixingConfig
from prior_sg.services.segmenter.core.config import AdjacencyConfig, Config
from prior_sg.services.segmenter.core.energy.mrf import energy
from prior_sg.services.segmenter.core.energy.solver import minimise
from prior_sg.services.segmenter.core.experts.context import ObjectView
from prior_sg.services.segmenter.core.layers.alignment import AlignmentConfig
from prior_sg.services.segmenter.core.layers.stacking import LayersConfig
from prior_sg.services.segmenter.core.map.place_map import edge_weights
from prior_sg.services.segmenter.service import SERVICE
from tests.help.world import (
    FRAMES_PER_ROOM,
    ROBOT,
    SPACE,
    Reader,
    look,
    no_places,
    place_delta,
    place_grid,
    prior,
    pyramid,
    task,
    text,
    walk,
)

CFG = Config()
OPEN = Config(edge_clearance_m=0.0)  # as if no way were narrow
ROOMS = ["kitchen", "hall", "bedroom"]
TICK = Tick(stamp_ns=10**18)


class Run:
    """One segmenter, its outputs, and a reader of its deltas. Text requests are answered like rooms' basis vectors."""

    def __init__(self, cfg=CFG, concepts=None):
        answers = {query: partial(self.answer, query) for query in SERVICE.asks}
        self.runner = Runner(SERVICE, cfg, Identity(ROBOT, "i", 1), answers, wire=True)
        self.cfg, self.state = cfg, self.runner.state
        self.concepts = np.eye(3) if concepts is None else concepts
        self.deltas, self.asked, self.reader = [], [], Reader()
        self.asked_task, self.answer_text = 0, True

    def answer(self, query, request):
        if query is TASK_IN_FORCE:
            self.asked_task += 1
            return None
        self.asked.append(Ask(query, request))
        return text(self.concepts[: len(request.concepts)]) if query is TEXT and self.answer_text else None

    def feed(self, *messages, answer_text=True):
        self.answer_text = answer_text
        for topic, message in self.runner.feed(*messages):
            if topic is not BACKFILL:  # which test_handover.py is about
                assert topic is REGION_DELTA
                self.deltas.append(message)
                self.reader.apply(message)
        return self

    def labels(self):
        return {place: self.reader.label(place) for place in self.reader.beliefs}


def world(rooms=3):
    positions, edges = place_grid(rooms)
    return positions, edges, walk(rooms)


def near_a_doorway(position):
    """Within half a metre of a shared wall, where crops see both rooms and either label is right."""
    return abs(position[0] - 4.0) <= 0.5 or abs(position[0] - 8.0) <= 0.5


def finished(rooms=3, **kwargs):
    positions, edges, frames = world(rooms)
    run = Run(**kwargs).feed(place_delta(positions, edges), task(), prior(ROOMS[:rooms]), *frames, TICK)
    return run, positions


def test_each_room_becomes_one_region_with_its_name():
    run, positions = finished()
    assert sorted(region.label for region in run.reader.regions.values()) == sorted(ROOMS)
    for place, label in run.labels().items():
        if not near_a_doorway(positions[place]):
            assert label == ROOMS[int(positions[place, 0] // 4)]
    for region in run.reader.regions.values():
        members = [place for place, belief in run.reader.beliefs.items() if belief[0] == region.id]
        assert region.place_count == len(members)
        np.testing.assert_allclose(region.position_m, positions[members].mean(axis=0), atol=0.006)
        mean = np.mean([run.reader.beliefs[place][1][ROOMS.index(region.label)] for place in members])
        assert region.probability == pytest.approx(mean, abs=0.02)


def test_the_levels_above_follow_the_regions():
    positions, edges, frames = world()
    zones = msgspec.structs.replace(prior(ROOMS), regions=[
        msgspec.structs.replace(region, parent="night zone" if region.name == "bedroom" else "day zone")
        for region in prior(ROOMS).regions
    ])  # fmt: skip
    free = LayersConfig(alignment=AlignmentConfig(node_cost=0.0))  # as a single room costs more than it gains
    cfg = msgspec.structs.replace(CFG, layers=free)
    run = Run(cfg=cfg).feed(place_delta(positions, edges), task(), zones, *frames, TICK)
    told = {}
    for delta in run.deltas:
        told = {} if delta.snapshot else told
        for key in delta.removed_nodes:
            del told[key]
        told |= {(node.level, node.id): node for node in delta.nodes}
    assert told == run.state.layers.known
    by_label = {region.label: region.id for region in run.reader.regions.values()}
    assert {node.label: node.member_ids for node in told.values() if node.level == "zone"} == {
        "day zone": sorted((by_label["kitchen"], by_label["hall"])),
        "night zone": [by_label["bedroom"]],
    }
    assert [node.label for node in told.values() if node.level != "zone"] == ["floor 0", "building"]
    assert {region.label: region.parent for region in run.reader.regions.values()}["hall"] == "day zone"
    before = len(run.deltas)
    assert len(run.feed(TICK, TICK).deltas) == before


def test_posteriors_are_distributions_and_unseen_places_are_unknown():
    positions, edges, frames = world()
    lonely = np.vstack((positions, [(30.0, 30.0, 1.0)])).astype(np.float32)
    run = Run().feed(place_delta(lonely, edges), task(), prior(ROOMS), *frames, TICK)
    for place, (_, posterior, unknown) in run.reader.beliefs.items():
        assert sum(posterior) == pytest.approx(1.0, abs=2e-3)
        assert unknown == 1.0 if place == len(positions) else 0.0 <= unknown < 0.7


def test_unobserved_places_take_the_label_of_their_neighbours():
    positions, edges, frames = world(2)
    chain = np.vstack((positions, [(8.5, 2.0, 1.0), (9.5, 2.0, 1.0)])).astype(np.float32)
    last = len(positions)
    corner = int(np.argmin(np.linalg.norm(positions - (7.5, 1.5, 1.0), axis=1)))
    joined = np.vstack((edges, [(corner, last), (last, last + 1)]))
    run = Run().feed(place_delta(chain, joined), task(), prior(ROOMS[:2]), *frames, TICK)
    assert run.reader.beliefs[last + 1][2] == 1.0
    assert run.reader.label(last) == run.reader.label(last + 1) == "hall"


def test_region_ids_last_while_the_map_grows():
    positions, edges, frames = world()
    run = Run().feed(task(), prior(ROOMS))
    seen = {}
    for rooms in (1, 2, 3):
        part = np.flatnonzero(positions[:, 0] < 4 * rooms)
        inside = np.isin(edges, part).all(axis=1)
        run.feed(
            place_delta(
                positions[part],
                edges[inside],
                place_ids=part,
                revision=rooms - 1,
            )
        )
        run.feed(*frames[FRAMES_PER_ROOM * (rooms - 1) : FRAMES_PER_ROOM * rooms], TICK)
        for region in run.reader.regions.values():
            assert seen.setdefault(region.label, region.id) == region.id
    assert len(seen) == 3


def test_a_task_switch_relabels_everything_at_once_without_new_pyramids():
    run, positions = finished()
    before = dict(run.labels())
    asked = len(run.asked)
    run.concepts = np.array([(1.0, 1.0, 0.0), (0.0, 0.0, 1.0)])
    run.feed(task("find a bed"), TICK)
    assert run.labels() == before and run.deltas[-1].task == "tidy up"
    run.feed(prior(["day zone", "night zone"], "find a bed"))
    last = run.deltas[-1]
    assert last.snapshot and last.labels == ["day zone", "night zone"] and last.task == "find a bed"
    assert len(last.place_ids) == len(positions)
    for place, label in run.labels().items():
        if not near_a_doorway(positions[place]):
            assert label == ("day zone" if positions[place, 0] < 8 else "night zone")
    assert [ask.query for ask in run.asked[asked:]] == [TEXT]


def test_a_prior_may_come_before_its_task_and_others_are_left_alone():
    positions, edges, frames = world()
    run = Run().feed(place_delta(positions, edges), prior(ROOMS), prior(["a", "b"], "other"), *frames, TICK)
    assert not run.deltas and not run.asked
    run.feed(task())
    assert run.deltas[-1].labels == ROOMS
    run.feed(*(prior(["x", "y"], f"foreign {n}") for n in range(9)), TICK)
    assert run.deltas[-1].labels == ROOMS
    assert run.state.aim.wanted is not None


def test_switching_back_and_forth_ends_in_the_same_labels():
    run, _ = finished()
    before = run.labels()
    run.feed(task("x"), prior(["all"], "x"), TICK)
    assert set(run.labels().values()) == {"all"}
    run.feed(task(), TICK)
    assert run.labels() == before


def test_a_text_reply_for_a_superseded_prior_is_not_taken_for_the_new_one():
    positions, edges, frames = world()
    run = Run().feed(place_delta(positions, edges), *frames)
    run.feed(task("x"), prior(["p", "q", "r"], "x"), task(), prior(ROOMS), answer_text=False)
    assert [ask.query for ask in run.asked] == [TEXT]
    run.feed(text(np.eye(3)[::-1]), answer_text=False)  # the reply for p, q, r
    assert not run.deltas
    assert [ask.request.concepts[0] for ask in run.asked] == [["a p"], ["a kitchen"]]
    run.feed(text(np.eye(3)))
    assert run.reader.label(0) == "kitchen"


def test_a_restarted_segmenter_learns_the_task_that_was_given_before():
    positions, edges, frames = world()
    run = Run().feed(place_delta(positions, edges), *frames, TICK)
    assert run.asked_task == 1 and not run.deltas
    run.feed(TaskInForce(robot=ROBOT), TICK)
    assert not run.deltas
    run.feed(TaskInForce(robot=ROBOT, task=task()), prior(ROOMS), TICK)
    assert run.asked_task == 1 and len(run.labels()) == len(positions)


def test_an_older_task_changes_nothing():
    run, _ = finished()
    before = run.labels()
    run.feed(task("older", stamp_ns=1), TaskInForce(robot=ROBOT, task=task("oldest", stamp_ns=0)), TICK)
    assert run.state.aim.intent.tasks[ROBOT] == task() and run.labels() == before


def test_a_missing_prior_is_asked_for_and_an_empty_answer_repeated():
    positions, edges, _ = world()
    run = Run().feed(place_delta(positions, edges), task(regions=ROOMS))
    run.feed(*[TICK] * (CFG.prior_wait_ticks - 1))
    assert not run.asked
    run.feed(TICK, TICK)
    assert [ask.query for ask in run.asked] == [PRIORS]
    assert run.asked[0].request == PriorRequest(environment="home", task="tidy up", regions=ROOMS)
    run.feed(PriorList(priors=[], reason="none yet"), *[TICK] * CFG.prior_wait_ticks)
    assert [ask.query for ask in run.asked] == [PRIORS, PRIORS]
    run.feed(PriorList(priors=[prior(ROOMS, vocabulary=ROOMS), prior(ROOMS[::-1], vocabulary=ROOMS)]), TICK)
    assert run.deltas[-1].labels == ROOMS  # the best comes first


def test_a_gap_asks_for_a_snapshot_once_and_recovers():
    positions, edges, frames = world()
    run = Run().feed(task(), prior(ROOMS))
    run.feed(no_places(revision=4), no_places(revision=5))
    assert [ask.request for ask in run.asked if ask.query is PLACE_SNAPSHOT] == [SnapshotRequest(robot=ROBOT)]
    run.feed(place_delta(positions, edges, revision=4, snapshot=True), *frames, TICK)
    assert len(run.reader.beliefs) == len(positions)
    assert run.reader.label(0) == "kitchen"
    run.feed(no_places(revision=9))
    assert len([ask for ask in run.asked if ask.query is PLACE_SNAPSHOT]) == 2


def test_a_restarted_place_graph_replaces_all_places():
    run, positions = finished()
    run.feed(place_delta(positions[:3], np.zeros((0, 2)), epoch=2, place_ids=np.array([100, 101, 102])), TICK)
    assert sorted(run.reader.beliefs) == [100, 101, 102]
    assert run.reader.label(100) == "kitchen"  # from the stored pyramids


def test_late_and_moved_places_get_the_evidence_of_all_frames():
    positions, edges, frames = world()
    early = Run().feed(place_delta(positions, edges), task(), prior(ROOMS), *frames, TICK)
    displaced = positions.copy()
    displaced[5] = (9.5, 3.5, 1.0)
    late = Run().feed(place_delta(displaced[:20], np.zeros((0, 2))), task(), prior(ROOMS), *frames, TICK)
    late.feed(place_delta(positions, edges, revision=1), TICK)
    slots = [run.state.seen.evidence.of(list(range(len(positions)))) for run in (early, late)]
    np.testing.assert_allclose(
        early.state.seen.evidence.descriptors(slots[0]), late.state.seen.evidence.descriptors(slots[1]), atol=1e-5
    )
    assert early.labels() == late.labels()


def test_another_query_radius_integrates_everything_again():
    positions, edges, frames = world()
    wide = [RegionPrior(name=name, phrases=[f"a {name}"], existence=1 / 3, query_radius_m=1.5) for name in ROOMS]
    before = Run().feed(task(), prior(ROOMS, regions=wide), place_delta(positions, edges), *frames, TICK)
    after = Run().feed(place_delta(positions, edges), *frames, task(), prior(ROOMS, regions=wide), TICK)
    assert before.state.seen.query_radius_m == after.state.seen.query_radius_m == 1.5
    slots = [run.state.seen.evidence.of(list(range(len(positions)))) for run in (before, after)]
    sums = [run.state.seen.evidence.trust[slot] for run, slot in zip((before, after), slots, strict=True)]
    np.testing.assert_allclose(*sums, rtol=1e-5)
    narrow, _ = finished()
    assert not np.allclose(narrow.state.seen.evidence.trust[: len(positions)], sums[0], rtol=0.05)


def test_repeated_and_foreign_pyramids_change_nothing():
    run, _ = finished()
    deltas, trust = len(run.deltas), run.state.seen.evidence.trust.copy()
    run.feed(walk(3)[2], pyramid(99, look(2, 2, 0), 3, space="other/space"), TICK, TICK)
    assert len(run.deltas) == deltas
    np.testing.assert_array_equal(run.state.seen.evidence.trust, trust)
    assert run.state.seen.losses.count("pyramids ignored") == 1  # the other space is kept apart


def test_deltas_hold_only_what_changed():
    run, positions = finished()
    new = np.array([(2.2, 2.2, 1.3)], dtype=np.float32)
    run.feed(place_delta(new, np.array([[5, 200]]), place_ids=np.array([200]), revision=1), TICK)
    last = run.deltas[-1]
    assert not last.snapshot and 200 in last.place_ids.tolist()
    assert len(last.place_ids) < len(positions) / 2
    run.feed(TICK, TICK)
    assert run.deltas[-1] is last


def test_removed_places_and_regions_leave_the_followers_too():
    run, positions = finished()
    gone = np.flatnonzero(positions[:, 0] >= 8.0)
    run.feed(no_places(revision=1, removed_ids=gone), TICK)
    assert set(run.reader.beliefs) == set(np.flatnonzero(positions[:, 0] < 8.0).tolist())
    assert sorted(region.label for region in run.reader.regions.values()) == ["hall", "kitchen"]


def test_a_spent_budget_leaves_a_valid_labelling_and_an_idle_tick_finishes():
    cfg = Config(budget_ms=1e-3)
    positions, edges, frames = world()
    run = Run(cfg=cfg).feed(place_delta(positions, edges), task(), prior(ROOMS))
    waited = False
    for frame in frames:
        run.feed(frame)
        state = run.state
        assert ((state.map.places.labels >= 0) & (state.map.places.labels < len(ROOMS))).all()
        assert state.labelling.dirty or not state.labelling.solver.pending
        waited |= state.labelling.solver.pending > 0
    assert waited
    hurried = energy(inference.field_of(run.state), run.state.map.places.labels)
    run.feed(TICK, TICK)
    assert not (run.state.labelling.dirty or run.state.labelling.solver.pending)
    field = inference.field_of(run.state)
    settled = energy(field, run.state.map.places.labels)
    assert settled <= hurried + 1e-9
    assert energy(field, minimise(field, run.state.map.places.labels)) == pytest.approx(settled)
    assert sorted(region.label for region in run.reader.regions.values()) == sorted(ROOMS)


@pytest.mark.parametrize("end", ["first", "last", "both"])
def test_places_may_leave_at_either_end_of_the_list(end):
    run, positions = finished()
    gone = {"first": [0, 1], "last": [len(positions) - 1], "both": [0, len(positions) - 1]}[end]
    run.feed(no_places(revision=1, removed_ids=np.array(gone)), TICK)
    assert set(run.reader.beliefs) == set(range(len(positions))) - set(gone)
    field = inference.field_of(run.state)
    fresh = minimise(field, run.state.map.places.labels)
    assert energy(field, fresh) == pytest.approx(energy(field, run.state.map.places.labels))


def test_a_merge_tells_the_new_region_of_every_place():
    """Two kitchens become one by an edge; places far from it change their region and nothing else."""
    run, positions = finished(rooms=1)
    apart = positions + np.array((0.0, 100.0, 0.0))
    count = len(positions)
    _, edges = place_grid(1)
    run.feed(place_delta(apart, edges + count, place_ids=np.arange(count) + count, revision=1), TICK)
    assert len(run.reader.regions) == 2
    link = place_delta(positions[:0], np.array([(0, count)]), place_ids=np.zeros(0, dtype=np.int64), revision=2)
    run.feed(link, TICK)
    assert [event.kind for event in run.deltas[-1].events] == ["merged"]
    assert {belief[0] for belief in run.reader.beliefs.values()} == set(run.reader.regions) and len(
        run.reader.regions
    ) == 1


def test_following_the_deltas_equals_the_snapshot():
    rng = np.random.default_rng(0)
    positions, edges, frames = world()
    run = Run().feed(place_delta(positions, edges), task(), prior(ROOMS))
    for revision, frame in enumerate(frames, start=1):
        removed = rng.integers(0, len(positions), 1) if revision % 3 == 0 else np.zeros(0, dtype=np.int64)
        back = np.arange(len(positions)) if revision % 7 == 0 else np.zeros(0, dtype=np.int64)
        again = edges if revision % 7 == 0 else edges[:0]
        run.feed(place_delta(positions[back], again, place_ids=back, revision=revision, removed_ids=removed), frame)
        whole = SERVICE.answers[REGION_SNAPSHOT](run.state, SnapshotRequest(robot=ROBOT), CFG)
        fresh = Reader()
        fresh.apply(decode(RegionDelta, encode(whole)))
        assert fresh.beliefs == run.reader.beliefs
        assert fresh.regions == run.reader.regions
        assert fresh.revision == run.reader.revision
    assert len(run.deltas) > 10


@pytest.mark.parametrize("seed", range(3))
def test_what_is_kept_up_to_date_equals_what_is_found_afresh(seed):
    """After any history, asking every expert again and describing every region again changes nothing."""
    rng = np.random.default_rng(seed)
    cfg = Config(
        balance=BalanceConfig(tolerance=0.0),
        adaptation=AdaptationConfig(tolerance=0.0),
        information=InformationConfig(least=0.5, full=1.5),  # crops that say nearly all are worth about a third here
    )
    positions, edges, frames = world()
    run = Run(cfg=cfg).feed(task(), prior(ROOMS), place_delta(positions, edges))
    oven = ObjectView(ids=np.array([3]), positions_m=np.array([(2.0, 2.0, 1.0)]), concepts=np.array([(1.0, 0.0)]))
    none = np.zeros(0, dtype=np.int64)
    for revision, frame in enumerate(frames[::2], start=1):
        alive = run.state.map.graph.ids
        removed = rng.choice(alive, 2, replace=False) if revision % 3 == 0 else none
        merged = rng.choice(np.setdiff1d(alive, removed), (1, 2), replace=False) if revision % 4 == 0 else none
        back = np.arange(len(positions)) if revision % 7 == 0 else none
        if revision == 5:
            inference.see_objects(run.state, oven, cfg)
        fields = {"removed_ids": removed, "merged_ids": merged.reshape(-1, 2), "place_ids": back, "revision": revision}
        run.feed(place_delta(positions[back], edges if len(back) else edges[:0], **fields), frame)
    run.feed(TICK, TICK, TICK)
    state, places = run.state, run.state.map.places
    assert not state.labelling.dirty and len(state.labelling.adaptation.directions)
    columns = ("labels", "regions", "unary", "posteriors", "inclination_rad", "support", "anisotropy")
    kept = {name: getattr(places, name).copy() for name in columns}
    before, beliefs = dict(run.reader.regions), dict(run.reader.beliefs)
    places.stale[:] = places.reshaped[:] = places.doubtful[:] = places.unbelieved[:] = True
    state.labelling.adaptation = Adaptation()
    state.map.weights = edge_weights(state.map.graph, cfg)
    inference.evaluate_experts(state, True, cfg)
    inference.believe(state, cfg)
    for name, column in kept.items():
        np.testing.assert_allclose(getattr(state.map.places, name), column, atol=1e-5, err_msg=name)
    report.publish(state, [], True, cfg)
    assert {number: (region.neighbour_ids, region.object_ids) for number, region in state.regions.known.items()} == {
        number: (region.neighbour_ids, region.object_ids) for number, region in before.items()
    }
    assert state.regions.known == before
    told = {place: belief[0] for place, belief in beliefs.items()}
    assert told == dict(zip(state.map.graph.ids.tolist(), places.regions.tolist(), strict=True))
    fresh = Reader()
    fresh.apply(SERVICE.answers[REGION_SNAPSHOT](state, SnapshotRequest(robot=ROBOT), cfg))
    assert fresh.beliefs.keys() == beliefs.keys()
    for place, (region, posterior, unknown) in beliefs.items():
        assert fresh.beliefs[place][0] == region
        np.testing.assert_allclose(fresh.beliefs[place][1], posterior, atol=cfg.posterior_change + 1e-3)
        assert fresh.beliefs[place][2] == pytest.approx(unknown, abs=cfg.posterior_change + 1e-3)
    assert any(region.object_ids == [3] for region in before.values())


def test_a_map_whose_crops_say_all_is_neither_balanced_nor_adapted():
    positions, edges, frames = world()
    inputs = (task(), prior(ROOMS), place_delta(positions, edges), *frames[::3], TICK, TICK)
    doubting = Config(information=InformationConfig(least=0.98, full=0.99))
    believed, doubted = (Run(cfg=cfg).feed(*inputs).state.labelling for cfg in (Config(), doubting))
    assert 0.4 < believed.told < 0.98
    assert np.abs(believed.bias).max() < 0.01 < np.abs(doubted.bias).max()
    assert not believed.adaptation.directions.any() and doubted.adaptation.directions.any()


def test_corrected_poses_equal_poses_known_from_the_start():
    """A third of the frames arrive 2 m off and are corrected, some before they come, some after."""
    positions, edges, frames = world()
    clean = Run().feed(place_delta(positions, edges), task(), prior(ROOMS), *frames, TICK)
    wrong = frames[::3]
    update = PoseUpdate(
        robot=ROBOT,
        epoch=1,
        revision=0,
        stamp_ns=1,
        frame_ids=np.array([frame.frame_id for frame in wrong]),
        world_from_camera=np.stack([frame.world_from_camera for frame in wrong]),
    )
    shift = np.eye(4)
    shift[0, 3] = 2.0
    shifted = [msgspec.structs.replace(frame, world_from_camera=shift @ frame.world_from_camera) for frame in wrong]
    rest = [frame for frame in frames if frame.frame_id % 3]
    for order in ((*shifted, *rest, update), (update, *rest, *shifted), (*shifted[:5], update, *rest, *shifted[5:])):
        run = Run().feed(place_delta(positions, edges), task(), prior(ROOMS), *order, TICK)
        slots = [one.state.seen.evidence.of(list(range(len(positions)))) for one in (clean, run)]
        for name in ("sums", "trust", "frames"):
            found = [
                getattr(one.state.seen.evidence, name)[slot] for one, slot in zip((clean, run), slots, strict=True)
            ]
            np.testing.assert_allclose(*found, atol=1e-3, err_msg=name)
        assert run.labels() == clean.labels()
    disturbed = Run().feed(place_delta(positions, edges), task(), prior(ROOMS), *shifted, *rest, TICK)
    assert not np.allclose(disturbed.state.seen.evidence.trust, clean.state.seen.evidence.trust, atol=0.1)
    deltas = len(run.deltas)
    run.feed(update, TICK)  # a repeat
    assert len(run.deltas) == deltas


def test_events_tell_what_became_of_the_regions():
    run, positions = finished()
    told = [event for delta in run.deltas for event in delta.events]
    alive = set()
    for event in told:
        if event.kind in ("appeared", "split"):
            assert event.region not in alive
            alive.add(event.region)
        elif event.kind in ("merged", "removed"):
            alive.remove(event.region)
    assert alive == set(run.reader.regions)
    gone = np.flatnonzero(positions[:, 0] >= 8.0)
    bedroom = next(region.id for region in run.reader.regions.values() if region.label == "bedroom")
    run.feed(no_places(revision=1, removed_ids=gone), TICK)
    assert ("removed", bedroom) in [(event.kind, event.region) for event in run.deltas[-1].events]
    run.concepts = np.array([(1.0, 1.0, 0.0), (0.0, 0.0, 1.0)])
    run.feed(task("find a bed"), prior(["day zone", "night zone"], "find a bed"), TICK)
    kinds = {event.kind for delta in run.deltas[-2:] for event in delta.events}
    assert "relabelled" in kinds or "merged" in kinds


def test_regions_know_their_doors_and_barely_seen_places_are_predicted():
    positions, edges, frames = world()
    lonely = np.vstack((positions, [(30.0, 30.0, 1.0)])).astype(np.float32)
    run = Run().feed(place_delta(lonely, edges), task(), prior(ROOMS), *frames, TICK)
    by_label = {region.label: region for region in run.reader.regions.values() if region.place_count > 1}
    kitchen, hall = by_label["kitchen"], by_label["hall"]
    assert kitchen.neighbour_ids == [hall.id] and sorted(hall.neighbour_ids) == sorted(
        [kitchen.id, by_label["bedroom"].id]
    )
    assert [way.door for way in kitchen.transitions] == [True]
    assert abs(kitchen.transitions[0].position_m[0] - 4.0) <= 0.5 and kitchen.transitions[0].clearance_m == 0.4
    assert run.deltas[-1].predicted_ids.tolist() or any(delta.predicted_ids.tolist() for delta in run.deltas)
    fresh = SERVICE.answers[REGION_SNAPSHOT](run.state, SnapshotRequest(robot=ROBOT), CFG)
    trust = run.state.seen.evidence.trust[run.state.seen.evidence.of(fresh.place_ids.tolist())]
    assert fresh.predicted_ids.tolist() == fresh.place_ids[trust < CFG.predicted_trust].tolist()
    assert len(positions) in fresh.predicted_ids.tolist() and len(fresh.predicted_ids) < len(positions) / 2
    assert not kitchen.predicted


def test_snapshot_before_anything_is_empty_and_the_first_delta_follows_it():
    whole = SERVICE.answers[REGION_SNAPSHOT](Run().state, SnapshotRequest(robot=ROBOT), CFG)
    assert whole.snapshot and whole.revision == -1 and not whole.regions
    run = Run().feed(task(), prior(ROOMS))  # no places yet
    assert run.deltas[0].revision == 0 and run.deltas[0].labels == ROOMS and len(run.deltas[0].place_ids) == 0


def test_same_inputs_give_the_same_bytes():
    first, second = finished()[0], finished()[0]
    assert [encode(delta) for delta in first.deltas] == [encode(delta) for delta in second.deltas]


def test_posterior_explains_the_label():
    run, _ = finished()
    reply = SERVICE.answers[POSTERIOR](run.state, PosteriorRequest(robot=ROBOT, place_id=5), CFG)
    assert reply.found and reply.label == "kitchen" and reply.labels == ROOMS and reply.frames > 0
    weighted = [np.array(vote.log_probabilities) * vote.weight for vote in reply.votes]
    np.testing.assert_allclose(reply.unary, -sum(weighted), atol=1e-9)
    assert [vote.expert for vote in reply.votes] == ["visual", "geometric", "object", "environment", "contents"]
    assert reply.votes[0].weight == pytest.approx(4.0 * reply.votes[0].confidence)
    np.testing.assert_allclose(reply.posterior, run.reader.beliefs[5][1], atol=0.02)
    likelihoods = np.exp(-(np.array(reply.unary) + reply.pull) / reply.temperature)
    np.testing.assert_allclose(reply.posterior, likelihoods / likelihoods.sum(), atol=1e-9)
    pull = [
        sum(near.weight * run.state.aim.in_force.pairwise[column, ROOMS.index(near.label)] for near in reply.neighbours)
        for column in range(3)
    ]
    np.testing.assert_allclose(reply.pull, pull, atol=1e-9)
    assert reply.region == run.reader.beliefs[5][0] and not reply.predicted
    assert not SERVICE.answers[POSTERIOR](run.state, PosteriorRequest(robot=ROBOT, place_id=777), CFG).found


def test_beta_zero_labels_each_place_by_its_own_evidence():
    run, _ = finished(cfg=Config(beta=0.0))
    np.testing.assert_array_equal(run.state.map.places.labels, run.state.map.places.unary.argmin(axis=1))


@pytest.mark.parametrize(("clearance_m", "factor"), [(0.0, 1.0), (0.8, 0.5), (0.2, 1.0)])
def test_pairwise_costs_by_hand(clearance_m, factor):
    """Two places 1 m apart with clearance 0.4: beta exp(-1 / 2) (-log 0.3) = 2 x 0.60653 x 1.20397 = 1.46049."""
    positions = np.array([(0.0, 0.0, 1.0), (1.0, 0.0, 1.0)])
    cfg = Config(edge_clearance_m=clearance_m, edge_sum=0.0, adjacency=AdjacencyConfig(border=0.0))
    run = Run(cfg=cfg).feed(place_delta(positions, np.array([(0, 1)])), task(), prior(ROOMS[:2]))
    mrf = inference.field_of(run.state)
    assert mrf.weights[0] * mrf.pairwise[0, 1] == pytest.approx(1.46049 * factor, abs=1e-4)
    assert mrf.pairwise[0, 0] == 0


@pytest.mark.parametrize("scale", [1.0, 50.0])
def test_edge_weights_by_hand(scale):
    """Equal edges 0-1, 1-2, 1-3 with sum 3 at a place: 3 / sqrt(1 x 3) = 1.73205 each, whatever their length."""
    positions = scale * np.array([(0.0, 0.0, 1.0), (1.0, 0.0, 1.0), (2.0, 0.0, 1.0), (1.0, 1.0, 1.0)])
    positions[:, 2] = 1.0
    run = Run().feed(place_delta(positions, np.array([(0, 1), (1, 2), (1, 3)])))
    np.testing.assert_allclose(edge_weights(run.state.map.graph, OPEN), np.sqrt(3.0), rtol=1e-6)
    doors = run.state.map.graph.clearances_m  # 0.4 m from the posts on each side
    assert np.allclose(doors, 0.4)
    np.testing.assert_allclose(edge_weights(run.state.map.graph, CFG), np.sqrt(3.0) / 2, rtol=1e-6)


def test_edge_weights_fall_with_length():
    """Path of 1 m and 3 m: w = 0.60653, 0.22313; 3 w / sqrt(d_u d_v) = 3 sqrt(w / 0.82966) = 2.5651, 1.5558."""
    positions = np.array([(0.0, 0.0, 1.0), (1.0, 0.0, 1.0), (4.0, 0.0, 1.0)])
    run = Run().feed(place_delta(positions, np.array([(0, 1), (1, 2)])))
    np.testing.assert_allclose(edge_weights(run.state.map.graph, OPEN), (2.5651, 1.5558), atol=1e-4)


def test_a_label_the_encoder_favours_everywhere_does_not_take_the_map():
    """The hall's similarity is read too high in all rooms; the proportions of the map tell."""
    positions, edges, frames = world()
    shifted = text(np.eye(len(ROOMS)), background_mean=np.array((0.0, -0.8, 0.0), dtype=np.float32))
    right = {}
    for limit in (0.0, 10.0):
        balance, apart = BalanceConfig(limit=limit, half_places=1.0), UnmixingConfig(rounds=0)
        cfg = Config(beta=0.0, region_cost=0.0, balance=balance, unmixing=apart)
        run = Run(cfg=cfg).feed(place_delta(positions, edges), task(), prior(ROOMS), answer_text=False)
        run.feed(shifted, *frames, TICK)
        inside = positions[:, 0] % 4.0 != 0
        right[limit] = (run.state.map.places.labels == positions[:, 0] // 4.0)[inside].mean()
    assert right[0.0] < 0.75 and right[10.0] > 0.9


def test_object_phrases_are_the_most_discriminative():
    containment = np.array([(0.9, 0.1), (0.1, 0.1)], dtype=np.float32)
    found = region_concepts(prior(["kitchen", "hall"], containment=containment), object_phrases=1)
    assert found == [["a kitchen", "an oven"], ["a hall"]]


def test_text_is_asked_in_the_configured_space():
    run = Run().feed(task(), prior(ROOMS), answer_text=False)
    assert run.asked[0].request == TextRequest(space=SPACE, concepts=[[f"a {name}"] for name in ROOMS])


@pytest.mark.parametrize(
    "fields",
    [
        {"experts": {"smell": 1.0}},
        {"edge_decay_m": 0.0},
        {"probability_floor": 0.0},
        {"beta": -1.0},
        {"edge_sum": -1.0},
    ],
)
def test_impossible_settings_are_refused(fields):
    with pytest.raises(ValueError):
        Config(**fields)


def test_borders_cost_by_adjacency_against_chance_whatever_a_prior_s_level():
    """Of pairs at 0.9, 0.3, 0.3 the first is likelier than chance, so its border is cheaper; all halved: alike."""
    adjacency = np.array([(1.0, 0.9, 0.3), (0.9, 1.0, 0.3), (0.3, 0.3, 1.0)])
    costs, halved = (
        border_costs(msgspec.structs.replace(prior(ROOMS), adjacency=(scale * adjacency).astype(np.float32)), Config())
        for scale in (1.0, 0.5)
    )
    chance = np.log((0.9 * 0.3 * 0.3) ** (1 / 3))
    assert costs[0, 1] == pytest.approx(2 * (1.5 + 0.5 * (chance - np.log(0.9))), abs=1e-5)
    assert costs[0, 2] == pytest.approx(2 * (1.5 + 0.5 * (chance - np.log(0.3))), abs=1e-5)
    np.testing.assert_allclose(costs, halved, atol=1e-5)
    flat = msgspec.structs.replace(prior(ROOMS), adjacency=np.full((3, 3), 0.2, np.float32))
    np.testing.assert_allclose(border_costs(flat, Config()), 3.0 * (1 - np.eye(3)), atol=1e-6)


def test_beliefs_are_the_less_sure_the_less_crops_tell():
    run, _ = finished()
    cfg = Config()
    run.state.labelling.told = 0.4
    assert inference.temperature(run.state, cfg) == cfg.temperature
    run.state.labelling.told = 0.05
    assert inference.temperature(run.state, cfg) == pytest.approx(4 * cfg.temperature)
    run.state.labelling.told = 0.0
    assert inference.temperature(run.state, cfg) == inference.LEAST_SURE * cfg.temperature
    assert inference.temperature(run.state, Config(informed=0.0)) == cfg.temperature

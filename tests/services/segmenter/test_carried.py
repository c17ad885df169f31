"""What is carried on from update to update equals what is found from nothing, to the last bit."""

import copy
from functools import partialmethod
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest

from prior_sg.schemas.codec import encode
from prior_sg.schemas.frames import Intrinsics
from prior_sg.schemas.status import Tick
from prior_sg.services.runtime.runner import Runner
from prior_sg.services.runtime.service import Identity
from prior_sg.services.segmenter.core import inference
from prior_sg.services.segmenter.core.config import Config
from prior_sg.services.segmenter.core.energy import swap_work
from prior_sg.services.segmenter.core.energy.region_cost import passes
from prior_sg.services.segmenter.core.energy.solver import Solver
from prior_sg.services.segmenter.core.evidence.kernel import (
    Frame,
    KernelConfig,
    frustums_with_any,
    in_frustum,
    project,
    visible,
)
from prior_sg.services.segmenter.core.layers.layer_map import LayerMap
from prior_sg.services.segmenter.core.layers.storeys import StoreyConfig, split, storeys_of
from prior_sg.services.segmenter.core.map.arcs import arcs_of
from prior_sg.services.segmenter.core.map.place_map import PlaceMap, edge_weights
from prior_sg.services.segmenter.core.map.received import ReceivedGraph, apply, inserted, with_neighbours
from prior_sg.services.segmenter.core.regions.components import events, numbered, track
from prior_sg.services.segmenter.core.regions.region_map import RegionMap
from prior_sg.services.segmenter.service import SERVICE
from tests.help.fields import random_field
from tests.help.world import ROBOT, place_delta, place_grid, prior, task, text, walk

NOBODY = np.array([(10**6, 10**6 + 1)])  # an edge that never was: with it, a delta takes the way of one that joins anew
ROOMS = ["kitchen", "hall", "bedroom"]


def random_deltas(rng, positions, edges, count):
    """The whole map, then deltas that mostly move places and tell their edges anew, some twice and to nobody."""
    yield place_delta(positions, edges)
    alive = np.arange(len(positions))
    for revision in range(1, count):
        told = np.sort(rng.choice(alive, 6, replace=False))
        of_told = edges[np.isin(edges, told).any(axis=1) & np.isin(edges, alive).all(axis=1)]
        kind = rng.integers(6)
        none = np.zeros(0, dtype=np.int64)
        gone = rng.choice(np.setdiff1d(alive, told), 2, replace=False) if kind == 0 else none
        new_edge = rng.choice(alive, (1, 2), replace=False) if kind == 1 else none.reshape(0, 2)
        twice = of_told[rng.integers(0, len(of_told), 2)][:, ::-1] if len(of_told) else none.reshape(0, 2)
        pairs = np.concatenate((of_told, twice, new_edge, [(told[0], 10**6)] if kind == 2 else none.reshape(0, 2)))
        shifts_m = rng.normal(0, 0.2, (len(told), 3)) * (rng.random((len(told), 1)) < 0.7)
        alive = np.setdiff1d(alive, gone)
        yield place_delta(
            positions[told] + shifts_m,
            pairs[~np.isin(pairs, gone).any(axis=1)],
            place_ids=told,
            revision=revision,
            removed_ids=gone,
            radii_m=rng.uniform(0.3, 0.8, len(told)).astype(np.float32),
            clearances_m=rng.uniform(0.2, 1.2, int((~np.isin(pairs, gone).any(axis=1)).sum())).astype(np.float32),
        )


def joined_anew(delta):
    return msgspec.structs.replace(delta, removed_edges=np.concatenate((delta.removed_edges, NOBODY)))


def equal(one, other):
    assert type(one) is type(other)
    for name, column in (one._asdict() if hasattr(one, "_asdict") else vars(one)).items():
        np.testing.assert_array_equal(column, getattr(other, name), err_msg=name)


@pytest.mark.parametrize("seed", range(4))
def test_a_delta_that_joins_nothing_anew_leaves_the_graph_that_one_that_might_leaves(seed):
    rng = np.random.default_rng(seed)
    positions, edges = place_grid(3)
    graph, kept = ReceivedGraph(), 0
    for delta in random_deltas(rng, positions, edges, 25):
        step, anew = apply(graph, delta, False), apply(graph, joined_anew(delta), False)
        for name in ("previous", "moved", "touched", "upserted", "removed", "same_rows"):
            np.testing.assert_array_equal(getattr(step, name), getattr(anew, name), err_msg=name)
        for name in ("ids", "positions_m", "radii_m", "edges", "clearances_m", "on_ground", "lengths_m"):
            np.testing.assert_array_equal(getattr(step.graph, name), getattr(anew.graph, name), err_msg=name)
        equal(step.graph.arcs, anew.graph.arcs)
        kept += step.graph.edges is graph.edges
        graph = step.graph
    assert 8 < kept < 24


@pytest.mark.parametrize("cfg", [Config(), Config(edge_sum=0.0), Config(edge_clearance_m=0.0)])
def test_kept_weights_equal_those_found_from_nothing(cfg):
    rng = np.random.default_rng(7)
    positions, edges = place_grid(3)
    held = PlaceMap()
    for delta in random_deltas(rng, positions, edges, 25):
        held.advance(delta, cfg)
        graph = held.graph
        fresh = ReceivedGraph(graph.ids, graph.positions_m, graph.radii_m, graph.edges, graph.clearances_m)
        weights = edge_weights(fresh, cfg)
        np.testing.assert_array_equal(held.weights, weights)
        equal(graph.arcs, arcs_of(len(graph.ids), graph.edges, fresh.lengths_m))
        equal(held.ties, arcs_of(len(graph.ids), graph.edges, weights))


def deltas_of(messages, cfg):
    """All that a segmenter tells, as bytes, and how often its edges were kept."""

    def answer(request):
        return text(np.eye(3)[: len(request.concepts)]) if hasattr(request, "concepts") else None

    runner = Runner(SERVICE, cfg, Identity(ROBOT, "i", 1), dict.fromkeys(SERVICE.asks, answer), wire=True)
    told, kept = [], 0
    for message in messages:
        edges = runner.state.map.graph.edges
        told += [encode(output) for _, output in runner.feed(message)]
        kept += runner.state.map.graph.edges is edges
    return told, kept


@pytest.mark.parametrize("budget_ms", [40.0, 2.0])
def test_a_segmenter_that_carries_on_tells_what_one_that_starts_anew_tells(budget_ms, monkeypatch):
    rng = np.random.default_rng(3)
    positions, edges = place_grid(3)
    zones = [msgspec.structs.replace(one, parent=f"{one.name} zone") for one in prior(ROOMS).regions]
    messages = [task(), msgspec.structs.replace(prior(ROOMS), regions=zones)]
    for turn, (delta, frame) in enumerate(zip(random_deltas(rng, positions, edges, 30), walk(3), strict=False)):
        messages += [delta, frame, *([Tick(stamp_ns=turn)] if turn % 9 == 8 else [])]
    cfg = Config(budget_ms=budget_ms)
    carried, kept = deltas_of(messages, cfg)
    anew = [joined_anew(one) if hasattr(one, "removed_edges") else one for one in messages]
    monkeypatch.setattr(LayerMap, "renew", partialmethod(_all_afresh, LayerMap.renew))
    monkeypatch.setattr(inference, "passes", _passes_anew)
    monkeypatch.setattr(RegionMap, "partition", partialmethod(_parted_afresh, RegionMap.partition))
    found, kept_anew = deltas_of(anew, cfg)
    assert carried == found and len(carried) > 20
    assert kept - kept_anew > 5


def _passes_anew(field, labels, cost, *_former, **_changed):
    """`passes` as if there had been none before."""
    return passes(field, labels, cost)


def _parted_afresh(regions, partition, place_map, *arguments):
    """`partition` as if all places were marked."""
    place_map.places.unparted[:] = True
    return partition(regions, place_map, *arguments)


def _all_afresh(layers, renew, *arguments, changed, **named):
    """`renew` as if every region had changed."""
    renew(layers, *arguments, changed=None, **named)


@pytest.mark.parametrize("seed", range(4))
def test_sorted_queues_are_those_filled_from_the_flags(seed):
    field, rng = random_field(seed, 80, 5, degree=5), np.random.default_rng(seed)
    solver = Solver()
    solver.take(field, rng.integers(0, 5, 80))
    work = solver._work
    swap_work.flag_all(rng.choice(80, 30, replace=False), swap_work.NEAR, work)
    work.pending[rng.random(work.pending.shape) < 0.5] = swap_work.NOT_PENDING
    fresh = swap_work.empty_work(80, 5, len(solver._graph.neighbours))
    fresh.pending[:] = work.pending
    swap_work.requeue(fresh)
    sorted_ = copy.deepcopy(work)
    swap_work.sort_queues(sorted_)
    for ring in range(2):
        counts = sorted_.rings[ring, swap_work.COUNT]
        assert counts == fresh.rings[ring, swap_work.COUNT] and sorted_.rings[ring, swap_work.HEAD] == 0
        np.testing.assert_array_equal(sorted_.queues[ring, :counts], fresh.queues[ring, :counts])
    np.testing.assert_array_equal(sorted_.queued, fresh.queued)


def test_places_in_a_frustum_are_those_found_by_projecting_all():
    rng, cfg = np.random.default_rng(1), KernelConfig(border_share=0.05)
    camera = Intrinsics(width_px=640, height_px=480, fx_px=525.0, fy_px=500.0, cx_px=300.0, cy_px=250.0)
    size = np.array((640, 480))
    seen = 0
    for _ in range(20):
        pose = np.eye(4)
        pose[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        pose[:3, 3] = rng.normal(0, 2, 3)
        none = np.zeros((0, 2), np.float32)
        frame = Frame(pose, camera, none, none[:, 0], none[:, 0], none, rng.uniform(0, 9, (30, 40)).astype(np.float16))
        positions_m = rng.uniform(-12, 12, (4_000, 3))
        pixels, depths_m = project(frame, positions_m)
        inside = (depths_m >= cfg.min_depth_m) & (depths_m <= cfg.max_depth_m)
        inside &= ((pixels >= 0.05 * size - 0.5) & (pixels < 0.95 * size - 0.5)).all(axis=1)
        rows = np.flatnonzero(inside)
        column, row = ((pixels[rows] + 0.5) / size * (40, 30)).astype(int).T
        surface_m = frame.surface_m[row, column]
        expected = rows[(surface_m > 0) & (depths_m[rows] - cfg.occlusion_tolerance_m <= surface_m)]
        np.testing.assert_array_equal(visible(frame, positions_m, cfg), expected)
        seen += len(expected)
    assert seen > 300


def coming_and_going(rng, positions, edges, first, count):
    """`first` places, then deltas in which places come, go, move, grow and are merged, and edges come and go."""
    yield place_delta(positions[:first], edges[(edges < first).all(axis=1)])
    alive, now = set(range(first)), positions.copy()
    for revision in range(1, count):
        told, moves = np.sort(rng.choice(len(positions), 6, replace=False)), rng.random() < 0.6
        rest = rng.permutation(np.setdiff1d([*alive], told))
        gone, merged = rest[: rng.integers(3)], rest[4 : 4 + rng.integers(2)]
        alive = (alive - {*gone.tolist(), *merged.tolist()}) | {*told.tolist()}
        now[told] += moves * rng.normal(0, 0.1, (len(told), 3)).astype(np.float32)
        of_told = edges[np.isin(edges, told).any(axis=1) & np.isin(edges, [*alive]).all(axis=1)]
        new_edge = np.sort(rng.choice([*alive], (rng.integers(2), 2), replace=False))
        pairs = np.concatenate((of_told, new_edge))[:: 1 if moves else 9]
        yield place_delta(
            now[told],
            pairs,
            place_ids=told,
            revision=revision,
            removed_ids=np.sort(gone),
            merged_ids=np.array([(one, told[0]) for one in merged], np.int64).reshape(-1, 2),
            removed_edges=edges[rng.choice(len(edges), rng.integers(3))],
            radii_m=rng.uniform(0.2, 0.9, len(told)).astype(np.float32),
            clearances_m=rng.uniform(0.2, 1.2, len(pairs)).astype(np.float32),
        )


@pytest.mark.parametrize("seed", range(12))
def test_regions_found_around_what_changed_are_those_of_the_whole_map(seed):
    """Two floors, joined here and there, of which the upper is found by and by: regions are torn between storeys."""
    rng, cfg, storeys_met = np.random.default_rng(seed), StoreyConfig(least_m2=20.0, part_m2=2.0), set()
    positions, edges = place_grid(3)
    positions, edges = (
        np.concatenate((positions, positions + np.array((0, 0, 3), np.float32))),
        np.concatenate((edges, edges + len(positions), [(row, row + len(positions)) for row in range(0, 48, 7)])),
    )
    held, regions, next_id, before = PlaceMap(), RegionMap(), 0, {}
    for delta in coming_and_going(rng, positions, edges, 70, 40):
        regions.follow(held.advance(delta, Config()), held)
        places, count = held.places, len(held.graph.ids)
        places.slots = np.arange(count)
        other = rng.choice(count, 2) if regions.known else np.arange(count)
        places.labels[other], places.unparted[other] = rng.integers(0, 2, len(other)), True
        fresh = places.labels < 0
        places.labels[fresh] = rng.integers(0, 2, int(fresh.sum()))
        former, graph = places.regions.copy(), held.graph
        changes = regions.partition(held, ["hall", "den"], cfg)
        storeys = storeys_of(graph, cfg)
        component = split(numbered(places.labels, graph.edges), graph.edges, storeys, cfg)
        wanted, next_id = track(component, former, next_id)
        np.testing.assert_array_equal(places.regions, wanted)
        assert regions.next_id == next_id and not places.unparted.any()
        after = {region: ["hall", "den"][label] for region, label in zip(wanted, places.labels, strict=True)}
        assert changes == events(former, wanted, before, after)
        assert places.unbelieved[wanted != former].all()
        beside = with_neighbours(graph, wanted != former)
        assert {*former[wanted != former].tolist(), *wanted[beside].tolist()} <= regions.disturbed
        regions.describe({region: SimpleNamespace(label=label) for region, label in after.items()})
        before = after
        storeys_met.add(len(storeys.floors_m))
    assert 2 in storeys_met


def test_a_storey_found_elsewhere_tears_a_region_that_nothing_touched():
    """A house with a loft, too small to be a storey of its own until the house far away turns out to have one."""
    positions, edges = place_grid(2)
    far, up, count = np.array((100, 0, 0), np.float32), np.array((0, 0, 3), np.float32), len(positions)
    loft = positions[:10] + up
    house = np.concatenate((positions, loft))
    inside = np.concatenate((edges, edges[(edges < 10).all(axis=1)] + count, [(0, count)]))
    held, regions = PlaceMap(), RegionMap()
    both = np.concatenate((house, positions + far)), np.concatenate((inside, edges + len(house)))
    upstairs = np.arange(count) + len(both[0])
    late = place_delta(
        positions + far + up,
        np.concatenate((edges + len(both[0]), [(len(house), upstairs[0])])),
        place_ids=upstairs,
        revision=1,
    )
    found = []
    for delta in (place_delta(*both), late):
        regions.follow(held.advance(delta, Config()), held)
        held.places.slots, held.places.labels = np.arange(len(held.graph.ids)), np.zeros(len(held.graph.ids), np.int64)
        regions.partition(held, ["hall"], StoreyConfig(least_m2=8.0, part_m2=2.0))
        regions.describe({region: SimpleNamespace(label="hall") for region in np.unique(held.places.regions).tolist()})
        found.append(len(np.unique(held.places.regions[: len(house)])))
    assert found == [1, 2]


@pytest.mark.parametrize("seed", range(4))
def test_rows_put_in_block_by_block_are_those_of_numpy(seed):
    rng = np.random.default_rng(seed)
    for count, new in rng.integers(0, 9, (50, 2)):
        column, values = rng.integers(0, 99, (count, 2)), rng.integers(0, 99, (new, 2))
        at = np.sort(rng.integers(0, count + 1, new))
        np.testing.assert_array_equal(inserted(column, at, values), np.insert(column, at, values, axis=0))


def test_frustums_with_any_are_those_in_which_some_place_is_found():
    rng, met = np.random.default_rng(2), 0
    poses = np.tile(np.eye(4), (60, 1, 1))
    poses[:, :3, :3] = np.linalg.qr(rng.normal(size=(60, 3, 3)))[0]
    poses[:, :3, 3] = rng.normal(0, 5, (60, 3))
    tangents = np.tile((-0.9, 0.7, -0.5, 0.6), (60, 1))
    for spread_m in (0.1, 1.0, 5.0):
        for _ in range(20):
            positions_m = rng.normal(0, 5, 3) + rng.normal(0, spread_m, (5, 3))
            found = frustums_with_any(poses, tangents, positions_m, 0.3, 6.0)
            each = [len(in_frustum(*camera, positions_m, 0.3, 6.0)) > 0 for camera in zip(poses, tangents, strict=True)]
            np.testing.assert_array_equal(found, np.flatnonzero(each))
            met += len(found)
    assert 60 < met < 1800

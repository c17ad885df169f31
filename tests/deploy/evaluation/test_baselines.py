"""The baselines behave as their descriptions say, on worlds made by hand."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import jensenshannon

from prior_sg.deploy.evaluation.baselines import argmax, clio, common, hovsg, hydra
from prior_sg.deploy.evaluation.metrics import evaluate
from prior_sg.deploy.truth import GroundTruth
from prior_sg.schemas.features import Pyramid, TextEmbeddings
from prior_sg.schemas.frames import Intrinsics
from prior_sg.schemas.places import VoxelMap
from prior_sg.schemas.regions import NO_REGION
from tests.help.world import SPACE, place_delta

VOXEL_M = 0.1
CAMERA = Intrinsics(width_px=64, height_px=48, fx_px=32.0, fy_px=32.0, cx_px=31.5, cy_px=23.5)
NAMES = ("office", "kitchen")
TRUTH = GroundTruth.from_json(
    {
        "floors": [{"id": 0, "z_min_m": -0.1, "z_max_m": 2.7}],
        "regions": [
            {"id": 0, "label": "office", "floor": 0, "polygon_m": [[0, 0], [4, 0], [4, 4], [0, 4]]},
            {"id": 1, "label": "kitchen", "floor": 0, "polygon_m": [[4, 0], [8, 0], [8, 4], [4, 4]]},
        ],
    }
)


def flat(wall):
    """A voxel map of an 8 m x 4 m flat of 2.5 m; with `wall`, one with a doorway of 0.8 m divides it at x = 4 m."""
    solid = np.zeros((82, 42, 27), bool)
    solid[[0, -1]] = solid[:, [0, -1]] = solid[:, :, [0, -1]] = True
    if wall:
        solid[40:42] = True
        solid[40:42, 17:25, 1:22] = False
    cells = np.argwhere(solid), np.argwhere(~solid)
    occupied, free = ((found - 1).astype(np.int16) for found in cells)
    return VoxelMap(robot="r1", voxel_m=VOXEL_M, free=free, occupied=occupied)


def pyramid(frame_id, camera_m, direction, embedding):
    """A view from `camera_m` along +x (1) or -x (-1), of one crop, with a wall 3.8 m ahead."""
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack(((0, -direction, 0), (0, 0, -1), (direction, 0, 0)))
    pose[:3, 3] = camera_m
    return Pyramid(
        robot="r1",
        frame_id=frame_id,
        stamp_ns=frame_id,
        space=SPACE,
        worker="w",
        intrinsics=CAMERA,
        world_from_camera=pose,
        centers_px=np.array([(31.5, 23.5)], np.float32),
        sigmas_px=np.array([24.0], np.float32),
        layers=np.zeros(1, np.uint8),
        depths_m=np.array([3.8], np.float32),
        embeddings=np.array([embedding], np.float16),
        surface_m=np.full((6, 8), 3.8, np.float32),
        crops_total=1,
    )


def flat_inputs(wall=True, swapped=False):
    """Places 0.5 m apart in the flat, with or without the wall, and two views of each half, from its opposite sides."""
    points = [
        (x, y, 1.2) for x in np.arange(0.5, 8.0, 0.5) for y in np.arange(0.5, 4.0, 0.5) if not (wall and x == 4.0)
    ]
    points += [(4.0, 2.0, 1.2)] if wall else []
    positions = np.array(points, np.float32)
    first, second = np.triu_indices(len(positions), 1)
    near = np.linalg.norm(positions[first] - positions[second], axis=1) < 0.6
    edges = np.stack((first, second), axis=1)[near]
    clearances = np.full(len(edges), 1.0, np.float32)
    if wall:
        clearances[(positions[edges][:, :, 0] == 4.0).any(axis=1)] = 0.4
    basis = np.eye(3)
    kinds = basis[[1, 0]] if swapped else basis[:2]
    views = [
        pyramid(10 * room + turn, (4 * room + 2.0 - 1.9 * direction, 2.0, 1.2), direction, kinds[room])
        for room in (0, 1)
        for turn, direction in enumerate((1, -1))
    ]
    delta = place_delta(
        positions,
        edges,
        clearances_m=clearances,
        radii_m=np.full(len(positions), 0.4, np.float32),
        snapshot=True,
    )
    text = TextEmbeddings(
        space=SPACE,
        embeddings=basis[:2].astype(np.float32),
        background_mean=np.zeros(2, np.float32),
        background_std=np.full(2, 0.1, np.float32),
        temperature=1.0,
        null_score=1.0,
    )
    return common.Inputs.of(delta, views, NAMES, text, flat(wall))


def partition(regions):
    """The sets of rows that share a region."""
    return {frozenset(np.flatnonzero(regions == region).tolist()) for region in np.unique(regions).tolist()}


def test_inputs_sort_places_by_id_and_edges_follow():
    inputs = flat_inputs()
    shuffled = np.random.default_rng(3).permutation(len(inputs.place_ids))
    delta = place_delta(
        inputs.positions_m[shuffled].astype(np.float32),
        inputs.place_ids[inputs.edges],
        place_ids=inputs.place_ids[shuffled],
        radii_m=inputs.radii_m[shuffled].astype(np.float32),
        clearances_m=inputs.clearances_m.astype(np.float32),
    )
    again = common.Inputs.of(delta, inputs.pyramids, inputs.names, inputs.text, inputs.voxels)
    np.testing.assert_array_equal(again.positions_m, inputs.positions_m)
    np.testing.assert_array_equal(again.edges, inputs.edges)
    with pytest.raises(ValueError, match="one concept"):
        common.Inputs.of(delta, inputs.pyramids, ("office",), inputs.text, inputs.voxels)


def test_global_feature_is_the_mean_of_the_largest_layer():
    single = pyramid(1, (0, 0, 0), 1, (1, 0, 0))
    several = {
        "centers_px": np.zeros((3, 2), np.float32),
        "sigmas_px": np.array([8, 24, 24], np.float32),
        "layers": np.array([0, 2, 2], np.uint8),
        "depths_m": np.ones(3, np.float32),
        "embeddings": np.array([(0, 0, 1), (1, 0, 0), (0, 1, 0)], np.float16),
    }
    empty = {name: value[:0] for name, value in several.items()}
    fields = {name: getattr(single, name) for name in single.__struct_fields__}
    inputs = flat_inputs()
    views = common.Inputs(
        **{name: getattr(inputs, name) for name in inputs.__dataclass_fields__}
        | {"pyramids": (Pyramid(**fields | several), Pyramid(**fields | empty))}
    ).views
    assert len(views.pyramids) == 1
    np.testing.assert_allclose(views.embeddings, [(0.5**0.5, 0.5**0.5, 0)])


def test_scene_carries_regions_and_scores_one_when_right():
    inputs = flat_inputs()
    regions = (inputs.positions_m[:, 0] >= 4.0).astype(np.int64)
    scene = common.to_scene(inputs, [NAMES[region] for region in regions], regions)
    assert [(region.id, region.label) for region in scene.regions] == [(0, "office"), (1, "kitchen")]
    scores = evaluate(scene, inputs.voxels, TRUTH)
    assert scores["f1_s"] == scores["miou_s_penalised"] == 1.0
    with pytest.raises(ValueError, match="several labels"):
        common.to_scene(inputs, [NAMES[region] for region in regions], np.zeros_like(regions))


@pytest.mark.parametrize("module", [argmax, clio, hovsg, hydra])
def test_each_baseline_solves_two_clear_rooms_and_repeats_itself(module):
    inputs = flat_inputs()
    cfg = {
        argmax: argmax.Config(),
        clio: clio.Config(score_threshold=0.3, max_delta=0.1, max_depth_m=3.9),
        hovsg: hovsg.Config(),
        hydra: hydra.Config(min_dilation_m=0.3),
    }[module]
    answer = module.segment(inputs, cfg)
    scores = evaluate(common.to_scene(inputs, answer.labels, answer.regions), inputs.voxels, TRUTH)
    assert scores["f1_s"] > 0.85
    assert scores["accuracy"] > 0.85
    again = module.segment(flat_inputs(), cfg)
    assert again.labels == answer.labels
    assert again.regions.tobytes() == answer.regions.tobytes()


@pytest.mark.parametrize("module", [argmax, clio, hovsg, hydra])
def test_names_follow_the_views(module):
    cfg = {hydra: hydra.Config(min_dilation_m=0.3), clio: clio.Config(max_delta=0.1, max_depth_m=3.9)}.get(module)
    inputs = flat_inputs(swapped=True)
    answer = module.segment(inputs, cfg or module.Config())
    left, right = (answer.labels[i] for i in (inputs.positions_m[:, 0].argmin(), inputs.positions_m[:, 0].argmax()))
    assert (left, right) == ("kitchen", "office")


def test_argmax_splits_one_label_where_the_graph_is_cut():
    inputs = flat_inputs()
    x_m = inputs.positions_m[:, 0]
    door = (x_m == 4.0).nonzero()[0][0]
    same = common.TextEmbeddings(
        space=SPACE,
        embeddings=np.array([(1, 1, 0), (-1, 0, 0)], np.float32),
        background_mean=np.zeros(2, np.float32),
        background_std=np.ones(2, np.float32),
        temperature=1.0,
        null_score=1.0,
    )
    fields = {name: getattr(inputs, name) for name in inputs.__dataclass_fields__} | {"text": same}
    observed = inputs.descriptors[1]
    assert observed[door]
    joined = argmax.segment(common.Inputs(**fields), argmax.Config())
    assert {label for label, seen in zip(joined.labels, observed, strict=True) if seen} == {"office"}
    assert len(set(joined.regions[observed].tolist())) == 1
    cut = (inputs.edges == door).any(axis=1)
    fields |= {"edges": inputs.edges[~cut], "clearances_m": inputs.clearances_m[~cut]}
    parted = argmax.segment(common.Inputs(**fields), argmax.Config())
    assert len(set(parted.regions[observed].tolist())) == 3  # two rooms and the place in the doorway


# Clio


def test_clio_counts_the_best_task_twice_and_prunes_what_is_nearest_to_null():
    cfg = clio.Config(score_threshold=0.2)
    found = clio.task_distributions(np.array([(0.4, 0.3, 0.1), (0.3, 0.1, 0.1), (0.19, 0.1, 0.1)]), cfg)
    np.testing.assert_allclose(found[0], np.array((0, 0.8, 0.3, 0)) / 1.1, atol=1e-9)
    np.testing.assert_allclose(found[1], np.array((0.2, 0.6, 0, 0)) / 0.8, atol=1e-9)
    np.testing.assert_allclose(found[2], (1, 0, 0, 0), atol=1e-9)
    kept = clio.task_distributions(
        np.array([(0.19, 0.1, 0.1)]), clio.Config(score_threshold=0.2, null_task_preprune=False)
    )
    np.testing.assert_allclose(kept[0], np.array((0.4, 0.19, 0, 0)) / 0.59, atol=1e-9)


def test_clio_sees_through_walls_up_to_its_range():
    inputs = flat_inputs()
    far = np.flatnonzero((inputs.positions_m[:, 0] == 7.5) & (inputs.positions_m[:, 1] == 2.0))
    near, _ = clio.place_features(inputs, clio.Config(max_depth_m=3.9))
    smeared, seen = clio.place_features(inputs, clio.Config(max_depth_m=10.0))
    np.testing.assert_allclose(near[far], [(0, 1, 0)])
    np.testing.assert_allclose(smeared[far], [(1 / 3, 2 / 3, 0)])  # one of the three views is in the other room
    assert seen.all()
    assert not clio.place_features(inputs, clio.Config(max_depth_m=1.0))[1].all()


def chain(count):
    return np.stack((np.arange(count - 1), np.arange(1, count)), axis=1)


def test_clio_merges_what_is_similar_and_keeps_apart_what_is_not():
    kinds = np.array([(0.8, 0.1, 0.1), (0.1, 0.8, 0.1)])[[0, 0, 0, 1, 1, 0]]
    assert clio.bottleneck(kinds, chain(6), 0.01).tolist() == [0, 0, 0, 3, 3, 5]
    assert clio.bottleneck(kinds, chain(6), 1.1).tolist() == [0] * 6


def test_clio_never_merges_disconnected_parts():
    same = np.tile((0.8, 0.1, 0.1), (6, 1))
    assert clio.bottleneck(same, np.array([(0, 1), (1, 2), (3, 4), (4, 5)]), 1e9).tolist() == [0, 0, 0, 3, 3, 3]


def test_clio_without_places_or_information():
    assert clio.bottleneck(np.zeros((0, 3)), np.zeros((0, 2), np.int64), 0.01).tolist() == []
    assert clio.bottleneck(np.full((2, 4), 0.25), chain(2), 0.01).tolist() == [0, 1]  # nothing to lose: no share of it


def literal_bottleneck(distributions, edges, max_delta):
    """The description word by word: score all edges by the Jensen-Shannon divergence, merge the least, recompute I."""
    groups = [[place] for place in range(len(distributions))]

    def mixed(group):
        return distributions[group].mean(axis=0)

    def mutual(parts):
        uniform = 1 / distributions.shape[1]
        shares = [len(part) / len(distributions) for part in parts]
        return sum(
            share * (mixed(p) * np.log(mixed(p) / uniform)).sum() for share, p in zip(shares, parts, strict=True)
        )

    total = mutual(groups)
    while True:
        owner = {place: number for number, group in enumerate(groups) for place in group}
        pairs = {tuple(sorted((owner[a], owner[b]))) for a, b in edges.tolist() if owner[a] != owner[b]}
        if not pairs:
            break

        def score(pair, groups=groups):
            a, b = (groups[number] for number in pair)
            weight = len(a) / (len(a) + len(b))
            middle = mixed(a + b)
            terms = [(mixed(g) * np.log(mixed(g) / middle)).sum() for g in (a, b)]
            return (len(a) + len(b)) / len(distributions) * (weight * terms[0] + (1 - weight) * terms[1])

        a, b = min(pairs, key=score)
        merged = [group for number, group in enumerate(groups) if number not in (a, b)] + [groups[a] + groups[b]]
        if (mutual(groups) - mutual(merged)) / total >= max_delta:
            break
        groups = merged
    return {frozenset(group) for group in groups}


@settings(max_examples=60)
@given(st.integers(0, 10**6), st.integers(2, 14), st.sampled_from([0.001, 0.01, 0.05, 0.2, 2.0]))
def test_clio_heap_equals_the_literal_version(seed, count, max_delta):
    rng = np.random.default_rng(seed)
    distributions = rng.dirichlet(np.full(4, 0.7), count) * 0.99 + 0.0025
    first, second = np.triu_indices(count, 1)
    edges = np.stack((first, second), axis=1)[rng.random(len(first)) < 0.4]
    found = clio.bottleneck(distributions, edges, max_delta)
    assert partition(found) == literal_bottleneck(distributions, edges, max_delta)


def test_clio_merge_costs_the_information_it_loses():
    distributions = np.array([(0.7, 0.2, 0.1), (0.1, 0.3, 0.6)])
    clusters = clio.Clusters(distributions.copy(), np.array([0.5, 0.5]), [{1}, {0}])
    cost = clusters.cost(0, 1)
    assert cost == pytest.approx(jensenshannon(*distributions) ** 2)
    before = clio.information(distributions, np.array([0.5, 0.5]))
    clusters.merge(0, 1)
    assert before - clio.information(clusters.distributions, clusters.weights) == pytest.approx(cost)


# Hydra


def dumbbell(sizes, bridges_m):
    """Chains of places of clearance 1 m, joined in a row by edges of the given clearances."""
    ends = np.cumsum(sizes)
    edges = chain(int(ends[-1]))
    clearances = np.full(len(edges), 1.0)
    clearances[ends[:-1] - 1] = bridges_m
    return int(ends[-1]), edges, clearances


def test_hydra_splits_at_the_doorway():
    assert hydra.rooms(*dumbbell((12, 12), (0.6,)), hydra.Config()).tolist() == [0] * 12 + [1] * 12


def test_hydra_merges_an_open_plan():
    assert hydra.rooms(*dumbbell((12, 12), (1.0,)), hydra.Config()).tolist() == [0] * 24


def test_hydra_prefers_the_longest_enough_lasting_largest_number_of_components():
    graph = dumbbell((12, 12, 12), (0.6, 0.95))
    runs = hydra.filtration(*graph, hydra.Config())
    assert [(run.components, run.low_m, round(run.lifetime_m, 6)) for run in runs] == [
        (3, 1.0, 0.05),
        (2, 0.95, 0.35),
        (1, 0.6, 0.1),
    ]
    assert hydra.rooms(*graph, hydra.Config()).tolist() == [0] * 12 + [1] * 24
    assert len(set(hydra.rooms(*graph, hydra.Config(min_lifetime_ratio=0.1)).tolist())) == 3


def test_hydra_flood_follows_the_widest_edge():
    count, edges, clearances = dumbbell((12, 1, 12), (0.6, 0.62))
    assert hydra.rooms(count, edges, clearances, hydra.Config()).tolist() == [0] * 12 + [1] * 13


def test_hydra_leaves_out_what_no_large_room_reaches():
    count, edges, clearances = dumbbell((12, 4), (1.0,))
    cut = clearances.copy()
    kept = np.arange(len(edges)) != 11
    found = hydra.rooms(count, edges[kept], cut[kept], hydra.Config())
    assert found.tolist() == [0] * 12 + [NO_REGION] * 4
    assert set(hydra.rooms(count, edges[kept], cut[kept], hydra.Config(max_dilation_m=0.9, min_room_size=13))) == {-1}
    assert set(hydra.rooms(3, chain(3), np.ones(2), hydra.Config())) == {-1}


@settings(max_examples=60)
@given(st.integers(0, 10**6))
def test_hydra_component_counts_equal_counting_afresh(seed):
    import networkx

    rng = np.random.default_rng(seed)
    first, second = np.triu_indices(12, 1)
    edges = np.stack((first, second), axis=1)[rng.random(len(first)) < 0.25]
    clearances = rng.integers(1, 8, len(edges)) / 5.0
    cfg = hydra.Config(min_dilation_m=0.1, max_dilation_m=2.0, min_component_size=3)
    runs = hydra.filtration(12, edges, clearances, cfg)
    for run in runs:
        graph = networkx.Graph(edges[clearances >= run.low_m].tolist())
        assert sum(len(part) >= 3 for part in networkx.connected_components(graph)) == run.components


# HOV-SG


def test_hovsg_splits_rooms_with_walls_and_merges_an_open_plan():
    walled = hovsg.rooms(flat(True), hovsg.Floor(-0.1, 2.6), hovsg.Config())
    assert walled.rooms.max() == 2
    left, right = (hovsg.room_of(walled, np.array(at), 0.3) for at in ((2.0, 2.0), (6.0, 2.0)))
    assert {left, right} == {1, 2}
    for room, x_m in ((left, 2.0), (right, 6.0)):
        cells_m = walled.cells_m(room)
        within = (np.abs(cells_m - (x_m, 2.0)) < 1.85).all(axis=1)  # up to the blurred walls
        assert within.sum() * walled.cell_m**2 == pytest.approx(3.7**2, rel=0.02)
    indoors = {room: walled.cells_m(room) for room in (left, right)}
    indoors = {room: cells_m[np.abs(cells_m[:, 1] - 2.0) < 1.85, 0] for room, cells_m in indoors.items()}
    indoors = {
        room: x_m[(x_m > 0.0) & (x_m < 8.0)] for room, x_m in indoors.items()
    }  # a strip outdoors joins some room
    assert (indoors[left].max(), indoors[right].min()) == pytest.approx((4.0, 4.0), abs=0.15)
    open_plan = hovsg.rooms(flat(False), hovsg.Floor(-0.1, 2.6), hovsg.Config())
    assert open_plan.rooms.max() == 1


def test_hovsg_open_plan_gets_one_name_for_two_regions():
    inputs = flat_inputs(wall=False)
    answer = hovsg.segment(inputs, hovsg.Config())
    assert len(set(answer.regions.tolist())) == len(set(answer.labels)) == 1
    scores = evaluate(common.to_scene(inputs, answer.labels, answer.regions), inputs.voxels, TRUTH)
    assert scores["r_g"] == 1.0
    assert 0.4 < scores["p_g"] < 0.6


def test_hovsg_finds_storeys():
    one = (flat(True).occupied[:, 2] + 0.5) * VOXEL_M
    (single,) = hovsg.floors(one, VOXEL_M, hovsg.Config())
    assert (single.low_m, single.high_m) == pytest.approx((-0.075, 2.575), abs=0.011)
    two = np.concatenate((one, one + 2.9))  # 0.3 m of slab between the storeys
    low, high = hovsg.floors(two, VOXEL_M, hovsg.Config())
    assert (low.high_m, high.low_m) == pytest.approx((2.55, 2.85), abs=0.02)
    assert hovsg.floors(np.zeros(0), VOXEL_M, hovsg.Config()) == []
    (flatland,) = hovsg.floors(np.full(9, 1.05), VOXEL_M, hovsg.Config())
    assert (flatland.low_m, flatland.high_m) == pytest.approx((1.0, 1.1))


def test_hovsg_representatives_are_one_per_cluster():
    rng = np.random.default_rng(1)
    centres = np.eye(4)[:3] * 5
    points = np.concatenate([centre + rng.normal(0, 0.1, (20, 4)) for centre in centres])
    chosen = hovsg.representatives(points, 3)
    assert sorted(chosen // 20) == [0, 1, 2]
    assert hovsg.representatives(points[:2], 3).tolist() == [0, 1]


def test_hovsg_majority_of_votes_names_the_room():
    inputs = flat_inputs(wall=False)
    views = [pyramid(i, (2.0 + 0.1 * i, 2.0, 1.2), 1, e) for i, e in enumerate([(1, 0, 0), (0, 1, 0), (0, 1, 0.1)])]
    plan = hovsg.rooms(inputs.voxels, hovsg.Floor(-0.1, 2.6), hovsg.Config())
    cameras = common.Views(tuple(views), common.unit(np.array([v.embeddings[0] for v in views], float)))
    assert hovsg.name_rooms(plan, cameras, inputs, hovsg.Config()) == ["kitchen"]
    nothing = common.Views((), np.zeros((0, 3)))
    assert hovsg.name_rooms(plan, nothing, inputs, hovsg.Config()) == [common.NO_LABEL]

"""Metrics: cases worked by hand, and literal slow implementations on random worlds."""

import itertools
import json
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from prior_sg.deploy.evaluation.metrics import SCORES, Beliefs, assign, beliefs_of, evaluate, reliability, risk
from prior_sg.deploy.truth import GroundTruth, voxel_owners
from prior_sg.schemas.places import VoxelMap
from prior_sg.schemas.regions import Region
from prior_sg.schemas.scene import Scene
from tests.help.paths import SHARED_DATA

DATA = SHARED_DATA
KEYS = [
    "f1_s",
    "f1_g",
    "p_s",
    "r_s",
    "p_g",
    "r_g",
    "miou_s",
    "miou_g",
    "miou_s_penalised",
    "miou_g_penalised",
    "accuracy",
    "boundary_f1",
]  # `ece` besides, which depends on posteriors
FLOOR = {"id": 0, "z_min_m": 0.0, "z_max_m": 3.0}


def make_scene(positions, radii, place_regions, names, *, labels=(), posteriors=None):
    count = len(positions)
    regions = [
        Region(id=i, label=name, place_count=1, probability=1.0, position_m=(0.0, 0.0, 0.0), area_m2=1.0)
        for i, name in names.items()
    ]
    return Scene(
        robot="r",
        stamp_ns=0,
        environment="",
        task="",
        prior_digest="",
        space="",
        labels=list(labels),
        regions=regions,
        place_ids=np.arange(count),
        positions_m=np.array(positions, np.float32).reshape(-1, 3),
        radii_m=np.array(radii, np.float32),
        basis_points=np.zeros(count, np.int16),
        place_regions=np.array(place_regions, np.int64),
        posteriors=np.array(np.zeros((count, 0)) if posteriors is None else posteriors, np.float16),
        unknown=np.zeros(count, np.float16),
        edges=np.zeros((0, 2), np.int64),
        clearances_m=np.zeros(0, np.float32),
        trajectory=np.zeros((0, 3), np.float32),
    )


def make_map(free, voxel_m=0.5):
    free = np.array(free, np.int16).reshape(-1, 3)
    return VoxelMap(robot="r", voxel_m=voxel_m, free=free, occupied=np.zeros((0, 3), np.int16))


def rectangle(x0, x1, y0=0.0, y1=4.0):
    return [[x0, y0], [x1, y0], [x1, y1], [x0, y1]]


def make_truth(*rooms, floors=(FLOOR,)):
    regions = [{"id": i, "label": label, "floor": 0, "polygon_m": polygon} for i, (label, polygon) in enumerate(rooms)]
    return GroundTruth.from_json({"floors": list(floors), "regions": regions})


def without_ece(scores):
    """The other scores, of scenes without posteriors."""
    assert math.isnan(scores["ece"]) and math.isnan(scores["risk_half"])
    return {key: value for key, value in scores.items() if key not in {"ece", "risk_half"}}


# Six places in a row, one voxel each; the left four in the kitchen, the right two in the hall.
ROW = make_map([[i, 0, 0] for i in range(6)], voxel_m=1.0)
ROW_TRUTH = make_truth(("kitchen", rectangle(0, 4)), ("hall", rectangle(4, 6)))


def row_scores(place_regions, names):
    return evaluate(
        make_scene([[i + 0.5, 0.5, 0.5] for i in range(6)], [0.4] * 6, place_regions, names), ROW, ROW_TRUTH
    )


def test_perfect_is_one_everywhere():
    scores = row_scores([7, 7, 7, 7, 3, 3], {7: "kitchen", 3: "hall"})
    assert list(scores) == [*KEYS, "ece", "risk_half"] == list(SCORES)
    assert set(without_ece(scores).values()) == {1.0}


# Each row by hand. Voxels: kitchen 4, hall 2.
BY_HAND = {
    "one region for all": (
        [0] * 6,
        {0: "kitchen"},
        # P = 4/6; R = (1 + 1)/2 shape, (1 + 0)/2 label; IoU 4/6, one pair of two true regions
        {"p_g": 4 / 6, "r_g": 1, "f1_g": 0.8, "p_s": 4 / 6, "r_s": 0.5, "miou_g": 4 / 6, "miou_g_penalised": 2 / 6}
        | {"miou_s": 4 / 6, "miou_s_penalised": 2 / 6, "accuracy": 4 / 6},
    ),
    "every place its own region": (
        [0, 1, 2, 3, 4, 5],
        {0: "kitchen", 1: "kitchen", 2: "kitchen", 3: "kitchen", 4: "hall", 5: "hall"},
        # P = 1; R = (1/4 + 1/2)/2; IoU 1/4 and 1/2 over 2 pairs, over 6 regions penalised
        {"p_g": 1, "r_g": 0.375, "f1_g": 0.75 / 1.375, "p_s": 1, "r_s": 0.375, "miou_g": 0.375, "miou_s": 0.375}
        | {"miou_g_penalised": 0.125, "miou_s_penalised": 0.125, "accuracy": 1},
    ),
    "labels exchanged": (
        [0, 0, 0, 0, 1, 1],
        {0: "hall", 1: "kitchen"},
        {"p_g": 1, "r_g": 1, "f1_g": 1, "miou_g": 1, "miou_g_penalised": 1, "boundary_f1": 1}
        | {"p_s": 0, "r_s": 0, "f1_s": 0, "miou_s": 0, "miou_s_penalised": 0, "accuracy": 0},
    ),
    "boundary one place off": (
        [0, 0, 0, 1, 1, 1],
        {0: "kitchen", 1: "hall"},
        # P = (1 + 2/3)/2; R = (3/4 + 1)/2; IoU (3/4 + 2/3)/2; 5 of 6 voxels right
        {"p_g": 5 / 6, "r_g": 7 / 8, "f1_g": 2 * (5 / 6) * (7 / 8) / (5 / 6 + 7 / 8), "p_s": 5 / 6, "r_s": 7 / 8}
        | {"miou_g": 17 / 24, "miou_s": 17 / 24, "miou_s_penalised": 17 / 24, "accuracy": 5 / 6},
    ),
    "hall not labelled yet": (
        [0, 0, 0, 0, -1, -1],
        {0: "kitchen"},
        {"p_g": 1, "r_g": 0.5, "p_s": 1, "r_s": 0.5, "miou_g": 1, "miou_g_penalised": 0.5, "accuracy": 4 / 6},
    ),
    "a region id without an entry has no label": (
        [0, 0, 0, 0, 9, 9],
        {0: "kitchen"},
        {"p_g": 1, "r_g": 1, "p_s": 0.5, "r_s": 0.5, "miou_s": 0.5, "accuracy": 4 / 6},
    ),
    "one region where two are": ([0] * 6, {0: "kitchen"}, {"boundary_f1": 0}),
    "nothing labelled": ([-1] * 6, {}, dict.fromkeys(KEYS, 0.0)),
}


@pytest.mark.parametrize("case", BY_HAND)
def test_by_hand(case):
    place_regions, names, expected = BY_HAND[case]
    scores = row_scores(place_regions, names)
    assert {key: scores[key] for key in expected} == pytest.approx(expected)


def test_two_rooms_with_spheres_worked_by_hand():
    # A strip of free voxels of 0.5 m, centres x = 0.25, 0.75, ... 3.75, y = z = 0.25. Place 0 at x = 1, r = 0.9 holds
    # 0.25 ... 1.75 (4 voxels); place 1 at x = 2.5, r = 1.3 holds 1.25 ... 3.75 (6); both hold 1.25 and 1.75.
    # Power at 1.25: 0.0625 - 0.81 = -0.7475 against 1.5625 - 1.69 = -0.1275 -> place 0;
    # at 1.75: 0.5625 - 0.81 = -0.2475 against 0.5625 - 1.69 = -1.1275 -> place 1. So 3 and 5 voxels.
    # Room boundary at x = 2: place 0 lies in the bath, place 1 in the bedroom. Place 2 lies in no room: left out,
    # though it would otherwise own the voxels around x = 3.25.
    scene = make_scene(
        [[1.0, 0.25, 0.25], [2.5, 0.25, 0.25], [3.25, -0.1, 0.25]],
        [0.9, 1.3, 2.0],
        [4, 4, 5],
        {4: "bedroom", 5: "bath"},
    )
    free = make_map([[i, 0, 0] for i in range(8)])
    truth = make_truth(("bath", rectangle(0, 2)), ("bedroom", rectangle(2, 4)))
    scores = evaluate(scene, free, truth)
    # The boundary is true, but one region holds everything: nothing estimated.
    assert without_ece(scores) == pytest.approx(
        {"p_g": 5 / 8, "r_g": 1.0, "f1_g": 2 * (5 / 8) / (13 / 8), "p_s": 5 / 8, "r_s": 0.5, "f1_s": (5 / 8) / (9 / 8)}
        | {"miou_g": 5 / 8, "miou_s": 5 / 8, "miou_g_penalised": 5 / 16, "miou_s_penalised": 5 / 16, "accuracy": 5 / 8}
        | {"boundary_f1": 0.0}
    )


def test_a_place_counts_on_the_floor_that_holds_it():
    floors = [FLOOR, {"id": 1, "z_min_m": 3.0, "z_max_m": 6.0}]
    rooms = [{"id": i, "label": f"level {i}", "floor": i, "polygon_m": rectangle(0, 4)} for i in (0, 1)]
    truth = GroundTruth.from_json({"floors": floors, "regions": rooms})
    assert truth.region_of(np.array([[1, 1, 1], [1, 1, 3], [1, 1, 6], [9, 1, 1.0]])).tolist() == [0, 1, -1, -1]


def test_empty_worlds_score_zero():
    place = make_scene([[0.5, 0.5, 0.5]], [0.4], [0], {0: "kitchen"})
    nothing = make_scene([], [], [], {})
    zero = dict.fromkeys(KEYS, 0.0)
    assert without_ece(evaluate(nothing, ROW, ROW_TRUTH)) == zero
    assert without_ece(evaluate(place, make_map([]), ROW_TRUTH)) == zero
    assert without_ece(evaluate(place, ROW, make_truth())) == zero


def test_malformed_truth_is_refused():
    with pytest.raises(ValueError, match=r"regions\.json"):
        GroundTruth.from_json({"floors": [], "regions": [{"id": 0, "label": "a", "floor": 0, "polygon_m": []}]})


def slow_scores(scene, voxel_map, truth):
    """The definitions, word by word, over sets of voxels."""
    rooms = {region.id: region for region in truth.regions}
    places = []
    for position, radius, region in zip(scene.positions_m, scene.radii_m, scene.place_regions, strict=True):
        for room in sorted(rooms):
            corners = rooms[room].polygon_m
            (x0, y0), (x1, y1) = corners.min(axis=0), corners.max(axis=0)
            if (
                x0 <= position[0] < x1
                and y0 <= position[1] < y1
                and rooms[room].z_min_m <= position[2] < rooms[room].z_max_m
            ):
                places.append((position.astype(float), float(radius), int(region), room))
                break
    estimated, true, region_at = {}, {}, {}
    for voxel in voxel_map.free.tolist():
        center = (np.array(voxel) + 0.5) * voxel_map.voxel_m
        holders = [(((center - p[0]) ** 2).sum() - p[1] ** 2, i) for i, p in enumerate(places)]
        holders = [holder for holder in holders if holder[0] <= 0]
        if holders:
            _, _, region, room = places[min(holders)[1]]
            true.setdefault(room, set()).add(tuple(voxel))
            region_at[tuple(voxel)] = (region, room)
            if region != -1:
                estimated.setdefault(region, set()).add(tuple(voxel))
    names = {region.id: region.label for region in scene.regions}
    out = {}
    for axis in "sg":

        def shared(e, t, axis=axis):
            return len(estimated[e] & true[t]) * (axis == "g" or names.get(e) == rooms[t].label)

        p = [max((shared(e, t) / len(estimated[e]) for t in true), default=0.0) for e in estimated]
        r = [max((shared(e, t) / len(true[t]) for e in estimated), default=0.0) for t in true]
        few, many = min(len(estimated), len(true)), max(len(estimated), len(true))
        pairings = (
            [zip(estimated, chosen, strict=True) for chosen in itertools.permutations(true, few)]
            if few == len(estimated)
            else [zip(chosen, true, strict=True) for chosen in itertools.permutations(estimated, few)]
        )
        total = max(sum(shared(e, t) / len(estimated[e] | true[t]) for e, t in pairs) for pairs in pairings)
        out[f"p_{axis}"] = sum(p) / len(p) if p else 0.0
        out[f"r_{axis}"] = sum(r) / len(r) if r else 0.0
        both = out[f"p_{axis}"] + out[f"r_{axis}"]
        out[f"f1_{axis}"] = 2 * out[f"p_{axis}"] * out[f"r_{axis}"] / both if both else 0.0
        out[f"miou_{axis}"] = total / few if few else 0.0
        out[f"miou_{axis}_penalised"] = total / many if many else 0.0
    volume = sum(len(voxels) for voxels in true.values())
    right = sum(len(estimated[e] & true[t]) for e in estimated for t in true if names.get(e) == rooms[t].label)
    boundary = slow_boundary_f1(region_at, voxel_map.voxel_m) if estimated else 0.0
    return out | {"accuracy": right / volume if volume else 0.0, "boundary_f1": boundary}


def slow_boundary_f1(region_at, voxel_m):
    """`region_at` maps each scored voxel to its estimated and its true region."""
    estimated, true = [], []
    for voxel, (region, room) in region_at.items():
        for axis in range(3):
            other = tuple(index + (axis == i) for i, index in enumerate(voxel))
            if other in region_at:
                doubled = np.add(voxel, other)
                if room != region_at[other][1]:
                    true.append(doubled)
                if region != region_at[other][0] and -1 not in (region, region_at[other][0]):
                    estimated.append(doubled)
    if not (estimated or true):
        return 1.0

    def found(points, others):  # half voxels: exact at the tolerance
        reach_squared = round((2 * 0.5 / voxel_m) ** 2, 9)
        hits = [any(((point - other) ** 2).sum() <= reach_squared for other in others) for point in points]
        return sum(hits) / len(hits) if hits else 0.0

    precision, recall = found(estimated, true), found(true, estimated)
    return 2 * precision * recall / (precision + recall) if precision + recall else 0.0


def slow_calibration(scene, voxel_map, truth):
    """Bins of confidence filled voxel by voxel."""
    names, rooms = {r.id: r.label for r in scene.regions}, {r.id: r.label for r in truth.regions}
    scored = [row for row, room in enumerate(truth.region_of(scene.positions_m)) if room != -1]
    bins = [[] for _ in range(10)]
    for voxel in voxel_map.free.tolist():
        center = (np.array(voxel) + 0.5) * voxel_map.voxel_m
        powers = [
            ((center - scene.positions_m[row].astype(float)) ** 2).sum() - float(scene.radii_m[row]) ** 2
            for row in scored
        ]
        if not powers or min(powers) > 0:
            continue
        row = scored[int(np.argmin(powers))]
        label = names.get(int(scene.place_regions[row]))
        if label in scene.labels:
            confidence = float(scene.posteriors[row, scene.labels.index(label)])
            right = label == rooms[int(truth.region_of(scene.positions_m[[row]])[0])]
            bins[min(int(confidence * 10), 9)].append((confidence, right))
    total = sum(map(len, bins))
    gaps = [len(b) / total * abs(sum(c for c, _ in b) / len(b) - sum(r for _, r in b) / len(b)) for b in bins if b]
    return sum(gaps) if total else math.nan


@settings(max_examples=60)
@given(st.integers(0, 2**32 - 1))
def test_a_literal_implementation_agrees(seed):
    rng = np.random.default_rng(seed)
    free = np.argwhere(rng.random((9, 8, 4)) < 0.7) - [1, 0, 1]
    count = int(rng.integers(0, 14))
    positions = rng.uniform([-0.5, 0, 0], [4.5, 4, 1.5], (count, 3)).round(
        int(rng.integers(0, 3))
    )  # rounding makes ties
    radii = rng.uniform(0.1, 1.2, count).round(1)
    names = {i: str(rng.choice(["a", "b", "c"])) for i in range(4)}
    scene = make_scene(positions, radii, rng.integers(-1, 5, count), names)
    cut = float(rng.uniform(1, 3))
    truth = make_truth(("a", rectangle(0, cut)), ("b", rectangle(cut, 4)), ("c", rectangle(0, 3, 1.0, 9.0)))
    expected = slow_scores(scene, make_map(free), truth)
    assert without_ece(evaluate(scene, make_map(free), truth)) == pytest.approx(expected, abs=1e-12)


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1))
def test_a_literal_calibration_agrees(seed):
    rng = np.random.default_rng(seed)
    free = np.argwhere(rng.random((8, 8, 2)) < 0.8)
    count = int(rng.integers(0, 10))
    posteriors = rng.dirichlet([1, 1], count).round(int(rng.integers(1, 4)))
    names = {0: "a", 1: "b", 2: "not in the prior"}
    scene = make_scene(
        rng.uniform(0, 4, (count, 3)) * [1, 1, 0.2],
        rng.uniform(0.3, 1.5, count),
        rng.integers(-1, 4, count),
        names,
        labels=["a", "b"],
        posteriors=posteriors.reshape(count, 2),
    )
    truth = make_truth(("a", rectangle(0, 2)), ("b", rectangle(2, 3.5)))
    expected = slow_calibration(scene, make_map(free), truth)
    assert evaluate(scene, make_map(free), truth)["ece"] == pytest.approx(expected, abs=1e-12, nan_ok=True)


def test_calibration_worked_by_hand():
    # Kitchen voxels 0..3 believed 0.75, two of them called hall (wrong); hall voxels believed 0.95, both right.
    # Bin 0.7: 4 voxels, half right: gap 0.25; bin 0.9: 2 voxels, gap 0.05; (4 * 0.25 + 2 * 0.05) / 6.
    beliefs = [[0.75, 0.25]] * 2 + [[0.25, 0.75]] * 2 + [[0.0, 0.95]] * 2
    scene = make_scene(
        [[i + 0.5, 0.5, 0.5] for i in range(6)],
        [0.4] * 6,
        [0, 0, 1, 1, 1, 1],
        {0: "kitchen", 1: "hall"},
        labels=["kitchen", "hall"],
        posteriors=beliefs,
    )
    assert evaluate(scene, ROW, ROW_TRUTH)["ece"] == pytest.approx(1.1 / 6, abs=2e-4)  # float16 on the way
    table = reliability(beliefs_of(scene, assign(scene, ROW, ROW_TRUTH), ROW_TRUTH))
    assert table.volumes.tolist() == [0, 0, 0, 0, 0, 0, 0, 4, 0, 2]
    assert table.accuracy.tolist() == [0, 0, 0, 0, 0, 0, 0, 0.5, 0, 1]


def test_risk_is_that_of_the_firmest_part_and_equal_beliefs_count_alike():
    """10 voxels at 0.9, 2 of them wrong; 10 at 0.5 of two places, one wrong."""
    beliefs = Beliefs(np.array([8, 2, 6, 4]), np.array([0.9, 0.9, 0.5, 0.5]), np.array([True, False, True, False]))
    assert risk(beliefs, 0.5) == pytest.approx(0.2)
    assert risk(beliefs, 0.25) == pytest.approx(0.2)
    assert risk(beliefs, 0.75) == pytest.approx((2 + 2) / 15)
    assert risk(beliefs, 1.0) == pytest.approx(6 / 20)
    assert np.isnan(risk(Beliefs(np.zeros(0, int), np.zeros(0), np.zeros(0, bool)), 0.5))


def test_a_boundary_counts_up_to_half_a_metre_away():
    # Voxels of 0.1 m in a row, one place each; the true wall is at x = 2. An estimated wall 5 voxels away still counts.
    def score(cut):
        positions = [[(i + 0.5) / 10, 0.05, 0.05] for i in range(40)]
        regions = [int(i >= cut) for i in range(40)]
        free = make_map([[i, 0, 0] for i in range(40)], 0.1)
        scene = make_scene(positions, [0.04] * 40, regions, {0: "a", 1: "b"})
        return evaluate(scene, free, make_truth(("a", rectangle(0, 2)), ("b", rectangle(2, 4))))["boundary_f1"]

    assert [score(cut) for cut in (14, 15, 20, 25, 26)] == [0, 1, 1, 1, 0]


def test_a_superfluous_boundary_costs_precision():
    scores = row_scores([0, 1, 2, 2, 3, 3], {0: "kitchen", 1: "kitchen", 2: "kitchen", 3: "hall"})
    assert scores["boundary_f1"] == pytest.approx(2 * (1 / 3) / (4 / 3))  # one of three is true, and it is found


def test_equal_power_goes_to_the_smaller_index():
    owners = voxel_owners(
        np.array([[0, 0, 0], [1, 0, 0]]), 1.0, np.array([[0.0, 0.5, 0.5], [2, 0.5, 0.5]]), np.array([2.0, 2.0])
    )
    assert owners.tolist() == [0, 1]
    owners = voxel_owners(
        np.array([[0, 0, 0]]), 1.0, np.array([[-0.5, 0.5, 0.5], [1.5, 0.5, 0.5]]), np.array([1.0, 1.0])
    )
    assert owners.tolist() == [0]


@pytest.mark.skipif(not DATA.is_dir(), reason="needs the shared sequences")
@pytest.mark.parametrize("sequence", ["hololens_office", "aws_small_house", "infinigen_home_a"])
def test_real_ground_truth_scores_itself_perfectly(sequence):
    truth = GroundTruth.from_json(json.loads((DATA / sequence / "regions.json").read_text()))
    corners = np.concatenate([region.polygon_m for region in truth.regions])
    x, y = (np.arange(low, high, 0.5) for low, high in zip(corners.min(axis=0), corners.max(axis=0), strict=True))
    centers = np.array([(a, b, 1.0) for a in x for b in y])
    ids = truth.region_of(centers.astype(np.float32))
    free = np.unique(np.floor(centers / 0.25).astype(int), axis=0)
    scene = make_scene(centers, np.full(len(centers), 0.4), ids, {r.id: r.label for r in truth.regions})
    assert len(set(ids.tolist()) - {-1}) == len(truth.regions)
    assert set(without_ece(evaluate(scene, make_map(free, 0.25), truth)).values()) == {1.0}

"""`prior-sg eval` on a synthetic world of two rooms whose perception is handed in: no encoder, no files."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace as replace_struct
from rich.console import Console

from prior_sg.deploy.cli import main
from prior_sg.deploy.cli.report import compare
from prior_sg.deploy.evaluation import datasets, methods, oracles, priors, runner, tables
from prior_sg.deploy.evaluation.errors import EvaluationError
from prior_sg.deploy.evaluation.kinds import BASELINES, ORACLES, SWEEPS
from prior_sg.deploy.evaluation.metrics import Reliability
from prior_sg.deploy.evaluation.object_metrics import OBJECT_SCORES
from prior_sg.deploy.evaluation.page import page, reliability_points, risk_points, true_scene
from prior_sg.deploy.evaluation.perception import CODE, Cache, Perception, code_digest, source_digest
from prior_sg.deploy.evaluation.plots import line_plot
from prior_sg.deploy.running.job import Counts, Result
from prior_sg.deploy.truth import GroundTruth, TrueObject, read_objects
from prior_sg.schemas.codec import encode
from prior_sg.schemas.places import VoxelMap
from prior_sg.schemas.priors import ObjectPrior
from prior_sg.schemas.topics import PLACE_DELTA
from prior_sg.services.segmenter.core.config import Config
from prior_sg.services.segmenter.core.experts import REGISTRY
from tests.help.paths import SAMPLE
from tests.help.world import DIM, ROBOT, ROOM_M, SPACE, place_delta, place_grid, prior, text, walk
from tests.services.segmenter.test_objects import BED, OVEN, sight
from tests.services.segmenter.test_objects import walk as around

NAMES = ["kitchen", "hall"]
SIDE_VOXELS = 20  # voxels of 0.2 m


def two_rooms() -> GroundTruth:
    corners = [[[x, 0], [x + ROOM_M, 0], [x + ROOM_M, ROOM_M], [x, ROOM_M]] for x in (0, ROOM_M)]
    return GroundTruth.from_json(
        {
            "floors": [{"id": 0, "z_min_m": 0.0, "z_max_m": 3.0}],
            "regions": [{"id": i, "label": NAMES[i], "floor": 0, "polygon_m": corners[i]} for i in (0, 1)],
        }
    )


def perceived(concepts=np.eye(2)) -> Perception:
    positions, edges = place_grid(2)
    free = np.argwhere(np.ones((2 * SIDE_VOXELS, SIDE_VOXELS, 10), bool)).astype(np.int16)
    known = {f"a {name}": row for name, row in zip(NAMES, concepts, strict=True)} | dict(
        zip(NAMES, concepts, strict=True)
    )
    mixture = np.mean(concepts, axis=0)  # what is no room looks like all of them
    return Perception(
        name="two rooms",
        places=place_delta(positions, edges, snapshot=True),
        voxels=VoxelMap(robot=ROBOT, voxel_m=0.2, free=free, occupied=np.zeros((0, 3), np.int16)),
        pyramids=tuple(walk(2)),
        space=SPACE,
        text=lambda asked: text(np.array([known.get(phrases[0], mixture) for phrases in asked])),
    )


@pytest.fixture
def case() -> methods.Case:
    return methods.Case(perceived(), prior(NAMES), two_rooms())


def score(method, case):
    outcome, _ = runner.judge(method, case)
    return outcome.scores


def blind(case: methods.Case) -> methods.Case:
    """Pictures that show nothing: every crop looks the same."""
    same = np.full(DIM, DIM**-0.5)
    pyramids = [
        oracles.with_crops(p, np.ones(len(p.layers), bool), np.tile(same, (len(p.layers), 1)))
        for p in case.perception.pyramids
    ]
    return replace(case, perception=replace(case.perception, pyramids=tuple(pyramids)))


def test_ours_finds_two_rooms(case):
    scores = score(methods.ours(Config()), case)
    assert scores["f1_s"] > 0.9
    assert scores["accuracy"] > 0.9
    assert scores["ece"] < 0.5
    assert list(scores) == list(runner.KEYS)


@pytest.mark.parametrize("kind", ["features", "places"])
def test_oracles_see_what_pictures_do_not_show(case, kind):
    unseeing = blind(case)
    assert score(methods.ours(Config()), unseeing)["accuracy"] < 0.7
    assert score(methods.oracle(Config(), kind), unseeing)["accuracy"] > 0.9


def test_the_object_oracle_counts_the_boxes_that_were_seen(case, tmp_path):
    boxes = [
        {"label": "oven", "min_m": [1.0, 1.0, 0.5], "max_m": [1.2, 1.2, 0.7]},
        {"label": "bed", "min_m": [5.0, 1.0, 0.5], "max_m": [7.0, 3.0, 0.7]},
        {"label": "bed", "min_m": [6.0, 1.0, 2.5], "max_m": [7.0, 3.0, 2.7]},  # nothing was seen there
        {"label": "lamp", "min_m": [5.0, 1.0, 0.5], "max_m": [7.0, 3.0, 0.7]},  # not in the prior
    ]
    assert read_objects(tmp_path) == ()
    (tmp_path / "objects.json").write_text(json.dumps({"objects": boxes}))
    objects = read_objects(tmp_path)
    occupied = np.array([[5, 5, 3], [30, 10, 3]], np.int16)
    voxels = replace_struct(case.perception.voxels, occupied=occupied)
    found = oracles.seen_objects(objects, case.prior, voxels)
    np.testing.assert_allclose(found.positions_m, [[1.1, 1.1, 0.6], [6.0, 2.0, 0.6]])
    assert found.concepts.tolist() == [[1.0, 0.0], [0.0, 1.0]]
    told = replace_struct(case.prior, containment=np.array([[0.9, 0.05], [0.05, 0.9]], np.float32))
    unseeing = blind(replace(case, prior=told, objects=objects))
    unseeing = replace(unseeing, perception=replace(unseeing.perception, voxels=voxels))
    assert score(methods.ours(Config()), unseeing)["accuracy"] < 0.7
    assert score(methods.oracle(Config(region_cost=0.0), "objects"), unseeing)["accuracy"] > 0.9


def with_detections(case, detector="segments"):
    """A bed and an oven, seen eight times; the ground truth has the bed, and another that was never seen."""
    boxes = [TrueObject("bed", *BED[:2]), TrueObject("bed", BED[0] + 9, BED[1] + 9)]
    seen = tuple(
        sight(frame, pose, [BED, OVEN] if detector != "none" else [], detector=detector)
        for frame, pose in enumerate(around())
    )
    voxels = replace_struct(case.perception.voxels, occupied=np.array([[12, 8, 1]], np.int16))
    perception = replace(case.perception, detections=seen, voxels=voxels)
    return replace(case, perception=perception, objects=tuple(boxes))


def test_objects_are_judged_where_the_truth_names_them(case):
    scores = score(methods.ours(Config()), with_detections(case))
    assert scores["objects_found"] == 2
    assert scores["objects_true"] == 1
    assert scores["objects_precision"] == 0.5
    assert scores["objects_recall"] == 1.0
    blind_to_objects = with_detections(case, "none")
    for method, other in (
        (methods.ours(Config()), case),
        (methods.ours(Config()), blind_to_objects),
        (replace(methods.ours(Config()), name="another"), with_detections(case)),
    ):
        assert not {key for key in score(method, other) if key.startswith("objects")}


def test_scores_of_objects_stand_beside_the_others(case, capsys):
    full, method = with_detections(case), methods.ours(Config())
    sequences = [
        runner.Dataset("a", Path("a"), full.truth, full.prior, full.objects),
        runner.Dataset("b", Path("b"), full.truth, full.prior),
    ]
    found = runner.run(
        sequences, [method], lambda dataset, features, sought: replace(full.perception, name=dataset.name), quiet
    )
    table = found.table()
    assert list(table["sequences"]["a"]["ours"]) == [*runner.KEYS, *OBJECT_SCORES]
    assert list(table["sequences"]["b"]["ours"]) == list(runner.KEYS)
    assert table["mean"]["ours"]["objects_recall"] == 1.0
    seen = found.pictures[0].scene
    assert seen.objects and not true_scene(seen, full.truth).objects
    tables.print_tables(found, Console())
    assert "recall 100.0" in " ".join(capsys.readouterr().out.split())
    assert "a: ours</td><td>0.500</td><td>1.000</td>" in page(found, {})


def test_a_run_tells_how_well_it_found_objects(case, capsys):
    full = with_detections(case)
    items = methods.ours(Config()).run(full).objects
    scene = replace_struct(methods.ours(Config()).run(case), objects=items)
    counts = Counts(detectors={"segments"})
    result = Result(scene, full.perception.voxels, Path("log.mcap"), counts, 1.0, full.prior, [])
    found = compare(result, None, full.objects, Console(width=200))
    assert found["objects_precision"] == 0.5
    assert found["objects_named_precision"] is None  # nothing carries a name, and JSON knows no NaN
    assert "2 found, 1 true of the prior's and seen, precision 0.500, recall 1.000, " in capsys.readouterr().out
    counts.detectors = {"none"}
    assert compare(result, None, full.objects, Console()) == {}


def test_scores_of_names_that_the_task_does_not_use_are_said_to_say_little(case, capsys):
    result = Result(
        methods.ours(Config()).run(case), case.perception.voxels, Path("log.mcap"), Counts(), 1.0, case.prior, []
    )
    room = {"id": 0, "floor": 0, "polygon_m": [[0, 0], [4, 0], [4, 4]]}

    def said(labels):
        rooms = [room | {"id": number, "label": label} for number, label in enumerate(labels)]
        floors = [{"id": 0, "z_min_m": 0.0, "z_max_m": 3.0}]
        compare(result, {"floors": floors, "regions": rooms}, [], Console(width=200))
        return capsys.readouterr().out

    assert "this task has no atrium, which the ground truth has" in said((NAMES[0], "atrium"))
    assert "no region name of this task is in the ground truth" in said(("nave", "atrium"))
    assert "names" not in said((NAMES[0], NAMES[1]))


def quiet(what, done, total):
    """Say nothing."""


def test_a_crop_of_the_feature_oracle_carries_the_room_it_shows(case):
    concepts = {name: np.eye(DIM)[row] for row, name in enumerate(NAMES)}
    for pyramid in case.perception.pyramids[:6]:  # in the first room
        true = oracles.true_features(pyramid, case.truth, concepts, noise=0.0)
        _, points_m = oracles.viewed_points(pyramid)
        ahead_m = points_m[:, 0].mean()
        assert set(np.unique(true.embeddings)) <= {0.0, 1.0}
        if ahead_m < 2.0:  # looks away from the door
            assert (true.embeddings.argmax(axis=1) == 0).all()
    none = oracles.true_features(case.perception.pyramids[0], case.truth, {})
    assert none.embeddings.shape == (0, DIM)


def test_viewed_points_lie_on_the_walls(case):
    for pyramid in case.perception.pyramids:
        _, points_m = oracles.viewed_points(pyramid)
        on_x = np.abs(points_m[:, :1] - [0, ROOM_M, 2 * ROOM_M]).min(axis=1)
        on_y = np.abs(points_m[:, 1:2] - [0, ROOM_M]).min(axis=1)
        assert np.minimum(on_x, on_y).max() < 1e-3


def test_the_prior_oracle_counts(case):
    found = priors.counted(case.prior, case.truth, case.perception.places)
    # The rooms hold 16 and 17 places (the doorway's lies at x = 4, which is the second room); one pair, which touches.
    expected = np.array([16.1, 17.1]) / 33.2
    assert [region.existence for region in found.regions] == pytest.approx(expected.tolist())
    assert found.adjacency[0, 1] == pytest.approx(1.1 / 1.2)
    apart = place_delta(*map(np.asarray, (place_grid(2)[0], np.zeros((0, 2)))), snapshot=True)
    assert priors.counted(case.prior, case.truth, apart).adjacency[0, 1] == pytest.approx(0.1 / 1.2)


def test_variations_are_seeded_valid_and_differ():
    oven = ObjectPrior(name="oven", phrases=["an oven"], size_m=(0.6, 0.6, 0.9), bottom_m=0.0)
    first = prior(NAMES, objects=[oven, ObjectPrior(name="bed", phrases=["a bed"])])
    found = priors.variations(first, 4, 0.5)
    again = priors.variations(first, 4, 0.5)
    assert found[0] is first
    assert [encode(p) for p in found] == [encode(p) for p in again]
    assert len({encode(p) for p in found}) == 4
    for one in found[1:]:
        one.check()
        assert [region.name for region in one.regions] == NAMES
        assert one.objects == first.objects
        assert one.regions[0].phrases[0] == first.regions[0].phrases[0]
        assert set(one.regions[0].phrases) <= set(first.regions[0].phrases)


def test_without_noise_only_words_and_objects_vary():
    first = prior(NAMES, adjacency=np.array([[1.0, 0.3], [0.3, 1.0]], np.float32))
    same = priors.perturbed(first, 1, 0.0)
    assert np.allclose(same.adjacency, first.adjacency, atol=2e-3)
    assert [r.existence for r in same.regions] == pytest.approx([0.5, 0.5])


def test_a_prior_without_structure_is_uniform():
    first = prior(NAMES, adjacency=np.array([[1.0, 0.9], [0.9, 1.0]], np.float32))
    flat = priors.without_structure(first)
    assert flat.adjacency.tolist() == [[1.0, 0.5], [0.5, 1.0]]
    assert np.ptp(flat.containment) == 0
    assert [region.phrases for region in flat.regions] == [region.phrases for region in first.regions]


def test_expert_rows_follow_the_registry(case):
    rows = methods.expert_rows(Config())
    names = [row.name for row in rows]
    assert names[:2] == ["V", "V+E"]
    assert len(set(names)) == len(names)
    mentioned = {expert for row in rows for expert in row.about.removeprefix("experts: ").split(", ")}
    assert mentioned == set(REGISTRY)


def test_every_ablation_and_radius_runs(case):
    rows = [*methods.ablations(Config()), *methods.sweep(Config(), "radius")]
    assert {"no pairwise term", "no occlusion test", "global feature", "radius 0.75"} <= {row.name for row in rows}
    for row in rows:
        assert 0 <= score(row, case)["f1_g"] <= 1


def test_sweeps_ask_for_other_features():
    assert [m.features for m in methods.sweep(Config(), "crop")] == [{"smallest_crop_px": n} for n in (112, 224, 448)]
    assert all(m.features["space"].startswith("conse/") for m in methods.sweep(Config(), "encoder"))


@pytest.mark.parametrize("name", BASELINES)
def test_baselines_run(case, name):
    scores = score(methods.baseline(name), case)
    assert 0 <= scores["f1_s"] <= 1
    assert math.isnan(scores["ece"])


def test_an_unknown_baseline_names_the_known_ones():
    with pytest.raises(EvaluationError, match="ours, clio, hovsg, hydra, argmax"):
        methods.baseline("magic")


def test_every_kind_that_the_command_line_lists_is_a_method():
    assert [methods.oracle(Config(), kind).name for kind in ORACLES] == [f"oracle {kind}" for kind in ORACLES]
    assert [len(methods.sweep(Config(), kind)) for kind in SWEEPS] == [len(values) for values in SWEEPS.values()]


@pytest.fixture
def results(case) -> runner.Results:
    chosen = [methods.ours(Config()), methods.baseline("argmax"), *methods.ablations(Config())[:2]]
    chosen += [methods.oracle(Config(), "prior"), *methods.sweep(Config(), "radius")]
    dataset = runner.Dataset("two rooms", Path("two rooms"), case.truth, case.prior)
    return runner.run([dataset], chosen, lambda dataset, features, sought: case.perception, lambda *_: None, priors=3)


def test_results_sum_up_over_priors(results):
    table = json.loads(json.dumps(results.table()))
    assert set(table) == {"sequences", "mean", "sd"}
    assert list(table["mean"]["ours"]) == list(runner.KEYS)
    assert table["mean"]["argmax"]["ece"] is None
    assert table["sequences"]["two rooms"] == table["mean"]
    values = [o.scores["f1_s"] for o in results.outcomes if o.method.name == "ours"]
    assert len(values) == 3
    assert table["mean"]["ours"]["f1_s"] == pytest.approx(sum(values) / 3)
    assert table["sd"]["ours"]["f1_s"] == pytest.approx(np.std(values))


def test_confusions_hold_the_scored_volume(results):
    volumes = {sum(picture.confusion.values()) for picture in results.pictures}
    assert len(volumes) == 1
    ours = results.pictures[0]
    right = sum(volume for (true, estimate), volume in ours.confusion.items() if true == estimate)
    assert right / sum(ours.confusion.values()) == pytest.approx(results.outcomes[0].scores["accuracy"])


def test_the_page_needs_nothing_else(results):
    html = page(results, {"task": "tidy <up>"})
    assert "tidy &lt;up&gt;" in html
    assert "<script" not in html
    assert not [link for link in ('src="http', "href=", "url(") if link in html]
    for heading in ("Methods", "Ablations", "Oracles", "Sweep of radius", "Calibration", "Confusions", "Seconds"):
        assert f"<h2>{heading}</h2>" in html
    assert html.count("data:image/png;base64,") == 4  # truth, ours, argmax, oracle prior
    assert html.count("<svg") == 5


def test_tables_name_every_method(results):
    console = Console(record=True, width=60)
    tables.print_tables(results, console)
    shown = console.export_text()
    assert all(method.name in shown for method in results.methods)
    assert "…" not in shown


def test_true_scene_is_perfect(case):
    pipeline = methods.labelling(Config(), ROBOT, lambda concepts: None)
    pipeline.publish(PLACE_DELTA, case.perception.places)
    scene = methods.scene_of(pipeline, ROBOT)
    labelled = methods.Method("truth", lambda _: true_scene(scene, case.truth))
    assert score(labelled, case)["f1_s"] == 1.0


def test_reliability_points_weigh_by_volume():
    one = Reliability(np.array([0, 10]), np.array([0, 0.8]), np.array([0, 1.0]))
    two = Reliability(np.array([0, 30]), np.array([0, 0.6]), np.array([0, 0.5]))
    assert reliability_points([one, two]) == [pytest.approx((0.65, 0.625))]


def test_risk_points_take_the_firmest_first():
    one = Reliability(np.array([30, 10]), np.array([0.2, 0.8]), np.array([0.5, 0.9]))
    assert risk_points([one]) == [pytest.approx((0.25, 0.1)), pytest.approx((1.0, 0.4))]


def test_plots_place_points_by_value():
    plot = line_plot({"a": [(0, 0.0), (1, 1.0)]}, "x", "y")
    assert 'points="46.0,238.0 418.0,14.0"' in plot


def test_the_cache_returns_what_was_put(tmp_path):
    cache = Cache(tmp_path / "cache")
    assert cache.get("places", {"a": 1}) is None
    cache.put("places", {"a": 1}, [b"one", b""])
    assert cache.get("places", {"a": 1}) == [b"one", b""]
    assert cache.get("places", {"a": 2}) is None


def test_a_changed_source_has_another_digest(tmp_path):
    (tmp_path / "trajectory.csv").write_text("one")
    before = source_digest(tmp_path)
    assert source_digest(tmp_path) == before
    (tmp_path / "trajectory.csv").write_text("other")
    assert source_digest(tmp_path) != before


def test_a_digest_of_code_covers_the_files_that_make_a_perception():
    digests = {name: code_digest(name, files) for name, files in CODE.items()}
    assert len(set(digests.values())) == len(CODE)  # an empty choice of files would digest to the same everywhere
    assert code_digest("ingest", "nothing.py") not in digests.values()


def test_environments_go_by_name_or_to_all():
    (home,) = datasets.chosen_datasets([SAMPLE], ["office floor", "home=residential home"], "tidy up")
    assert home.prior.environment == "residential home"
    assert home.prior.vocabulary == [region.label for region in home.truth.regions]
    with pytest.raises(EvaluationError, match="home=residential home"):
        datasets.chosen_datasets([SAMPLE], ["other=office floor"], "tidy up")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--methods", "magic"], "there is no method 'magic'"),
        (["--oracle", "magic"], "--oracle knows"),
        (["--sweep", "magic"], "--sweep knows"),
        (["--priors", "0"], "--priors must be at least 1"),
        (["--set", "segmenter.magic=1"], "segmenter has no setting"),
    ],
)
def test_faults_are_one_sentence(options, message, capsys, tmp_path):
    arguments = ["eval", str(SAMPLE), "--environment", "residential home", "--out", str(tmp_path), *options]
    assert main.main(arguments) == 1
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1

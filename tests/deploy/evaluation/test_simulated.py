"""Simulated encoders: what they make of a crop, and `prior-sg eval` with them on sequences and worlds."""

import itertools
import json
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace as replace_struct

from prior_sg.deploy.cli import main
from prior_sg.deploy.evaluation import simulated
from prior_sg.deploy.evaluation.datasets import WorldName, chosen_datasets, named_worlds, of_sequence, world_source
from prior_sg.deploy.evaluation.errors import EvaluationError
from prior_sg.deploy.evaluation.perception import Cache, Perceiver, simulated_perception
from prior_sg.deploy.evaluation.simulated import SimulatedEncoder, look_of
from prior_sg.deploy.evaluation.simulated import simulated as encoder_of
from prior_sg.deploy.truth import GroundTruth, TrueObject
from prior_sg.schemas.features import Pyramid
from prior_sg.schemas.frames import Intrinsics
from tests.help.long import long_run
from tests.help.paths import SAMPLE

CAMERA = Intrinsics(width_px=640, height_px=480, fx_px=400.0, fy_px=400.0, cx_px=319.5, cy_px=239.5)
LABELS = ["kitchen", "hall", "office"]
WALL_M = 4.0  # x of the wall that the camera looks at
CELLS = np.array([(x, y, z) for x in range(20) for y in range(20) for z in range(5)])


def truth(border_m: float = 100.0, wall_m: float = 100.0) -> GroundTruth:
    """A kitchen up to y = border_m, beside it a hall, and behind x = wall_m an office."""
    boxes = [(-9, wall_m, -99, border_m), (-9, wall_m, border_m, 199), (wall_m, 199, -99, 199)]
    regions = [
        {"id": i, "label": LABELS[i], "floor": 0, "polygon_m": [[x, y], [right, y], [right, up], [x, up]]}
        for i, (x, right, y, up) in enumerate(boxes)
    ]
    return GroundTruth.from_json({"floors": [{"id": 0, "z_min_m": -9.0, "z_max_m": 9.0}], "regions": regions})


def layout(depth_m: float = WALL_M, y_m: float = 0.0, frame_id: int = 0, cells: int = 1) -> Pyramid:
    """A camera at x = 0 that looks along x at a wall, its image cut into `cells` x `cells` crops."""
    looking = np.array([[0, 0, 1, 0], [-1, 0, 0, y_m], [0, -1, 0, 1.5], [0, 0, 0, 1]], float)
    side = np.array([CAMERA.width_px, CAMERA.height_px]) / cells
    corners = np.array([(column, row) for row in range(cells) for column in range(cells)])
    return Pyramid(
        robot="r",
        frame_id=frame_id,
        stamp_ns=frame_id,
        space="none",
        worker="w",
        intrinsics=CAMERA,
        world_from_camera=looking,
        centers_px=((corners + 0.5) * side - 0.5).astype(np.float32),
        sigmas_px=np.full(cells**2, side.max() / 2, np.float32),
        layers=np.zeros(cells**2, np.uint8),
        depths_m=np.full(cells**2, depth_m, np.float32),
        embeddings=np.zeros((cells**2, 0), np.float16),
        surface_m=np.full((60, 80), depth_m, np.float32),
        crops_total=cells**2,
    )


@pytest.fixture
def noiseless(monkeypatch):
    monkeypatch.setattr(simulated, "NOISE", 0.0)
    for name in ("FRAME_NOISE", "CROP_NOISE", "TINT"):
        monkeypatch.setattr(simulated, name, 0.0)


@pytest.mark.parametrize("choice", ["sim:0", "simlike:0"])
def test_a_crop_of_one_region_looks_like_its_name(choice, noiseless):
    seen = encoder_of(choice).encode(layout(cells=2), truth())
    assert seen.space == choice.replace(":", "/")
    np.testing.assert_allclose(seen.embeddings, np.tile(look_of("kitchen"), (4, 1)), atol=1e-3)


def test_a_wall_shows_the_room_that_it_faces(noiseless):
    for wall_m, name in ((WALL_M, "kitchen"), (WALL_M - 0.05, "kitchen"), (WALL_M - 0.5, "office")):
        seen = encoder_of("sim:0").encode(layout(), truth(wall_m=wall_m))
        np.testing.assert_allclose(seen.embeddings[0], look_of(name), atol=1e-3)


def test_a_crop_of_two_regions_is_their_mean_by_area(noiseless):
    (seen,) = encoder_of("sim:0").encode(layout(), truth(border_m=0.0)).embeddings.astype(float)
    both = look_of("kitchen") + look_of("hall")
    np.testing.assert_allclose(seen, both / np.linalg.norm(both), atol=2e-2)


def test_noise_has_the_length_that_it_should():
    seen = encoder_of("sim:0").encode(layout(cells=20), truth())
    cosines = seen.embeddings.astype(float) @ look_of("kitchen")
    assert cosines.mean() == pytest.approx(1 / np.sqrt(1 + simulated.NOISE**2), abs=0.01)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.7, 1.0])
def test_a_share_of_the_surface_wears_another_label(share):
    true = np.arange(len(CELLS)) % 3
    worn = SimulatedEncoder("sim", share).worn(CELLS, true, 3)
    assert (worn != true).mean() == pytest.approx(share, abs=0.03)
    if share:
        wrong = worn[worn != true]
        np.testing.assert_allclose(np.bincount(wrong, minlength=3) / len(wrong), 1 / 3, atol=0.05)


def test_surface_wears_the_same_from_everywhere(noiseless):
    """Crops of less than a metre, of a wall in one region, from two places."""
    encoder = encoder_of("sim:0.5")
    worn = [encoder.worn(np.array([[3, y, 1]]), np.array([0]), 3)[0] for y in range(6)]
    assert len(set(worn)) > 1
    for y, label in enumerate(worn):
        for beside_m in (0.0, 0.2):
            view = layout(WALL_M, y + 0.5 + beside_m)
            small = replace_struct(view, sigmas_px=np.array([20.0], np.float32))
            seen = encoder.encode(small, truth()).embeddings[0].astype(float)
            assert seen @ look_of(LABELS[label]) > 0.99


def test_what_an_encoder_says_is_settled_by_its_seed():
    kinds = ["sim:0.5", "simlike:0.5"]
    for choice in kinds:
        first, again, other = (encoder_of(choice, seed).encode(layout(cells=3), truth()) for seed in (0, 0, 1))
        np.testing.assert_array_equal(first.embeddings, again.embeddings)
        assert not np.array_equal(first.embeddings, other.embeddings)
    in_any_process = [-0.0946045, 0.1082202]
    assert look_of("kitchen")[:2].tolist() == pytest.approx(in_any_process, abs=1e-6)


def test_crops_without_measured_surface_are_left_out():
    half = layout(cells=2)
    half.surface_m[:40] = 0.0  # crops are square and overlap
    assert len(encoder_of("sim:0").encode(half, truth()).layers) == 2
    half.surface_m[:] = 0.0
    assert len(encoder_of("sim:0").encode(half, truth()).layers) == 0


def test_surface_in_no_region_says_nothing():
    text = encoder_of("sim:0").text([[name] for name in LABELS])
    outside = GroundTruth(())
    seen = [encoder_of("sim:0").encode(layout(y_m=float(y), frame_id=y), outside).embeddings[0] for y in range(40)]
    z = (np.array(seen, float) @ text.embeddings.T - text.background_mean) / text.background_std
    assert z.std(axis=1).mean() < 2.0
    assert z.max() < (look_of("hall") @ look_of("hall") - text.background_mean[1]) / text.background_std[1]


def test_text_goes_by_the_name_that_the_first_phrase_says():
    text = encoder_of("sim:0.3").text([["a kitchen", "a stove"], ["hall"], ["an office", "desks"]])
    assert text.space == "sim/0.3"
    np.testing.assert_allclose(text.embeddings, [look_of(name) for name in LABELS], atol=1e-6)
    cosines = text.embeddings @ text.embeddings.T
    assert cosines[~np.eye(3, dtype=bool)].mean() == pytest.approx(simulated.COMMON, abs=0.15)
    np.testing.assert_allclose(text.background_mean, simulated.COMMON, atol=0.05)


@pytest.mark.parametrize("share", [0.0, 0.2, 0.5, 0.8, 1.0])
def test_a_share_of_whole_regions_looks_more_like_another_label(share):
    encoder = SimulatedEncoder("simlike", share)
    looks = [encoder.region_look(number, "kitchen", LABELS) for number in range(600)]
    wrong = [(look @ np.array([look_of(name) for name in LABELS]).T).argmax() != 0 for look in looks]
    assert np.mean(wrong) == pytest.approx(share, abs=0.06)


def test_frames_share_noise_and_small_crops_have_more(monkeypatch):
    monkeypatch.setattr(simulated, "TINT", 0.0)
    encoder, small = encoder_of("simlike:0"), layout(cells=8)
    frames = [encoder.encode(replace_struct(small, frame_id=frame), truth()).embeddings for frame in range(20)]
    off = np.array(frames, float) - np.mean(frames, axis=(0, 1), dtype=float)
    apart = off - off.mean(axis=1, keepdims=True)
    assert np.linalg.norm(off.mean(axis=1), axis=1).mean() > 2 * np.linalg.norm(apart, axis=2).mean() / 8
    monkeypatch.setattr(simulated, "FRAME_NOISE", 0.0)
    large, small = (encoder.encode(layout(cells=cells), truth()).embeddings for cells in (1, 8))
    assert (small.astype(float) @ look_of("kitchen")).mean() < large[0].astype(float) @ look_of("kitchen")


def test_an_encoder_favours_labels_everywhere(monkeypatch):
    encoder = encoder_of("simlike:0")
    tint = encoder.tint(LABELS)
    favoured = int(np.argmax([tint @ look_of(name) for name in LABELS]))
    layouts = [layout(cells=4, frame_id=frame) for frame in range(30)]
    text = encoder.text([[name] for name in LABELS])

    def standing() -> float:
        """Of the favoured label above the others, mean over crops."""
        seen = np.concatenate([encoder.encode(one, truth()).embeddings for one in layouts]).astype(float)
        z = (seen @ text.embeddings.T - text.background_mean) / text.background_std
        return float((z[:, favoured] - z.mean(axis=1)).mean())

    tinted = standing()
    monkeypatch.setattr(simulated, "TINT", 0.0)
    assert tinted > standing() + 0.1


def test_objects_look_like_themselves(noiseless):
    wall = TrueObject("poster", np.array([3.8, -9.0, -9.0]), np.array([4.1, 9.0, 9.0]))
    (seen,) = encoder_of("simlike:0").encode(layout(), truth(), [wall]).embeddings.astype(float)
    assert seen @ look_of("poster") == pytest.approx(seen @ look_of("kitchen"), abs=0.01)
    assert seen @ look_of("poster") > 0.7


def test_names_of_worlds():
    assert named_worlds("world:home:3") == [WorldName("home", 3)]
    assert [world.seed for world in named_worlds("world:office:0-2,7")] == [0, 1, 2, 7]


def test_a_world_is_read_as_a_recording_is():
    frames = list(world_source(WorldName("home", 0)))
    assert len(frames) > 20
    assert [frame.index for frame in frames[:3]] == [0, 1, 2]
    assert all(one.stamp_ns < other.stamp_ns for one, other in itertools.pairwise(frames))


def test_worlds_out_of_doors_are_mapped_as_such(tmp_path):
    (campus,) = chosen_datasets([Path("world:campus:0")], [], "tidy up")
    (home,) = chosen_datasets([Path("world:home:0")], [], "tidy up")
    told = {"place_graph": {"preset": "indoor"}}
    presets = [
        Perceiver(layers, Cache(tmp_path), lambda *_: None).mapping(dataset).preset
        for layers, dataset in (({}, campus), ({}, home), (told, campus))
    ]
    assert presets == ["outdoor", "indoor", "indoor"]


@long_run
def test_sequences_under_a_simulated_encoder(tmp_path):
    sample = of_sequence(SAMPLE, "residential home", "tidy up")
    seen = simulated_perception(sample, "sim:0.3", folder=tmp_path)
    again = simulated_perception(sample, "sim:0.3", seed=0, folder=tmp_path)
    assert seen.space == "sim/0.3" == seen.pyramids[0].space
    assert seen.seconds["places"] > 0 == again.seconds["places"]
    for one, other in zip(seen.pyramids, again.pyramids, strict=True):
        np.testing.assert_array_equal(one.embeddings, other.embeddings)
    other = simulated_perception(sample, "sim:0.3", seed=1, folder=tmp_path)
    assert any(
        not np.array_equal(a.embeddings, b.embeddings) for a, b in zip(seen.pyramids, other.pyramids, strict=True)
    )
    with pytest.raises(ValueError, match="no simulated encoder"):
        simulated_perception(sample, "conse", folder=tmp_path)


@long_run
def test_eval_compares_methods_on_worlds_side_by_side(tmp_path, capsys):
    arguments = ["eval", "world:home:0-1", "--methods", "ours,argmax", "--encoder", "sim:0.3", "--out", str(tmp_path)]
    arguments += ["--set", "place_graph.voxel_m=0.2"]  # coarse, for time
    assert main.main([*arguments, "--jobs", "2"]) == 0
    shown = capsys.readouterr().out
    assert "home, 2 datasets: percent, mean±standard error" in shown
    found = json.loads((tmp_path / "eval.json").read_text())
    assert list(found["sequences"]) == ["world:home:0", "world:home:1"]
    assert found["mean"]["ours"]["accuracy"] > 0.6
    scores = [found["sequences"][name]["ours"]["f1_s"] for name in found["sequences"]]
    mean, error = found["kinds"]["home"]["ours"]["f1_s"]
    assert mean == pytest.approx(np.mean(scores))
    assert error == pytest.approx(np.std(scores, ddof=1) / np.sqrt(2))
    assert main.main([*arguments, "--jobs", "1"]) == 0
    alone = json.loads((tmp_path / "eval.json").read_text())
    for rows in (found, alone):
        for row in [*rows["sequences"].values(), rows["mean"]]:
            assert all(row[method].pop("seconds") > 0 for method in row)
    assert alone["sequences"] == found["sequences"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["world:home:0"], "worlds have no colours for a real encoder"),
        (["world:home:0", "--encoder", "conse"], "worlds have no colours for a real encoder"),
        (["world:moon:0", "--encoder", "sim:0"], "there is no kind of world 'moon'"),
        (["world:home:x", "--encoder", "sim:0"], "names no seeds"),
        (["world:home", "--encoder", "sim:0"], "names no seeds"),
        (["world:home:0", "--encoder", "sim:2"], "from 0 to 1"),
        (["world:home:0", "--encoder", "sim"], "from 0 to 1"),
        (["world:home:0", "--encoder", "magic"], "--encoder is conse, sim:P or simlike:P"),
        (["world:home:0", "--encoder", "sim:0", "--sweep", "encoder"], "--sweep encoder compares real encoders"),
        (["world:home:0", "world:home:0", "--encoder", "sim:0"], "two datasets are called world:home:0"),
        (["world:home:0", "--encoder", "sim:0", "--jobs", "-1"], "--jobs must be at least 1"),
        ([str(SAMPLE), "--encoder", "sim:0"], "say what kind of place home is"),
    ],
)
def test_what_cannot_be_is_refused_in_one_sentence(arguments, message, capsys, tmp_path):
    assert main.main(["eval", *arguments, "--out", str(tmp_path)]) == 1
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_seeds_are_whole_numbers():
    with pytest.raises(EvaluationError, match="world:home:0-9"):
        named_worlds("world:home:3-1")

"""Labels judged before their places are near: the arithmetic on walks made by hand, and a walk through two rooms."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from msgspec.structs import replace as replace_struct
from rich.console import Console

from prior_sg.deploy.cli import main
from prior_sg.deploy.evaluation import ahead_command, ahead_walks, command
from prior_sg.deploy.evaluation.ahead import NEARNESS, NO_LABEL, Stop, band_names, joined, score
from prior_sg.deploy.evaluation.ahead_page import HEADINGS, cells, page
from prior_sg.deploy.evaluation.methods import Case
from prior_sg.services.segmenter.core.config import Config
from tests.deploy.evaluation.test_evaluation import NAMES, perceived, two_rooms
from tests.help.world import place_delta, place_grid, prior

PLACE = 7  # id of the only place of most walks


def stop(second, distances_m, close, ids=(PLACE,), true=(1,)):
    """A moment at which the camera has come `second` metres along."""
    return Stop(
        float(second), float(second), np.array(ids), np.array(true), np.array(distances_m, float), np.array(close, bool)
    )


def given(*labels):
    return [np.array([label]) for label in labels]


def test_bands_begin_at_their_lower_bound():
    ids = list(range(7))
    moment = stop(0, [0, 1.99, 2, 6, 8.99, 14, 40], [False] * 7, ids, [1] * 7)
    assert score([moment], [np.ones(7, int)]).counts.tolist() == [2, 1, 0, 2, 0, 2]
    assert band_names() == ["0–2", "2–4", "4–6", "6–9", "9–14", ">14"]


def test_a_place_counts_once_in_a_band_with_its_first_label_there():
    walk = [stop(0, [16], [False]), stop(1, [15], [False]), stop(2, [8], [False]), stop(3, [7], [False])]
    found = score(walk, given(0, 1, 1, 0))
    assert found.counts.tolist() == [0, 0, 0, 1, 0, 1]
    assert found.right.tolist() == [0, 0, 0, 1, 0, 0]
    assert np.isnan(found.accuracy[0]) and found.accuracy[3] == 1 and found.accuracy[5] == 0


def test_nothing_counts_after_the_first_close_look_even_when_trust_falls_again():
    walk = [stop(0, [8], [False]), stop(1, [3], [True]), stop(2, [1], [False])]
    assert score(walk, given(1, 1, 1)).counts.tolist() == [0, 0, 0, 1, 0, 0]
    seen_at_once = score(walk[1:], given(1, 1))
    assert seen_at_once.counts.sum() == 0 and seen_at_once.places == 0
    assert len(seen_at_once.leads_s) == 0


def test_places_without_a_label_or_outside_of_regions_do_not_count():
    outside = [stop(0, [8], [False], true=[NO_LABEL])]
    assert score(outside, given(1)).counts.sum() == 0
    walk = [stop(0, [10], [False]), stop(1, [8], [False])]
    found = score(walk, given(NO_LABEL, 1))
    assert found.counts.tolist() == [0, 0, 0, 1, 0, 0] and found.places == 1


def test_the_lead_is_from_the_first_right_label_to_the_first_close_look():
    walk = [stop(0, [16], [False]), stop(2, [10], [False]), stop(5, [6], [False]), stop(9, [1], [True])]
    found = score(walk, given(0, 1, 0, 1))
    assert found.leads_s.tolist() == [7] and found.leads_m.tolist() == [7]
    assert (found.places, found.settled) == (1, 0)
    assert score(walk, given(0, 0, 0, 1)).leads_s.tolist() == []
    assert score(walk, given(1, 0, 0, 1)).settled == 1


def test_walks_are_joined_by_their_places():
    far, near = [stop(0, [16], [False])], [stop(0, [8], [False]), stop(3, [2], [True])]
    both = joined([score(far, given(0)), score(near, given(1, 1))])
    assert both.counts.tolist() == [0, 0, 0, 1, 0, 1] and both.right.tolist() == [0, 0, 0, 1, 0, 0]
    assert (both.places, both.settled, both.leads_s.tolist()) == (2, 2, [3])
    assert both.table()["bands"]["6–9"] == {"places": 1, "accuracy": 1.0}
    assert both.table()["bands"]["0–2"]["accuracy"] is None


def test_labels_must_fit_the_places():
    with pytest.raises(ValueError, match="2 labels for 1 places"):
        score([stop(0, [1], [False])], [np.array([1, 1])])


def test_rows_and_page_show_what_was_found():
    found = score([stop(0, [8], [False]), stop(3, [2], [True])], given(1, 1))
    assert cells(found) == ["–", "–", "–", "100 (1)", "–", "–", "100", "3.0", "3.0"]
    assert len(cells(found)) == len(HEADINGS)
    text = page({"a < b": {"seen": {"ours": found}}})
    assert "a &lt; b" in text and "100 (1)" in text and "<svg" in text


def walked():
    """Two rooms whose place graph is whole from the start; only then the camera goes through them."""
    perception = perceived()
    positions, edges = place_grid(2)
    nothing = place_delta(positions[:0], edges[:0])
    deltas = []
    for number, pyramid in enumerate(perception.pyramids):
        camera_m = camera_of(pyramid)
        start = place_delta(positions, edges) if number == 0 else nothing
        stamp_ns = (number + 1) * 10**9
        changes = {"revision": number, "frame_id": pyramid.frame_id, "stamp_ns": stamp_ns, "camera_m": camera_m}
        deltas.append(replace_struct(start, **changes))
    return Case(perception, prior(NAMES), two_rooms()), deltas


def camera_of(pyramid):
    return tuple(np.asarray(pyramid.world_from_camera, float)[:3, 3].tolist())


def test_a_walk_judges_every_variant_on_the_same_places():
    case, deltas = walked()
    found = ahead_walks.judged(case, deltas, Config())
    assert list(found) == list(NEARNESS)
    assert all(list(rows) == ["ours", "global feature", "no pyramid"] for rows in found.values())
    assert found["visited"]["ours"].counts[1:].sum() > 0
    walk = ahead_walks.snapshots(ahead_walks.variants(Config())["ours"], case, deltas)
    assert len(walk) == -(-len(deltas) // ahead_walks.TICK_KEYFRAMES)
    moments = ahead_walks.stops(walk, deltas, case.truth, Config().predicted_trust)
    last = moments[-1]
    cameras_m = np.array([delta.camera_m for delta in deltas])
    gaps_m = np.linalg.norm(walk[-1].positions_m[:, None] - cameras_m, axis=2).min(axis=1)
    assert np.allclose(last.distances_m, gaps_m)
    assert (moments[0].distances_m >= last.distances_m - 1e-9).all()
    assert last.travelled_m == pytest.approx(np.linalg.norm(np.diff(cameras_m, axis=0), axis=1).sum())


def test_the_command_prints_and_writes_what_a_walk_gives(tmp_path, monkeypatch):
    case, deltas = walked()
    perceiver = SimpleNamespace(perceive=lambda *_: case.perception, deltas=lambda _: deltas)
    monkeypatch.setattr(ahead_command, "perceiver_of", lambda *_: perceiver)
    dataset = SimpleNamespace(name="two rooms", prior=case.prior, truth=case.truth, objects=())
    monkeypatch.setattr("prior_sg.deploy.evaluation.datasets.chosen_datasets", lambda *_: [dataset])
    monkeypatch.setattr(command, "check_encoder", lambda *_: None)
    out = tmp_path / "out"
    assert main.main(["eval", "two", "--ahead", "--html", "--out", str(out)]) == 0
    tables = json.loads((out / "ahead.json").read_text())
    assert list(tables["two rooms"]["visited"]) == ["ours", "global feature", "no pyramid"]
    assert "two rooms" in (out / "ahead.html").read_text()


@pytest.mark.parametrize("extra", [["--ablate"], ["--methods", "clio"], ["--priors", "2"], ["--jobs", "2"]])
def test_what_ahead_would_ignore_is_refused(extra, capsys):
    assert main.main(["eval", "world:home:0", "--encoder", "sim:0.3", "--ahead", *extra]) != 0
    assert "--ahead" in capsys.readouterr().err


def test_the_table_names_the_dataset():
    found = score([stop(0, [8], [False])], given(1))
    console = Console(record=True, width=120)
    ahead_command.print_ahead({"somewhere": {key: {"ours": found} for key in NEARNESS}}, console)
    assert "somewhere" in console.export_text()

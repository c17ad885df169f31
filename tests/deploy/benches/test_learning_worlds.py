"""`prior-sg bench learning --worlds`: what a robot sees of generated worlds, and the figures."""

import numpy as np
import pytest

from prior_sg.deploy.benches import learning_worlds
from prior_sg.deploy.benches.homes import Sight
from prior_sg.deploy.cli import main
from prior_sg.services.segmenter.core.experts.context import ObjectView
from tests.help.long import long_run


def test_gains_by_hand():
    """Gains 0.2 and 0.4: mean 0.3, standard deviation 0.1 sqrt(2), of two."""
    found = learning_worlds.figures({0: [0.5, 0.4], 1: [0.1, 0.1], 3: [0.7, 0.8]})
    assert found == pytest.approx(
        {"f1_s_0": 0.45, "f1_s_1": 0.1, "f1_s_3": 0.75, "f1_s_gain": 0.3}
        | {"f1_s_gain_se": 0.1, "f1_s_gain_least": 0.2}
    )


def test_half_of_the_regions_are_exchanged():
    assert [2 * learning_worlds.exchanged_pairs(["room"] * count) for count in (4, 8, 9, 12)] == [2, 4, 4, 6]


def test_a_detector_misses_some_and_mistakes_some():
    view = ObjectView(np.arange(2000), np.arange(6000.0).reshape(-1, 3), np.eye(10)[np.arange(2000) % 10])
    seen = learning_worlds.mistaken(view, Sight(0.0, detected=0.8, mistaken=0.2), np.random.default_rng(0))
    np.testing.assert_allclose(seen.concepts.sum(axis=1), 1)
    taken_for = seen.concepts.argmax(axis=1)
    truth = view.concepts[(seen.positions_m[:, 0] / 3).astype(int)].argmax(axis=1)
    assert len(seen.ids) == pytest.approx(1600, abs=60)
    assert (taken_for == truth).mean() == pytest.approx(0.82, abs=0.03)  # one in ten mistakes hits the truth


@pytest.mark.parametrize("option", [("--worlds", "home"), ("--on", "world:home:1"), ("--seeds", "2")])
def test_what_a_measurement_would_ignore_is_refused(option, capsys):
    assert main.main(["bench", "bus", *option]) != 0
    assert f"{option[0]} is of the measurements" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("asked", "sentence"),
    [
        (("learning", "--seeds", "0-20"), "say of which kind, such as --worlds home"),
        (("learning", "--worlds", "home", "--seeds", "0-10"), "11 seeds are too few"),
        (("foresight", "--seeds", "some"), "--seeds some names no seeds"),
        (("levels", "--on", "world:home:3"), "home has no levels above regions"),
    ],
)
def test_seeds_that_cannot_be_measured_on_are_refused(asked, sentence, capsys):
    assert main.main(["bench", *asked]) != 0
    assert sentence in " ".join(capsys.readouterr().err.split())


def test_the_first_ten_seeds_are_explored():
    assert learning_worlds.parted(range(40, 53)) == (range(40, 50), range(50, 53))


def test_an_unknown_kind_of_world_is_refused(capsys):
    assert main.main(["bench", "learning", "--worlds", "igloo"]) != 0
    assert "igloo" in capsys.readouterr().err


@long_run
def test_learning_in_homes_tells_its_figures_and_where_it_is(tmp_path):
    lines = []
    seeds = (range(3), range(7, 9))
    metrics, settings = learning_worlds.learning_worlds_bench("home", lines.append, seeds, folder=tmp_path)
    assert metrics["f1_s_gain"] == pytest.approx(metrics["f1_s_3"] - metrics["f1_s_0"]) and 0 < metrics["f1_s_0"] < 1
    assert {"f1_s_0", "f1_s_1", "f1_s_3", "f1_s_3_right"} <= set(metrics)
    assert (settings["explored"], settings["tested"]) == ([0, 1, 2], [7, 8])
    assert "world:home:7: seen by simlike:0.4" in lines and lines[-1].startswith("home_right: F1_S ")

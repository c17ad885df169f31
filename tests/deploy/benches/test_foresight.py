"""What `prior-sg bench foresight` tells of maps and searches, of worlds made by hand."""

import numpy as np
import pytest

from prior_sg.deploy.benches import foresight as bench
from prior_sg.deploy.benches.main import table
from prior_sg.deploy.evaluation.datasets import WorldName
from prior_sg.deploy.evaluation.foresight.trials import SAME, Moment
from prior_sg.services.segmenter.core.foresight.beyond import Views
from prior_sg.services.segmenter.core.foresight.config import ForesightConfig
from prior_sg.services.segmenter.core.foresight.expectation import Found
from tests.help.foreseen import around
from tests.help.world import prior


def moment(outcomes):
    count = len(outcomes)
    views = Views(np.tile(np.eye(3)[0], (count, 1)), np.full(count, 0.9), np.ones(count), around(count))
    met = np.array([[one == label for label in range(3)] for one in outcomes]).reshape(-1, 3)
    return Moment(views, Found(np.array([1.0, 0, 0]), np.zeros((3, 3))), np.array(outcomes), met, np.ones(3, bool))


@pytest.fixture
def maps(monkeypatch):
    """Openings of a home and of an office; a shop has none."""
    seen = {"home": [moment([SAME, 1])], "office": [moment([SAME] * 3)], "shop": [moment([])]}
    monkeypatch.setattr(bench, "mapped", lambda kind, seed, perceiver: (seen[kind], prior(["hall", "bath", "den"])))


def test_a_walk_on_which_no_opening_reveals_anything_is_left_out():
    """It cannot be judged, and would end a bench of many worlds."""
    home = prior(["hall", "bath", "den"])
    walks = [("home", [moment([]), moment([SAME])], home), ("shop", [moment([])], home), ("office", [], home)]
    assert [kind for kind, _, _ in bench.revealing(walks)] == ["home"]
    with pytest.raises(ValueError, match="no opening reveals anything"):
        bench.predicted(walks, ForesightConfig())
    assert bench.predicted(bench.revealing(walks), ForesightConfig())["ours"]["events"] == 1


def test_maps_are_judged_together_and_by_kind(maps, tmp_path):
    worlds, said = [WorldName(kind, 80) for kind in ("home", "office", "shop")], []
    found = bench.mapped_figures(worlds, ForesightConfig(), said.append, tmp_path)
    assert found["ours"]["events"] == 5 and found["within_true"] == pytest.approx(1 / 15)
    assert set(found["by_kind"]) == {"home", "office"}
    assert found["by_kind"]["home"]["within_true"] == pytest.approx(1 / 6)
    assert "nll_another" in found["ours"] and "nll_another" not in found["by_kind"]["office"]["ours"]
    assert found["by_kind"]["office"]["existence"]["nll"] == pytest.approx(np.log(2))
    assert said == ["map 1 of 3: home 80", "map 2 of 3: office 80", "map 3 of 3: shop 80"]
    assert bench.mapped_figures(worlds[2:], ForesightConfig(), said.append, tmp_path) == {}


def test_figures_stand_under_all_their_names():
    nested = {"metrics": {"ours": {"nll": 1.0}, "within_ece": 0.1}, "settings": {}}
    assert table(nested) == (("metric", "value"), [["ours.nll", "1"], ["within_ece", "0.1"]])

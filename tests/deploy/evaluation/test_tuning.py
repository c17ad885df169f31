"""Settings chosen on some datasets and judged on those left out: by hand, and on two small worlds."""

import json
import math

import pytest

from prior_sg.deploy.cli import main
from prior_sg.deploy.evaluation import methods
from prior_sg.deploy.evaluation.errors import EvaluationError
from prior_sg.deploy.evaluation.tune_command import combinations, score_of, verdict
from prior_sg.deploy.evaluation.tuning import grouped, mean_and_error, tuned
from tests.help.long import long_run

ONE = {"a": 0.9, "b": 0.2, "c": 0.3}
TWO = {"a": 0.1, "b": 0.5, "c": 0.4}
DEFAULT = {"a": 0.3, "b": 0.3, "c": 0.3}


def test_the_choice_is_made_without_what_it_is_judged_on():
    found = tuned({"one": ONE, "two": TWO}, DEFAULT)
    # Without a: one 0.25, two 0.45. Without b: 0.6, 0.25. Without c: 0.55, 0.3.
    assert [choice.candidate for choice in found.choices] == ["two", "one", "one"]
    assert [choice.score for choice in found.choices] == [0.1, 0.2, 0.3]
    assert found.left_out == pytest.approx((0.2, 0.1 / math.sqrt(3)))
    assert (found.hindsight, found.hindsight_mean) == ("one", pytest.approx(1.4 / 3))
    assert found.default == pytest.approx((0.3, 0.0))
    assert found.gain == pytest.approx((-0.1, 0.1 / math.sqrt(3)))  # differences -0.2, -0.1, 0
    assert found.chosen == {"one": 2, "two": 1}
    assert not found.helps
    assert verdict("ours", found) == "ours: choosing does not help by more than its error (-10.0±5.8)"


def test_a_gain_helps_when_it_is_more_than_its_error():
    base = {"a": 0.1, "b": 0.1}
    assert tuned({"one": {"a": 0.2, "b": 0.4}}, base).helps  # differences 0.1, 0.3: 0.2 with error 0.1
    assert not tuned({"one": {"a": 0.0, "b": 0.4}}, base).helps  # differences -0.1, 0.3: 0.1 with error 0.2


def test_a_standard_error_is_of_a_sample():
    assert mean_and_error([1.0, 2.0, 6.0]) == pytest.approx((3.0, math.sqrt(7) / math.sqrt(3)))


def test_of_equal_candidates_the_first_is_chosen():
    # Sums in another order, with rounding, must tie too.
    scores, same = {"a": 0.1, "b": 0.2, "c": 0.3, "d": 0.0}, {"a": 0.3, "b": 0.2, "c": 0.1, "d": 0.0}
    for pair in ({"one": scores, "two": same}, {"two": same, "one": scores}):
        found = tuned(pair, scores)
        assert found.hindsight == next(iter(pair))
        assert found.choices[3].candidate == next(iter(pair))


def test_one_dataset_or_no_candidate_is_refused():
    with pytest.raises(EvaluationError, match="a alone leaves nothing to choose on"):
        tuned({"one": {"a": 1.0}}, {"a": 1.0})
    with pytest.raises(EvaluationError, match="nothing to choose from"):
        tuned({}, DEFAULT)


def test_a_group_counts_as_the_mean_of_its_datasets():
    assert grouped(ONE, {"a": "x", "b": "y", "c": "y"}) == {"x": 0.9, "y": 0.25}


def test_combinations_are_all_or_one_at_a_time():
    values = {"s.a": ["0", "1"], "s.b": ["2"]}
    assert combinations(values, False) == [(("s.a", "0"), ("s.b", "2")), (("s.a", "1"), ("s.b", "2"))]
    assert combinations(values, True) == [(("s.a", "0"),), (("s.a", "1"),), (("s.b", "2"),)]
    assert combinations({}, False) == combinations({}, True) == [()]


def test_a_score_is_the_mean_of_those_named_and_must_exist():
    assert score_of({"f1_s": 0.2, "f1_g": 0.6}, ["f1_s", "f1_g"], "a") == pytest.approx(0.4)
    with pytest.raises(EvaluationError, match="a has no f1_s"):
        score_of({"f1_s": math.nan}, ["f1_s"], "a")


@pytest.mark.parametrize(
    ("changes", "message"), [({"magic": "1"}, "clio has no setting 'magic'"), ({"top_k": "many"}, "clio: ")]
)
def test_settings_of_baselines_are_checked(changes, message):
    with pytest.raises(EvaluationError, match=message):
        methods.baseline("clio", 0, changes)


@long_run
def test_tune_judges_ours_and_a_baseline_on_worlds(tmp_path, capsys):
    arguments = ["tune", "world:home:0-1", "--encoder", "sim:0.3", "--methods", "ours,argmax", "--out", str(tmp_path)]
    arguments += ["--set", "place_graph.voxel_m=0.2"]  # coarse, for time
    values = ["--values", "segmenter.beta=0,1", "--values", "argmax.standardised=true,false"]
    assert main.main([*arguments, *values, "--jobs", "1"]) == 0
    shown = capsys.readouterr().out
    assert "left out" in shown
    assert "its error" in shown
    found = json.loads((tmp_path / "tune.json").read_text())
    assert list(found) == ["ours", "argmax"]
    for row in found.values():
        assert [choice["left_out"] for choice in row["choices"]] == ["world:home:0", "world:home:1"]
        assert sum(row["chosen"].values()) == 2
        assert row["hindsight"]["mean"] >= row["left_out"][0] - 1e-9
    assert set(found["ours"]["chosen"]) <= {"segmenter.beta=0", "segmenter.beta=1"}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--values", "segmenter.magic=1"], "segmenter has no setting"),
        (["--values", "clio.max_delta=1"], "no method of --methods has a setting 'clio.max_delta'"),
        (["--values", "segmenter.beta="], "names no values"),
        ([], "there is nothing to choose from"),
        (["--values", "segmenter.beta=0", "--score", "ece"], "--score is of f1_s"),
        (["--values", "segmenter.beta=0", "--leave", "kind"], "at least two kinds"),
        (["--values", "segmenter.beta=0", "--methods", "magic"], "has a setting 'segmenter.beta'"),
        (["--values", "segmenter.beta=0", "--jobs", "-1"], "--jobs must be at least 1"),
    ],
)
def test_what_cannot_be_is_refused_in_one_sentence(options, message, capsys, tmp_path):
    worlds = ["world:home:0-1", "--encoder", "sim:0"]
    assert main.main(["tune", *worlds, "--out", str(tmp_path), *options]) == 1
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_one_dataset_is_refused(capsys, tmp_path):
    arguments = ["tune", "world:home:0", "--encoder", "sim:0", "--values", "segmenter.beta=0,1"]
    assert main.main([*arguments, "--out", str(tmp_path)]) == 1
    assert "at least two datasets" in capsys.readouterr().err

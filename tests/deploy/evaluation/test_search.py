"""The judge of text search, on a scene that is drawn here."""

import msgspec
import numpy as np
import pytest

from prior_sg.deploy.benches.queries import synthetic_scene
from prior_sg.deploy.evaluation.search import Found, Judge, calibration_error, figures
from prior_sg.deploy.evaluation.search_questions import QUESTIONS, TextQuestion
from prior_sg.deploy.truth import GroundTruth, TrueObject, TrueRegion
from prior_sg.schemas.answers import Thing

SCENE = synthetic_scene(900, 0)  # four rooms of 7.5 m


@pytest.fixture(scope="module")
def judge():
    west = TrueRegion(0, "kitchen", np.array([[-1, -1], [7.2, -1], [7.2, 20], [-1, 20]]), 0.0, 3.0)
    east = TrueRegion(1, "hall", np.array([[7.2, -1], [20, -1], [20, 20], [7.2, 20]]), 0.0, 3.0)
    stove = TrueObject("stove", np.array([1.0, 1.0, 0.0]), np.array([2.0, 2.0, 1.0]))
    return Judge(SCENE, GroundTruth((west, east)), (stove,))


def thing(what, number, x, y):
    return Thing(what=what, id=number, label="", position_m=(x, y, 1.0), probability=0.0)


@pytest.mark.parametrize(
    ("one", "in_kitchen", "by_stove"),
    [
        (thing("region", 1, 0, 0), True, True),
        (thing("region", 2, 0, 0), False, False),
        (thing("region", 3, 0, 0), True, False),
        (thing("place", 1, 3.4, 1.5), True, True),
        (thing("place", 1, 3.6, 1.5), True, False),
        (thing("place", 1, 9.0, 1.5), False, False),
        (thing("object", 1, 2.4, 1.5), True, True),
        (thing("object", 1, 2.6, 1.5), True, False),
    ],
)
def test_what_counts_as_right(judge, one, in_kitchen, by_stove):
    assert judge.right(one, TextQuestion(1, "t", ("kitchen",))) == in_kitchen
    assert judge.right(one, TextQuestion(1, "t", ("attic",), ("stove",))) == by_stove


def test_figures_worked_by_hand():
    with_answer = TextQuestion(1, "t", ("kitchen",))
    results = [
        Found(with_answer, (0.9, 0.4), (True, False)),
        Found(with_answer, (0.8, 0.2, 0.1), (False, False, True)),
        Found(with_answer, (0.6,), (False,)),
        Found(TextQuestion(2, "t"), (0.3,), (False,)),
    ]
    found = figures(results)
    assert (found["questions"], found["hit_1"], found["hit_5"]) == (3, pytest.approx(1 / 3), pytest.approx(2 / 3))
    assert found["mrr"] == pytest.approx((1 + 1 / 3) / 3)
    assert (found["best_where_right"], found["best_without_answer"]) == (0.9, 0.3)
    assert found["best_where_wrong"] == pytest.approx(0.7)


def test_calibration_error_worked_by_hand():
    assert calibration_error(np.array([0.25, 0.25, 0.75, 1.0]), np.array([0, 1, 1, 1])) == pytest.approx(
        (0.5 + 0.25) / 4
    )


def test_forty_questions_half_of_them_left_out():
    asked = [one for questions in QUESTIONS.values() for one in questions]
    known = [one for one in asked if one.regions or one.objects]
    assert len({one.number for one in asked}) == len(asked) == 46
    assert (len(known), sum(one.left_out for one in known)) == (40, 20)
    assert msgspec.json.encode(asked)

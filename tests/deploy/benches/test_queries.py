"""The bench of questions runs, and names each kind."""

from typing import get_args

import numpy as np

from prior_sg.deploy.benches.queries import kinds_of_questions, query_bench, synthetic_scene
from prior_sg.schemas.queries import ChangedSince, Question


def test_every_kind_of_question_is_measured():
    scene = synthetic_scene(400, 60)
    asked = {type(next(questions)) for questions in kinds_of_questions(scene, np.random.default_rng(0), 1).values()}
    assert asked | {ChangedSince} == set(get_args(Question))


def test_figures_by_kind_and_size():
    metrics, settings = query_bench((400,), 60, 2)
    assert all(value >= 0 for value in metrics.values())
    assert {"route_far_ms_p50_400", "answers_to_ms_p99_400", "changed_since_ms_p50_400"} <= set(metrics)
    assert settings["places"] == [400]

"""`prior-sg eval --search`: from sequences with questions to tables."""

import argparse
from collections.abc import Mapping, Sequence

from rich.box import SIMPLE

from prior_sg.deploy.evaluation.datasets import Dataset
from prior_sg.deploy.evaluation.errors import EvaluationError
from prior_sg.deploy.evaluation.methods import Case, ours
from prior_sg.deploy.evaluation.search import Found, Judge, figures, judged
from prior_sg.deploy.evaluation.search_questions import QUESTIONS
from prior_sg.deploy.evaluation.shared import TABLE_COLUMNS, perceiver_of, progress
from prior_sg.deploy.json_text import json_text
from prior_sg.deploy.settings import Layers
from prior_sg.deploy.terminal import Table, Terminal
from prior_sg.services.registry import BY_NAME
from prior_sg.services.runtime.config import resolve

SHOWN = {  # figures with their column titles
    "questions": "questions",
    "hit_1": "hit@1",
    "hit_5": "hit@5",
    "mrr": "MRR",
    "best_where_right": "score, right",
    "best_where_wrong": "score, wrong",
    "best_without_answer": "score, no answer",
    "ece": "ECE",
}
HALVES = {"left out": True, "chosen on": False}


def judge_search(arguments: argparse.Namespace, layers: Layers, datasets: Sequence[Dataset], console: Terminal) -> int:
    """Judge answers to texts over the sequences that have questions; print, and write search.json. Raises
    EvaluationError."""
    if missing := [dataset.name for dataset in datasets if dataset.name not in QUESTIONS]:
        known = ", ".join(QUESTIONS)
        raise EvaluationError(f"there are no questions about {', '.join(missing)}; there are about {known}")
    method = ours(resolve(BY_NAME["segmenter"].config, "segmenter", layers))
    found: dict[str, list[Found]] = {}
    with progress(Terminal(stderr=True)) as report:
        perceiver = perceiver_of(arguments, layers, report)
        for dataset in datasets:
            sought = tuple(item.name for item in dataset.prior.objects)
            perception = perceiver.perceive(dataset, None, sought)
            scene = method.run(Case(perception, dataset.prior, dataset.truth, dataset.objects))
            judge = Judge(scene, dataset.truth, dataset.objects)
            for name, results in judged(scene, dataset.prior, judge, QUESTIONS[dataset.name]).items():
                found.setdefault(name, []).extend(results)
    tables = {half: _figures(found, left_out) for half, left_out in HALVES.items()}
    (arguments.out / "search.json").write_text(json_text(tables))
    if arguments.json:
        print(json_text(tables, None))
    else:
        print_search(tables, console)
    return 0


def _figures(found: Mapping[str, Sequence[Found]], left_out: bool) -> dict[str, dict[str, float]]:
    """By method, over one half of the questions."""
    return {
        name: figures([one for one in results if one.question.left_out == left_out]) for name, results in found.items()
    }


def print_search(tables: Mapping[str, Mapping[str, Mapping[str, float]]], console: Terminal) -> None:
    """A table of the questions left out, and one of those that constants were chosen on."""
    console.width = max(console.width, TABLE_COLUMNS)
    for half, rows in tables.items():
        table = Table("method", *SHOWN.values(), title=f"questions {half}", box=SIMPLE, padding=(0, 1, 0, 0))
        for name, row in rows.items():
            table.add_row(name, *(f"{row[key]:.0f}" if key == "questions" else f"{row[key]:.2f}" for key in SHOWN))
        console.print(table)

"""`prior-sg tune`: settings chosen on some datasets, judged on those left out."""

import argparse
import itertools
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.box import SIMPLE

from prior_sg.deploy.cli.shared import add_settings
from prior_sg.deploy.evaluation import shared
from prior_sg.deploy.evaluation.kinds import BASELINES, OURS
from prior_sg.deploy.json_text import json_text
from prior_sg.deploy.settings import Layers
from prior_sg.deploy.terminal import Table, Terminal

if TYPE_CHECKING:
    from prior_sg.deploy.evaluation.datasets import Dataset
    from prior_sg.deploy.evaluation.methods import Method
    from prior_sg.deploy.evaluation.tuning import Tuned

SECTION = "segmenter"  # whose settings are those of our method
DEFAULT_SCORES = "f1_s,miou_s_penalised"
LOWER_IS_BETTER = ("ece", "risk_half", "seconds")
DATASET, KIND = "dataset", "kind"

Values = Mapping[str, Sequence[str]]  # by setting
Combination = tuple[tuple[str, str], ...]  # settings with their values; empty = as configured
Judged = dict[str, dict[str, float]]  # scores by name of the method with its combination


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What `prior-sg tune` can be told."""
    shared.add_datasets(parser)
    parser.add_argument(
        "--values",
        action="append",
        default=[],
        metavar="SETTING=VALUE,…",
        help="values to choose from, such as segmenter.region_cost=0,10 or, for a baseline, clio.max_delta=0.01,0.02; "
        "may be repeated",
    )
    parser.add_argument("--one-at-a-time", action="store_true", help="change one setting at a time, not all together")
    parser.add_argument(
        "--leave", choices=(DATASET, KIND), default=DATASET, help="what is left out at once (default: %(default)s)"
    )
    parser.add_argument("--methods", default=OURS, help=f"of {', '.join((OURS, *BASELINES))} (default: %(default)s)")
    parser.add_argument("--score", default=DEFAULT_SCORES, help="their mean is to be high (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=Path("out/eval"), help="folder for tune.json and the cache")
    parser.add_argument("--json", action="store_true", help="print JSON instead of tables")
    add_settings(parser)


def run(arguments: argparse.Namespace, console: Terminal) -> int:
    """Judge all combinations, choose, print, and write tune.json to the output folder. Raises EvaluationError."""
    from prior_sg.deploy.evaluation.datasets import chosen_datasets

    check_scores(shared.names_in(arguments.score))
    candidates_of(arguments, shared.chosen_layers(arguments))  # refuses what cannot be before anything takes time
    datasets = chosen_datasets(arguments.datasets, arguments.environment, arguments.task)
    shared.check_encoder(arguments.encoder, datasets)
    groups = groups_of(datasets, arguments.leave)
    arguments.out.mkdir(parents=True, exist_ok=True)
    found = choose(arguments, judged(arguments, datasets), groups)
    table = {name: as_table(one) for name, one in found.items()}
    (arguments.out / "tune.json").write_text(json_text(table))
    if arguments.json:
        print(json_text(table, None))
    else:
        print_tables(found, console, arguments.leave)
    return 0


def check_scores(names: Sequence[str]) -> None:
    """Raise EvaluationError for a score that does not exist or whose mean is not to be high."""
    from prior_sg.deploy.evaluation.errors import EvaluationError
    from prior_sg.deploy.evaluation.runner import KEYS

    known = [key for key in KEYS if key not in LOWER_IS_BETTER]
    wrong = [name for name in names if name not in known]
    if wrong or not names:
        raise EvaluationError(f"--score is of {', '.join(known)}, not {', '.join(wrong) or 'nothing'}")


def groups_of(datasets: "Sequence[Dataset]", leave: str) -> dict[str, str]:
    """What each dataset is left out with. Raises EvaluationError where that leaves nothing to choose on."""
    from prior_sg.deploy.evaluation.errors import EvaluationError

    groups = {dataset.name: dataset.kind if leave == KIND else dataset.name for dataset in datasets}
    if len(set(groups.values())) < 2:
        raise EvaluationError(
            f"choosing needs at least two {leave}s: one is left out, the choice is made on the others"
        )
    return groups


def values_of(texts: Sequence[str], methods: Sequence[str]) -> dict[str, list[str]]:
    """Values by setting, each setting one of a chosen method. Raises EvaluationError."""
    from prior_sg.deploy.evaluation.errors import EvaluationError

    found: dict[str, list[str]] = {}
    for text in texts:
        setting, _, listed = text.partition("=")
        section, _, field = setting.strip().partition(".")
        values = shared.names_in(listed)
        if not values or not field:
            raise EvaluationError(f"--values {text} names no values: write {SECTION}.region_cost=0,10")
        if (OURS if section == SECTION else section) not in methods:
            raise EvaluationError(f"no method of --methods has a setting {setting!r}")
        found[setting.strip()] = values
    if not found:
        raise EvaluationError(f"there is nothing to choose from: add --values {SECTION}.region_cost=0,10")
    return found


def combinations(values: Values, one_at_a_time: bool) -> list[Combination]:
    """Every combination of the values, or each value alone; that of no value is what is configured."""
    listed = [[(setting, value) for value in choices] for setting, choices in values.items()]
    if one_at_a_time:
        return [(pair,) for pairs in listed for pair in pairs] or [()]
    return list(itertools.product(*listed))


def candidates_of(arguments: argparse.Namespace, layers: Layers) -> "dict[str, dict[str, Method]]":
    """By method what may be chosen, by what it is called. Raises EvaluationError or ConfigError."""
    names = shared.names_in(arguments.methods)
    values = values_of(arguments.values, names)
    found: dict[str, dict[str, Method]] = {}
    for name in names:
        section = SECTION if name == OURS else name
        own = {setting: choices for setting, choices in values.items() if setting.split(".")[0] == section}
        chosen = combinations(own, arguments.one_at_a_time)
        found[name] = {called(one): method_of(name, one, layers) for one in chosen}
    return found


def called(combination: Combination) -> str:
    """A combination in words."""
    return ", ".join(f"{setting}={value}" for setting, value in combination) or "as configured"


def method_of(name: str, combination: Combination, layers: Layers) -> "Method":
    """A method with these settings, its name with theirs. Raises EvaluationError or ConfigError."""
    from dataclasses import replace

    from prior_sg.deploy.evaluation import methods
    from prior_sg.services.registry import BY_NAME
    from prior_sg.services.runtime.config import merge, resolve

    changes = {setting.partition(".")[2]: value for setting, value in combination}
    own = merge(layers, {SECTION: changes}) if name == OURS else layers
    config: Any = resolve(BY_NAME[SECTION].config, SECTION, own)
    method = methods.ours(config) if name == OURS else methods.baseline(name, config.object_phrases, changes)
    return replace(method, name=row_name(name, called(combination)))


def row_name(method: str, candidate: str) -> str:
    """What a method with a combination is called among all."""
    return f"{method}: {candidate}"


def judged(arguments: argparse.Namespace, datasets: "Sequence[Dataset]") -> dict[str, Judged]:
    """All scores of all combinations, by dataset."""
    from prior_sg.deploy.evaluation.errors import EvaluationError

    if arguments.jobs < 0:
        raise EvaluationError("--jobs must be at least 1, or 0 for the number of cores")
    jobs = min(arguments.jobs or os.cpu_count() or 1, len(datasets))
    with shared.progress(Terminal(stderr=True)) as report:
        if jobs > 1:
            parts = shared.in_parallel(arguments, datasets, jobs, report, judge_one)
        else:
            parts = [judge_one(arguments, dataset) for dataset in datasets]
    return {dataset.name: part for dataset, part in zip(datasets, parts, strict=True)}


def judge_one(arguments: argparse.Namespace, dataset: "Dataset") -> Judged:
    """All combinations of all methods, and the configured settings, on one dataset."""
    from prior_sg.deploy.evaluation import runner

    layers = shared.chosen_layers(arguments)
    perceive = shared.perceiver_of(arguments, layers, lambda *_: None).perceive
    rows = {name: method_of(name, (), layers) for name in shared.names_in(arguments.methods)}
    methods = {method.name: method for method in rows.values()}
    for candidates in candidates_of(arguments, layers).values():
        methods |= {method.name: method for method in candidates.values()}
    part = runner.run_one(dataset, list(methods.values()), perceive, lambda *_: None)
    return {outcome.method.name: outcome.scores for outcome in part.outcomes}


def choose(
    arguments: argparse.Namespace, scores: Mapping[str, Judged], groups: Mapping[str, str]
) -> "dict[str, Tuned]":
    """By method what choosing is worth. Raises EvaluationError where a dataset has no such score."""
    from prior_sg.deploy.evaluation.tuning import grouped, tuned

    keys = shared.names_in(arguments.score)

    def means(row: str) -> dict[str, float]:
        return grouped({name: score_of(scores[name][row], keys, name) for name in scores}, groups)

    found = {}
    for name, candidates in candidates_of(arguments, shared.chosen_layers(arguments)).items():
        default = means(row_name(name, called(())))
        found[name] = tuned({candidate: means(row_name(name, candidate)) for candidate in candidates}, default)
    return found


def score_of(scores: Mapping[str, float], keys: Sequence[str], dataset: str) -> float:
    """Mean of the scores named. Raises EvaluationError where there is none."""
    from prior_sg.deploy.evaluation.errors import EvaluationError

    missing = [key for key in keys if math.isnan(scores[key])]
    if missing:
        raise EvaluationError(f"{dataset} has no {', '.join(missing)}: leave it out of --score, or the dataset")
    return math.fsum(scores[key] for key in keys) / len(keys)


def as_table(found: "Tuned") -> dict[str, Any]:
    """For JSON; pairs are a mean and its standard error."""
    return {
        "left_out": list(found.left_out),
        "hindsight": {"candidate": found.hindsight, "mean": found.hindsight_mean},
        "default": list(found.default),
        "gain": list(found.gain),
        "helps": found.helps,
        "chosen": found.chosen,
        "choices": [vars(choice) for choice in found.choices],
    }


def print_tables(found: "Mapping[str, Tuned]", console: Terminal, leave: str) -> None:
    """One row per method, then what was chosen and whether it helps."""
    console.width = max(console.width, shared.TABLE_COLUMNS)
    title = f"percent, mean±standard error over {leave}s left out"
    table = Table("method", title=title, box=SIMPLE, padding=(0, 1, 0, 0))
    for heading in ("left out", "hindsight", "as configured", "gain"):
        table.add_column(heading, justify="right", no_wrap=True)
    for name, one in found.items():
        row = (percent(*one.left_out), f"{100 * one.hindsight_mean:.1f}", percent(*one.default), percent(*one.gain))
        table.add_row(name, *row)
    console.print(table)
    for name, one in found.items():
        for candidate, times in one.chosen.items():
            console.print(f"{name}: {candidate} was chosen {times} of {len(one.choices)} times")
        console.print(verdict(name, one))


def verdict(name: str, found: "Tuned") -> str:
    """Whether choosing helps, in a sentence."""
    gain, error = found.gain
    more = "helps by more than its error" if found.helps else "does not help by more than its error"
    return f"{name}: choosing {more} ({100 * gain:+.1f}±{100 * error:.1f})"


def percent(mean: float, error: float) -> str:
    """As the tables have it."""
    return f"{100 * mean:.1f}±{100 * error:.1f}"

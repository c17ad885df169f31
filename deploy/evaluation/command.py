"""`prior-sg eval`: from the command line to tables and a page."""

import argparse
import os
from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING, Any

from prior_sg.deploy.cli.shared import add_settings
from prior_sg.deploy.evaluation.kinds import BASELINES, ORACLES, OURS, SWEEPS
from prior_sg.deploy.evaluation.shared import (
    add_datasets,
    check_encoder,
    chosen_layers,
    in_parallel,
    names_in,
    perceiver_of,
    progress,
)
from prior_sg.deploy.evaluation.tables import print_tables
from prior_sg.deploy.json_text import json_text
from prior_sg.deploy.settings import Layers
from prior_sg.deploy.terminal import Terminal

if TYPE_CHECKING:
    from prior_sg.deploy.evaluation.datasets import Dataset
    from prior_sg.deploy.evaluation.methods import Method
    from prior_sg.deploy.evaluation.runner import Part, Results


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What `prior-sg eval` can be told."""
    add_datasets(parser)
    parser.add_argument("--methods", default=OURS, help=f"of {', '.join((OURS, *BASELINES))} (default: %(default)s)")
    parser.add_argument("--ablate", action="store_true", help="ours with experts and parts taken away, too")
    parser.add_argument("--oracle", default="", help=f"ours with a part made perfect: {', '.join(ORACLES)}")
    parser.add_argument("--sweep", default="", help=f"ours over values of a setting: {', '.join(SWEEPS)}")
    parser.add_argument(
        "--ahead",
        action="store_true",
        help="instead, how right labels are before their places are near, by distance, with and without a pyramid; "
        "writes ahead.json, one dataset after the other, such as: prior-sg eval world:station:0 --encoder sim:0.3 "
        "--ahead",
    )
    parser.add_argument(
        "--search",
        action="store_true",
        help="instead, whether what is found for texts answers them, on the sequences with questions: aws_small_house "
        "and the sample; writes search.json",
    )
    parser.add_argument(
        "--priors",
        type=int,
        default=1,
        metavar="K",
        help="the library's prior and K-1 perturbed ones, which stand in for K generations of a language model",
    )
    parser.add_argument("--strength", type=float, default=0.5, help="noise on their logits (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=Path("out/eval"), help="folder for results and the cache")
    parser.add_argument("--json", action="store_true", help="print JSON instead of tables")
    parser.add_argument("--html", action="store_true", help="write report.html with tables, pictures and plots")
    add_settings(parser)


def run(arguments: argparse.Namespace, console: Terminal) -> int:
    """Evaluate, print, and write eval.json (and report.html) to the output folder. Raises EvaluationError."""
    from prior_sg.deploy.evaluation import runner
    from prior_sg.deploy.evaluation.datasets import chosen_datasets
    from prior_sg.deploy.evaluation.errors import EvaluationError

    if arguments.priors < 1 or arguments.strength < 0:
        raise EvaluationError("--priors must be at least 1 and --strength at least 0")
    if arguments.jobs < 0:
        raise EvaluationError("--jobs must be at least 1, or 0 for the number of cores")
    if arguments.search and arguments.ahead:
        raise EvaluationError("--search and --ahead judge different things: give one of them")
    if arguments.ahead and (arguments.methods != OURS or arguments.ablate or arguments.oracle or arguments.sweep):
        raise EvaluationError("--ahead brings its own methods: leave out --methods, --ablate, --oracle and --sweep")
    if arguments.ahead and (arguments.priors > 1 or arguments.jobs > 1):
        raise EvaluationError("--ahead takes one prior and one dataset at a time: leave out --priors and --jobs")
    layers = chosen_layers(arguments)
    methods = chosen_methods(arguments, layers)
    datasets = chosen_datasets(arguments.datasets, arguments.environment, arguments.task)
    check_encoder(arguments.encoder, datasets, arguments.sweep)
    arguments.out.mkdir(parents=True, exist_ok=True)
    if arguments.ahead:
        from prior_sg.deploy.evaluation.ahead_command import judge_ahead

        return judge_ahead(arguments, layers, datasets, console)
    if arguments.search:
        from prior_sg.deploy.evaluation.search_command import judge_search

        return judge_search(arguments, layers, datasets, console)
    jobs = min(arguments.jobs or os.cpu_count() or 1, len(datasets))
    with progress(Terminal(stderr=True)) as report:
        if jobs > 1:
            results = runner.joined(datasets, methods, in_parallel(arguments, datasets, jobs, report, judge_one))
        else:
            perceive = perceiver_of(arguments, layers, report).perceive
            results = runner.run(
                datasets, methods, perceive, report, priors=arguments.priors, strength=arguments.strength
            )
    found = results.table()
    (arguments.out / "eval.json").write_text(json_text(found))
    if arguments.json:
        print(json_text(found, None))
    else:
        print_tables(results, console)
    if arguments.html:
        _write_page(results, arguments)
        Terminal(stderr=True).print(f"written to {arguments.out}: eval.json, report.html")
    return 0


def judge_one(arguments: argparse.Namespace, dataset: "Dataset") -> "Part":
    """All methods on one dataset, in a process of its own."""
    from prior_sg.deploy.evaluation import runner

    layers = chosen_layers(arguments)
    perceive = perceiver_of(arguments, layers, lambda *_: None).perceive
    methods, priors = chosen_methods(arguments, layers), arguments.priors
    part = runner.run_one(dataset, methods, perceive, lambda *_: None, priors=priors, strength=arguments.strength)
    return part.portable()


def chosen_methods(arguments: argparse.Namespace, layers: Layers) -> "list[Method]":
    """In the order of the tables. Raises EvaluationError for a name that does not exist."""
    from prior_sg.deploy.evaluation import methods
    from prior_sg.services.registry import BY_NAME
    from prior_sg.services.runtime.config import resolve

    config: Any = resolve(BY_NAME["segmenter"].config, "segmenter", layers)
    chosen = []
    for name in names_in(arguments.methods):
        own = name == OURS
        chosen.append(methods.ours(config) if own else methods.baseline(name, config.object_phrases))
    chosen += methods.ablations(config) if arguments.ablate else []
    chosen += [methods.oracle(config, kind) for kind in _known(arguments.oracle, ORACLES, "--oracle")]
    for kind in _known(arguments.sweep, SWEEPS, "--sweep"):
        chosen += methods.sweep(config, kind)
    return chosen


def _write_page(results: "Results", arguments: argparse.Namespace) -> None:
    from prior_sg.deploy.evaluation.page import page

    settings = {
        "datasets": ", ".join(dataset.name for dataset in results.sequences),
        "environments": ", ".join(dict.fromkeys(dataset.prior.environment for dataset in results.sequences)),
        "task": arguments.task,
        "vocabulary": "fixed to the names in the ground truth",
        "priors": f"{arguments.priors}, noise {arguments.strength} on the logits of all but the first",
        "settings": ", ".join(arguments.set) or "defaults",
    }
    (arguments.out / "report.html").write_text(page(results, settings))


def _known(text: str, kinds: Collection[str], option: str) -> list[str]:
    from prior_sg.deploy.evaluation.errors import EvaluationError

    unknown = [name for name in names_in(text) if name not in kinds]
    if unknown:
        raise EvaluationError(f"{option} knows {', '.join(kinds)}, not {', '.join(unknown)}")
    return names_in(text)

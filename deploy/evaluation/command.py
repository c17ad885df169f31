"""`prior-sg eval`: from the command line to tables and a page."""

import argparse
import math
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.box import SIMPLE
from rich.table import Table

from prior_sg.deploy.cli.shared import add_settings
from prior_sg.deploy.evaluation.kinds import BASELINES, ORACLES, OURS, SWEEPS
from prior_sg.deploy.json_text import json_text
from prior_sg.deploy.settings import DEMO_TASK, Layers, settings_layers
from prior_sg.deploy.terminal import Description, Terminal

if TYPE_CHECKING:
    from prior_sg.deploy.evaluation.methods import Method
    from prior_sg.deploy.evaluation.perception import Report
    from prior_sg.deploy.evaluation.runner import Dataset, Results

TABLE_COLUMNS = 100  # narrower terminals wrap lines, which is better than cells cut short
SHOWN = {  # keys with their column titles
    "f1_s": "F1_S",
    "f1_g": "F1_G",
    "miou_s": "mIoU_S",
    "miou_g": "mIoU_G",
    "miou_s_penalised": "pen._S",
    "accuracy": "acc.",
    "boundary_f1": "bound.",
    "ece": "ECE",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What `prior-sg eval` can be told."""
    parser.add_argument("datasets", nargs="+", type=Path, metavar="DATASET", help="sources with ground truth")
    parser.add_argument(
        "--environment",
        action="append",
        default=[],
        metavar="[NAME=]TEXT",
        required=True,
        help="what kind of place it is, in plain words: of all datasets, or of the dataset NAME; may be repeated",
    )
    parser.add_argument("--task", default=DEMO_TASK, help="what the robot is to do (default: %(default)s)")
    parser.add_argument("--methods", default=OURS, help=f"of {', '.join((OURS, *BASELINES))} (default: %(default)s)")
    parser.add_argument("--ablate", action="store_true", help="ours with experts and parts taken away, too")
    parser.add_argument("--oracle", default="", help=f"ours with a part made perfect: {', '.join(ORACLES)}")
    parser.add_argument("--sweep", default="", help=f"ours over values of a setting: {', '.join(SWEEPS)}")
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
    from prior_sg.deploy.evaluation.perception import Cache, EvaluationError, Perceiver

    if arguments.priors < 1 or arguments.strength < 0:
        raise EvaluationError("--priors must be at least 1 and --strength at least 0")
    layers = settings_layers(arguments.config, arguments.set)
    methods = chosen_methods(arguments, layers)
    datasets = chosen_datasets(arguments.datasets, arguments.environment, arguments.task)
    arguments.out.mkdir(parents=True, exist_ok=True)
    with progress(Terminal(stderr=True)) as report:
        perceiver = Perceiver(layers, Cache(arguments.out / "cache"), report)
        results = runner.run(
            datasets, methods, perceiver.perceive, report, priors=arguments.priors, strength=arguments.strength
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


def chosen_methods(arguments: argparse.Namespace, layers: Layers) -> "list[Method]":
    """In the order of the tables. Raises EvaluationError for a name that does not exist."""
    from prior_sg.deploy.evaluation import methods
    from prior_sg.services.registry import BY_NAME
    from prior_sg.services.runtime.config import resolve

    config: Any = resolve(BY_NAME["segmenter"].config, "segmenter", layers)
    chosen = []
    for name in _names(arguments.methods):
        own = name == OURS
        chosen.append(methods.ours(config) if own else methods.baseline(name, config.object_phrases))
    chosen += methods.ablations(config) if arguments.ablate else []
    chosen += [methods.oracle(config, kind) for kind in _known(arguments.oracle, ORACLES, "--oracle")]
    for kind in _known(arguments.sweep, SWEEPS, "--sweep"):
        chosen += methods.sweep(config, kind)
    return chosen


def chosen_datasets(paths: Sequence[Path], environments: Sequence[str], task: str) -> "list[Dataset]":
    """Datasets with truth and prior; the vocabulary is the ground truth's. Raises EvaluationError or SourceError."""
    from prior_sg.deploy.evaluation.perception import EvaluationError, ground_truth, sequence_name
    from prior_sg.deploy.evaluation.priors import library_prior
    from prior_sg.deploy.evaluation.runner import Dataset
    from prior_sg.deploy.truth import read_objects
    from prior_sg.services.ingest.sources import open_source

    named = dict(text.split("=", 1) for text in environments if "=" in text)
    general = [text for text in environments if "=" not in text]
    datasets: list[Dataset] = []
    for path in paths:
        name, truth = sequence_name(path), ground_truth(path)
        environment = named.get(name, general[-1] if general else "")
        if not environment:
            raise EvaluationError(f'say what kind of place {name} is, such as --environment "{name}=residential home"')
        if any(dataset.name == name for dataset in datasets):
            raise EvaluationError(f"two datasets are called {name}; rename one, for tables go by name")
        prior = library_prior(environment, task, list(dict.fromkeys(region.label for region in truth.regions)))
        datasets.append(Dataset(name, path, truth, prior, read_objects(path, open_source(path).origin_m)))
    return datasets


def print_tables(results: "Results", console: Terminal) -> None:
    """One table per dataset, then the mean over all; percent."""
    console.width = max(console.width, TABLE_COLUMNS)
    names = [dataset.name for dataset in results.sequences]
    for name in [*names, ""] if len(names) > 1 else names:
        title = f"{name or 'all datasets'}: percent, mean±sd over {'priors' if name else 'datasets and priors'}"
        table = Table(title=title, box=SIMPLE, padding=(0, 1, 0, 0))
        table.add_column("method", no_wrap=True)
        for heading in (*SHOWN.values(), "s"):
            table.add_column(heading, justify="right", no_wrap=True)
        for method in results.methods:
            cells = [_cell(results.mean(method.name, k, name), results.sd(method.name, k, name)) for k in SHOWN]
            table.add_row(method.name, *cells, f"{results.mean(method.name, 'seconds', name):.2f}")
        console.print(table)
        for method in results.methods:
            if name and results.judges_objects(method.name, name):
                console.print(f"{method.name}, objects of {name}: {_objects(results, method.name, name)}")


def _objects(results: "Results", method: str, sequence: str) -> str:
    """The scores of the objects in one line; shares in percent, counts as means over the priors."""
    from prior_sg.deploy.evaluation.object_metrics import OBJECT_COUNTS, OBJECT_SHARES

    said = [f"{key.removeprefix('objects_')} {results.mean(method, key, sequence):.4g}" for key in OBJECT_COUNTS]
    for key in OBJECT_SHARES:
        shown = _cell(results.mean(method, key, sequence), results.sd(method, key, sequence))
        said.append(f"{key.removeprefix('objects_').replace('_', ' ')} {shown}")
    return ", ".join(said)


@contextmanager
def progress(console: Terminal) -> "Iterator[Report]":
    """A line that says what is being done and how far it is."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeElapsedColumn

    columns = (Description(), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as bar:
        line = bar.add_task("", total=None)
        yield lambda what, done, total: bar.update(line, description=what, completed=done, total=total or None)


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


def _cell(mean: float, sd: float) -> str:
    """Percent, as the paper's tables have it."""
    if math.isnan(mean):
        return "–"
    return f"{100 * mean:.1f}±{100 * sd:.0f}" if sd else f"{100 * mean:.1f}"


def _names(text: str) -> list[str]:
    return list(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))


def _known(text: str, kinds: Collection[str], option: str) -> list[str]:
    from prior_sg.deploy.evaluation.perception import EvaluationError

    unknown = [name for name in _names(text) if name not in kinds]
    if unknown:
        raise EvaluationError(f"{option} knows {', '.join(kinds)}, not {', '.join(unknown)}")
    return _names(text)

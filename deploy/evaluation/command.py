"""`prior-sg eval`: from the command line to tables and a page."""

import argparse
import math
import multiprocessing
import os
import signal
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from rich.box import SIMPLE
from rich.table import Table

from prior_sg.deploy.cli.shared import add_settings
from prior_sg.deploy.evaluation.kinds import BASELINES, ORACLES, OURS, SWEEPS
from prior_sg.deploy.json_text import json_text
from prior_sg.deploy.settings import DEMO_TASK, Layers, settings_layers
from prior_sg.deploy.terminal import Description, Terminal

if TYPE_CHECKING:
    from prior_sg.deploy.evaluation.ahead import Ahead
    from prior_sg.deploy.evaluation.datasets import Dataset
    from prior_sg.deploy.evaluation.methods import Method
    from prior_sg.deploy.evaluation.perception import Perceiver, Report
    from prior_sg.deploy.evaluation.runner import Part, Results

Judged = TypeVar("Judged")

CONSE = "conse"
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
    "risk_half": "risk½",
}


def add_datasets(parser: argparse.ArgumentParser) -> None:
    """What to judge on, and how it is seen."""
    parser.add_argument(
        "datasets",
        nargs="+",
        type=Path,
        metavar="DATASET",
        help="sources with ground truth, or generated worlds as world:KIND:SEEDS, with SEEDS such as 3, 0-9 or 1,4,7",
    )
    parser.add_argument(
        "--environment",
        action="append",
        default=[],
        metavar="[NAME=]TEXT",
        help="what kind of place it is, in plain words: of all sequences, or of the sequence NAME; may be repeated",
    )
    parser.add_argument(
        "--encoder",
        default="",
        metavar="NAME",
        help="conse, or a simulated one that sees what crops truly show, sim:P or simlike:P with P, how often it "
        "errs, from 0 to 1 (default: as configured)",
    )
    parser.add_argument(
        "--jobs", type=int, default=0, metavar="N", help="datasets at a time (default: the number of cores)"
    )
    parser.add_argument("--task", default=DEMO_TASK, help="what the robot is to do (default: %(default)s)")


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


def judge_ahead(arguments: argparse.Namespace, layers: Layers, datasets: "Sequence[Dataset]", console: Terminal) -> int:
    """Judge labels before their places are near; print, write ahead.json (and ahead.html). Raises EvaluationError."""
    from prior_sg.deploy.evaluation.ahead import joined
    from prior_sg.deploy.evaluation.ahead_page import page
    from prior_sg.deploy.evaluation.ahead_walks import judged
    from prior_sg.deploy.evaluation.methods import Case
    from prior_sg.services.registry import BY_NAME
    from prior_sg.services.runtime.config import resolve

    config: Any = resolve(BY_NAME["segmenter"].config, "segmenter", layers)
    found: dict[str, dict[str, dict[str, Ahead]]] = {}
    with progress(Terminal(stderr=True)) as report:
        perceiver = perceiver_of(arguments, layers, report)
        for dataset in datasets:
            sought = tuple(item.name for item in dataset.prior.objects)
            case = Case(perceiver.perceive(dataset, None, sought), dataset.prior, dataset.truth, dataset.objects)
            deltas = perceiver.deltas(dataset)
            report(f"{dataset.name}: ahead", 0, 0)
            found[dataset.name] = judged(case, deltas, config)
    if len(found) > 1:
        parts = list(found.values())
        found["all datasets"] = {
            nearness: {method: joined(part[nearness][method] for part in parts) for method in rows}
            for nearness, rows in parts[0].items()
        }
    tables = {
        name: {near: {method: one.table() for method, one in rows.items()} for near, rows in kinds.items()}
        for name, kinds in found.items()
    }
    (arguments.out / "ahead.json").write_text(json_text(tables))
    if arguments.json:
        print(json_text(tables, None))
    else:
        print_ahead(found, console)
    if arguments.html:
        (arguments.out / "ahead.html").write_text(page(found))
        Terminal(stderr=True).print(f"written to {arguments.out}: ahead.json, ahead.html")
    return 0


def print_ahead(found: "Mapping[str, Mapping[str, Mapping[str, Ahead]]]", console: Terminal) -> None:
    """Two tables per dataset, and over all, for when a place counts as near."""
    from prior_sg.deploy.evaluation.ahead import NEARNESS
    from prior_sg.deploy.evaluation.ahead_page import HEADINGS, cells

    console.width = max(console.width, TABLE_COLUMNS)
    for name, nearness in ((name, nearness) for name in found for nearness in NEARNESS):
        title = f"{name}: percent right ahead (places), {NEARNESS[nearness]}"
        table = Table(title=title, box=SIMPLE, padding=(0, 1, 0, 0))
        table.add_column("method", no_wrap=True)
        for heading in HEADINGS:
            table.add_column(heading, justify="right", no_wrap=True)
        for method, one in found[name][nearness].items():
            table.add_row(method, *cells(one))
        console.print(table)


def chosen_layers(arguments: argparse.Namespace) -> Layers:
    """The settings, with the encoder that was asked for where it is a real one. Raises EvaluationError."""
    from prior_sg.deploy.evaluation.errors import EvaluationError
    from prior_sg.deploy.evaluation.simulated import simulated
    from prior_sg.schemas.features import DEFAULT_SPACE

    layers = settings_layers(arguments.config, arguments.set)
    try:
        if not arguments.encoder or simulated(arguments.encoder):
            return layers
    except ValueError as error:
        raise EvaluationError(str(error)) from error
    if arguments.encoder != CONSE:
        raise EvaluationError(f"--encoder is {CONSE}, sim:P or simlike:P, not {arguments.encoder!r}")
    own = layers.get("feature_pyramid", {})
    if str(own.get("space", DEFAULT_SPACE)).startswith(f"{CONSE}/"):
        return layers
    return {**layers, "feature_pyramid": {**own, "space": DEFAULT_SPACE}}


def check_encoder(encoder: str, datasets: "Sequence[Dataset]", sweep: str = "") -> None:
    """Raise EvaluationError where an encoder is asked what it cannot tell."""
    from prior_sg.deploy.evaluation.errors import EvaluationError
    from prior_sg.deploy.evaluation.simulated import simulated

    if simulated(encoder) is None:
        if any(dataset.world for dataset in datasets):
            raise EvaluationError("worlds have no colours for a real encoder: add --encoder sim:P or simlike:P")
    elif "encoder" in names_in(sweep):
        raise EvaluationError("--sweep encoder compares real encoders: leave out --encoder, or that sweep")


def perceiver_of(arguments: argparse.Namespace, layers: Layers, report: "Report") -> "Perceiver":
    """What perceives the datasets of a command line."""
    from prior_sg.deploy.evaluation.perception import Cache, Perceiver

    return Perceiver(layers, Cache(arguments.out / "cache"), report, arguments.encoder)


def in_parallel(
    arguments: argparse.Namespace,
    datasets: "Sequence[Dataset]",
    jobs: int,
    report: "Report",
    judge: "Callable[[argparse.Namespace, Dataset], Judged]",
) -> "list[Judged]":
    """Each dataset judged in one of several processes, which start anew: compiled code and threads do not fork."""
    asked = argparse.Namespace(**{name: value for name, value in vars(arguments).items() if name != "run"})
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, context, signal.signal, (signal.SIGINT, signal.SIG_IGN)) as pool:
        futures = [pool.submit(judge, asked, dataset) for dataset in datasets]
        try:
            for done, _ in enumerate(as_completed(futures)):
                report(f"{jobs} datasets at a time", done + 1, len(datasets))
            return [future.result() for future in futures]
        except KeyboardInterrupt:  # the processes do not hear of it: each would tell it as a fault of its own
            for process in multiprocessing.active_children():
                process.kill()
            raise


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


def print_tables(results: "Results", console: Terminal) -> None:
    """One table per dataset, with worlds one per kind, then the mean over all; percent."""
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
        if not name:
            _print_kinds(results, console)
        console.print(table)
        for method in results.methods:
            if name and results.judges_objects(method.name, name):
                console.print(f"{method.name}, objects of {name}: {_objects(results, method.name, name)}")


def _print_kinds(results: "Results", console: Terminal) -> None:
    """One table per kind of dataset, where some are worlds."""
    for kind in results.kinds():
        count = sum(dataset.kind == kind for dataset in results.sequences)
        table = Table(title=f"{kind}, {count} datasets: percent, mean±standard error", box=SIMPLE, padding=(0, 1, 0, 0))
        table.add_column("method", no_wrap=True)
        for heading in SHOWN.values():
            table.add_column(heading, justify="right", no_wrap=True)
        for method in results.methods:
            pairs = [results.of_kind(method.name, key, kind) for key in SHOWN]
            table.add_row(method.name, *(_cell_with_error(*pair) for pair in pairs))
        console.print(table)


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


def _cell_with_error(mean: float, error: float) -> str:
    if math.isnan(mean):
        return "–"
    return f"{100 * mean:.1f}" if math.isnan(error) else f"{100 * mean:.1f}±{100 * error:.1f}"


def names_in(text: str) -> list[str]:
    """The parts of a list with commas, each once."""
    return list(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))


def _known(text: str, kinds: Collection[str], option: str) -> list[str]:
    from prior_sg.deploy.evaluation.errors import EvaluationError

    unknown = [name for name in names_in(text) if name not in kinds]
    if unknown:
        raise EvaluationError(f"{option} knows {', '.join(kinds)}, not {', '.join(unknown)}")
    return names_in(text)

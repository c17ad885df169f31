"""What the commands that judge have in common: datasets and encoder as asked for, perception, progress, processes."""

import argparse
import multiprocessing
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from prior_sg.deploy.cli.shared import hush_logs
from prior_sg.deploy.settings import DEMO_TASK, Layers, settings_layers
from prior_sg.deploy.terminal import Description, Terminal

if TYPE_CHECKING:
    from prior_sg.deploy.evaluation.datasets import Dataset
    from prior_sg.deploy.evaluation.perception import Perceiver, Report

Judged = TypeVar("Judged")

CONSE = "conse"
TABLE_COLUMNS = 100  # narrower terminals wrap lines, which is better than cells cut short


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
    with ProcessPoolExecutor(jobs, context, _begin_process) as pool:
        futures = [pool.submit(judge, asked, dataset) for dataset in datasets]
        try:
            for done, _ in enumerate(as_completed(futures)):
                report(f"{jobs} datasets at a time", done + 1, len(datasets))
            return [future.result() for future in futures]
        except KeyboardInterrupt:  # the processes do not hear of it: each would tell it as a fault of its own
            for process in multiprocessing.active_children():
                process.kill()
            raise


def _begin_process() -> None:
    """Ctrl-C is the first process's to hear, and what services warn of nobody's."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    hush_logs()


@contextmanager
def progress(console: Terminal) -> "Iterator[Report]":
    """A line that says what is being done and how far it is."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeElapsedColumn

    columns = (Description(), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as bar:
        line = bar.add_task("", total=None)
        yield lambda what, done, total: bar.update(line, description=what, completed=done, total=total or None)


def names_in(text: str) -> list[str]:
    """The parts of a list with commas, each once."""
    return list(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))

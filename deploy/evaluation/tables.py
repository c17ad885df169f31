"""The results of `prior-sg eval` as tables of a terminal."""

import math
from typing import TYPE_CHECKING

from rich.box import SIMPLE

from prior_sg.deploy.evaluation.shared import TABLE_COLUMNS
from prior_sg.deploy.terminal import Table, Terminal

if TYPE_CHECKING:
    from prior_sg.deploy.evaluation.runner import Results

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


def _cell(mean: float, sd: float) -> str:
    """Percent, as the paper's tables have it."""
    if math.isnan(mean):
        return "–"
    return f"{100 * mean:.1f}±{100 * sd:.0f}" if sd else f"{100 * mean:.1f}"


def _cell_with_error(mean: float, error: float) -> str:
    if math.isnan(mean):
        return "–"
    return f"{100 * mean:.1f}" if math.isnan(error) else f"{100 * mean:.1f}±{100 * error:.1f}"

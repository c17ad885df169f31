"""`prior-sg eval --ahead`: how right labels are before their places are near, as tables."""

import argparse
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rich.box import SIMPLE

from prior_sg.deploy.evaluation.shared import TABLE_COLUMNS, perceiver_of, progress
from prior_sg.deploy.json_text import json_text
from prior_sg.deploy.settings import Layers
from prior_sg.deploy.terminal import Table, Terminal

if TYPE_CHECKING:
    from prior_sg.deploy.evaluation.ahead import Ahead
    from prior_sg.deploy.evaluation.datasets import Dataset


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

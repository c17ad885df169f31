"""Accuracy of labels ahead as rows of cells, and as one HTML page with a plot for each dataset."""

from collections.abc import Mapping
from html import escape

import numpy as np

from prior_sg.deploy.evaluation.ahead import NEARNESS, Ahead, band_names
from prior_sg.deploy.evaluation.plots import line_plot

HEADINGS = (*(f"{name} m" for name in band_names()), "settled", "lead s", "lead m")


def cells(one: Ahead) -> list[str]:
    """One row under HEADINGS: percent and number of places by band, percent settled, median lead."""
    bands = zip(one.accuracy.tolist(), one.counts.tolist(), strict=True)
    shown = [f"{100 * share:.0f} ({count})" if count else "–" for share, count in bands]
    shown.append(f"{100 * one.settled / one.places:.0f}" if one.places else "–")
    leads = (one.leads_s, one.leads_m)
    return [*shown, *(f"{np.median(lead):.1f}" if len(lead) else "–" for lead in leads)]


def page(found: Mapping[str, Mapping[str, Mapping[str, Ahead]]]) -> str:
    """A page that needs nothing else; `found` by dataset, one of NEARNESS, and method."""
    sections = [
        f"<h2>{escape(name)}</h2><p>{escape(NEARNESS[nearness])}</p>{_table(rows)}{_plot(rows)}"
        for name, kinds in found.items()
        for nearness, rows in kinds.items()
    ]
    return (
        "<!doctype html><html lang=en><meta charset=utf-8><title>prior-sg regions ahead</title>"
        "<style>body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem; } td, th { padding: .2rem .6rem; "
        "text-align: right; } td:first-child { text-align: left; }</style>"
        f"<body><h1>Regions ahead</h1>{''.join(sections)}</body></html>\n"
    )


def _table(rows: Mapping[str, Ahead]) -> str:
    head = "".join(f"<th>{escape(heading)}</th>" for heading in HEADINGS)
    lines = [
        f"<tr><td>{escape(method)}</td>{''.join(f'<td>{escape(cell)}</td>' for cell in cells(one))}</tr>"
        for method, one in rows.items()
    ]
    return f"<table><tr><th>method</th>{head}</tr>{''.join(lines)}</table>"


def _plot(rows: Mapping[str, Ahead]) -> str:
    curves = {
        method: [(float(x), float(y)) for x, y in enumerate(one.accuracy) if not np.isnan(y)]
        for method, one in rows.items()
    }
    return line_plot(curves, "distance to the nearest camera so far (m)", "right", x_names=band_names())

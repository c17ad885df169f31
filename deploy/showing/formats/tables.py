"""The scene as a folder of CSV tables, for spreadsheets and whatever reads them.

A text that a spreadsheet would take for a formula (`=`, `+`, `-`, `@`, also in full width, tabulator, carriage return
at its beginning) has an apostrophe before it, as OWASP advises; labels come from models and users.
"""

import csv
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from prior_sg.deploy.api.scene import Scene, flat_rows
from prior_sg.deploy.showing.material import Material

MARKER_COLUMNS = (
    "dictionary",
    "id",
    "size_m",
    *("x_m", "y_m", "z_m"),
    *("quaternion_x", "quaternion_y", "quaternion_z", "quaternion_w"),
    *("keyframes", "doubt"),
)
FORMULA_STARTS = (*"=+-@＝＋－＠", "\t", "\r", "\n")


def write_csv(material: Material, path: Path) -> None:
    """places, regions, objects, edges, beliefs (place, label, probability), ways, frontiers, trajectory and markers."""
    scene, message = Scene(material.scene), material.scene
    path.mkdir(parents=True, exist_ok=True)
    for name, table in (("places", scene.places), ("regions", scene.regions), ("objects", scene.objects)):
        columns, rows = flat_rows(table)
        _write(path / f"{name}.csv", columns, rows)
    edges = ((a, b, c) for (a, b), c in zip(message.edges.tolist(), message.clearances_m.tolist(), strict=True))
    _write(path / "edges.csv", ("place_a", "place_b", "clearance_m"), edges)
    _write(path / "beliefs.csv", ("place", "label", "probability"), _beliefs(scene))
    ways = (
        (region.id, way.region, *way.edge, *way.position_m, way.clearance_m, way.door)
        for region in message.regions
        for way in region.transitions
    )
    _write(
        path / "ways.csv",
        ("region_from", "region_to", "place_from", "place_to", "x_m", "y_m", "z_m", "clearance_m", "door"),
        ways,
    )
    openings = np.column_stack((message.frontier_directions, message.frontier_areas_m2)).tolist()
    frontiers = ((place, *row) for place, row in zip(message.frontier_ids.tolist(), openings, strict=True))
    _write(path / "frontiers.csv", ("place", "direction_x", "direction_y", "direction_z", "area_m2"), frontiers)
    _write(path / "trajectory.csv", ("x_m", "y_m", "z_m"), message.trajectory.tolist())
    marks = (
        (one.dictionary, one.id, one.size_m, *one.position_m, *one.quaternion_xyzw, one.frames, one.doubt)
        for one in message.markers
    )
    _write(path / "markers.csv", MARKER_COLUMNS, marks)


def _beliefs(scene: Scene) -> Iterator[tuple[int, str, float]]:
    for place, posterior in zip(scene.places.ids.tolist(), scene.places.posteriors.tolist(), strict=True):
        for label, probability in zip(scene.labels, posterior, strict=True):
            if probability:
                yield place, label, probability


def _write(path: Path, columns: Iterable[str], rows: Iterable[Iterable[Any]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows([_harmless(value) for value in row] for row in rows)


def _harmless(value: Any) -> Any:
    return f"'{value}" if isinstance(value, str) and value.startswith(FORMULA_STARTS) else value

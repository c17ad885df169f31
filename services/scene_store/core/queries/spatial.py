"""By position: in a box, within a radius, the nearest (pure)."""

import numpy as np

from prior_sg.schemas.answers import Point, Thing, Things, What
from prior_sg.schemas.queries import InBox, InRadius, Nearest
from prior_sg.services.scene_store.core.queries.index import Index
from prior_sg.services.scene_store.core.queries.labels import chosen_rows, kinds, nothing_called
from prior_sg.services.scene_store.core.queries.things import things

CLOSE = 1e-9  # relative: distances so near to each other are equal, and the smaller id comes first


def in_box(index: Index, question: InBox) -> Things:
    """What lies in a box, by kind and id."""
    if question.label and (unknown := nothing_called(index, question.what, question.label)):
        return unknown
    low_m, high_m = np.array(question.min_m), np.array(question.max_m)
    if (low_m > high_m).any():
        return Things(reason=f"the box is empty: its lower corner {question.min_m} is above {question.max_m}")
    found, total = list[Thing](), 0
    for what in kinds(question.what):
        rows = chosen_rows(index, what, question.label)
        rows = rows[_inside(index, what, low_m, high_m)[rows]]
        total += len(rows)
        found += things(index, what, rows[: question.limit - len(found)])
    return Things(things=found, total=total)


def in_radius(index: Index, question: InRadius) -> Things:
    """What is near a point, the nearest first."""
    if question.label and (unknown := nothing_called(index, question.what, question.label)):
        return unknown
    found, total = list[Thing](), 0
    for what in kinds(question.what):
        rows, distances_m = _within(index, what, question)
        total += len(rows)
        order = np.argsort(distances_m, kind="stable")[: question.limit]
        found += things(index, what, rows[order], distances_m[order])
    found.sort(key=lambda one: one.distance_m or 0.0)
    return Things(things=found[: question.limit], total=total)


def nearest(index: Index, question: Nearest) -> Things:
    """The nearest of a kind."""
    if question.label and (unknown := nothing_called(index, question.what, question.label)):
        return unknown
    rows, distances_m, total = _nearest(index, question)
    order = np.argsort(distances_m, kind="stable")[: question.limit]
    return Things(things=things(index, question.what, rows[order], distances_m[order]), total=total)


def distances_of(index: Index, what: What, point_m: Point) -> np.ndarray:
    """From a point to every row of a kind (n,), metres; infinite to a region without places."""
    point = np.array(point_m, np.float64)
    if what == "object":
        low_m, high_m = index.boxes_m
        return np.linalg.norm(np.maximum(np.maximum(low_m - point, point - high_m), 0.0), axis=1)
    places_m = np.sqrt(((index.points_m - point) ** 2).sum(axis=1))
    return places_m if what == "place" else index.nearest_of_regions(places_m)


def _inside(index: Index, what: What, low_m: np.ndarray, high_m: np.ndarray) -> np.ndarray:
    """Whether each row of a kind lies in a box (n,)."""
    if what == "object":
        lower_m, upper_m = index.boxes_m
        return np.all((lower_m <= high_m) & (upper_m >= low_m), axis=1)
    inside = np.all((index.points_m >= low_m) & (index.points_m <= high_m), axis=1)
    if what == "place":
        return inside
    held = index.region_rows[inside]
    return np.isin(np.arange(len(index.regions)), held)


def _within(index: Index, what: What, question: InRadius) -> tuple[np.ndarray, np.ndarray]:
    """Rows (n,), in order, and their distances (n,)."""
    if what == "place" and not question.label:
        rows = np.sort(np.array(index.tree.query_ball_point(question.point_m, question.radius_m), np.int64))
        return rows, np.linalg.norm(index.points_m[rows] - question.point_m, axis=1)
    rows = chosen_rows(index, what, question.label)
    distances_m = distances_of(index, what, question.point_m)[rows]
    near = distances_m <= question.radius_m
    return rows[near], distances_m[near]


def _nearest(index: Index, question: Nearest) -> tuple[np.ndarray, np.ndarray, int]:
    """Rows (n,), in order, and their distances (n,): all that may be among the nearest; and how many there are."""
    what, count = question.what, min(question.limit, len(index.ids(question.what)))
    if what == "place" and not question.label and count:
        farthest_m = float(np.max(index.tree.query(question.point_m, count)[0]))
        reach = InRadius(point_m=question.point_m, radius_m=farthest_m * (1 + CLOSE), what=what)
        return *_within(index, what, reach), len(index.ids(what))
    rows = chosen_rows(index, what, question.label)
    distances_m = distances_of(index, what, question.point_m)[rows]
    there = np.isfinite(distances_m)
    return rows[there], distances_m[there], int(there.sum())

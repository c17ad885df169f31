"""Rows of an index as what answers list (pure)."""

from collections.abc import Iterable

from prior_sg.schemas.answers import Thing, What
from prior_sg.schemas.regions import NO_REGION
from prior_sg.services.scene_store.core.queries.index import Index


def thing(index: Index, what: What, row: int, *, distance_m: float | None = None, score: float | None = None) -> Thing:
    """One row."""
    shown = {"place": _place, "region": _region, "object": _object}[what](index, row)
    return Thing(what=what, distance_m=distance_m, score=score, **shown)


def things(index: Index, what: What, rows: Iterable[int], distances_m: Iterable[float] | None = None) -> list[Thing]:
    """Several rows of a kind."""
    if distances_m is None:
        return [thing(index, what, int(row)) for row in rows]
    pairs = zip(rows, distances_m, strict=True)
    return [thing(index, what, int(row), distance_m=float(distance_m)) for row, distance_m in pairs]


def _place(index: Index, row: int) -> dict:
    scene, region_row = index.scene, int(index.region_rows[row])
    region = index.regions[region_row] if region_row >= 0 else None
    label = region.label if region else ""
    known = label in scene.labels
    return {
        "id": int(scene.place_ids[row]),
        "label": label,
        "position_m": tuple(scene.positions_m[row].tolist()),
        "probability": float(scene.posteriors[row, scene.labels.index(label)]) if known else 0.0,
        "region": region.id if region else NO_REGION,
        "predicted": bool(index.predicted[row]),
    }


def _region(index: Index, row: int) -> dict:
    region = index.regions[row]
    return {
        "id": region.id,
        "label": region.label,
        "position_m": region.position_m,
        "probability": region.probability,
        "region": region.id,
        "predicted": region.predicted,
    }


def _object(index: Index, row: int) -> dict:
    item, region_row = index.objects[row], int(index.object_regions[row])
    return {
        "id": item.id,
        "label": item.label,
        "position_m": item.position_m,
        "probability": item.probability * item.known,
        "region": index.regions[region_row].id if region_row >= 0 else NO_REGION,
    }

"""What is different between two scenes (pure)."""

import numpy as np

from prior_sg.schemas.answers import Difference, Renamed, Thing, What
from prior_sg.services.scene_store.core.queries.index import Index
from prior_sg.services.scene_store.core.queries.labels import REGIONS_AND_OBJECTS
from prior_sg.services.scene_store.core.queries.things import thing


def difference(before: Index, now: Index) -> Difference:
    """What is new, gone and renamed; places are counted."""
    appeared, gone, renamed = list[Thing](), list[Thing](), list[Renamed]()
    for what in REGIONS_AND_OBJECTS:
        appeared += _only_in(now, before, what)
        gone += _only_in(before, now, what)
        renamed += _renamed(before, now, what)
    old, new = before.scene, now.scene
    return Difference(
        since_revision=before.scene.revision,
        appeared=appeared,
        gone=gone,
        renamed=renamed,
        places_appeared=int((~np.isin(new.place_ids, old.place_ids)).sum()),
        places_gone=int((~np.isin(old.place_ids, new.place_ids)).sum()),
        places_relabelled=_relabelled(before, now),
        task_before=old.task if old.task != new.task else "",
    )


def _only_in(one: Index, other: Index, what: What) -> list[Thing]:
    rows = np.flatnonzero(~np.isin(one.ids(what), other.ids(what)))
    return [thing(one, what, int(row)) for row in rows]


def _renamed(before: Index, now: Index, what: What) -> list[Renamed]:
    _, old_rows, new_rows = np.intersect1d(before.ids(what), now.ids(what), assume_unique=True, return_indices=True)
    pairs = zip(old_rows.tolist(), new_rows.tolist(), strict=True)
    return [
        Renamed(thing=thing(now, what, new), former_label=_label(before, what, old))
        for old, new in pairs
        if _label(before, what, old) != _label(now, what, new)
    ]


def _label(index: Index, what: What, row: int) -> str:
    return index.regions[row].label if what == "region" else index.objects[row].label


def _relabelled(before: Index, now: Index) -> int:
    """Places in both scenes whose regions have other labels."""
    _, old_rows, new_rows = np.intersect1d(
        before.ids("place"), now.ids("place"), assume_unique=True, return_indices=True
    )
    codes = {name: code for code, name in enumerate({*before.labels("region"), *now.labels("region")})}
    return int((_codes(before, codes)[old_rows] != _codes(now, codes)[new_rows]).sum())


def _codes(index: Index, codes: dict[str, int]) -> np.ndarray:
    """Of each place (place,), the code of its region's label; -1 = none."""
    return np.array([*(codes.get(region.label, -1) for region in index.regions), -1], np.int64)[index.region_rows]

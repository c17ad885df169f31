"""By label: what carries it, what is spelled alike, what stands where (pure)."""

import difflib

import numpy as np

from prior_sg.schemas.answers import Things, What
from prior_sg.schemas.names import same
from prior_sg.schemas.queries import ByLabel, ObjectsInRegions
from prior_sg.schemas.scene import Scene
from prior_sg.services.scene_store.core.queries.index import Index
from prior_sg.services.scene_store.core.queries.things import thing, things

MOST_HINTS, MOST_NAMED, MOST_IDS = 3, 6, 30
ALIKE = 0.5  # of `difflib`, from which a label is worth naming
REGIONS_AND_OBJECTS: tuple[What, ...] = ("region", "object")
PLURAL = {"place": "places", "region": "regions", "object": "objects"}


def kinds(what: What | None) -> tuple[What, ...]:
    """Those that a question is about."""
    return REGIONS_AND_OBJECTS if what is None else (what,)


def by_label(index: Index, question: ByLabel) -> Things:
    """The most probable first."""
    if unknown := nothing_called(index, question.what, question.label):
        return unknown
    found = [
        thing(index, what, int(row)) for what in kinds(question.what) for row in index.labelled(what, question.label)
    ]
    found.sort(key=lambda one: -one.probability)
    return Things(things=found[: question.limit], total=len(found))


def objects_in_regions(index: Index, question: ObjectsInRegions) -> Things:
    """The most probable first; an object is in the region that holds it."""
    asked: dict[What, str] = {"object": question.object_label, "region": question.region_label}
    for what, label in asked.items():
        if label and (unknown := nothing_called(index, what, label)):
            return unknown
    rows = chosen_rows(index, "object", question.object_label)
    if question.region_label:
        regions = [index.regions[row] for row in index.labelled("region", question.region_label)]
        held = np.array([number for region in regions for number in region.object_ids], np.int64)
        rows = rows[np.isin(index.ids("object")[rows], held)]
    found = things(index, "object", rows)
    found.sort(key=lambda one: -one.probability)
    return Things(things=found[: question.limit], total=len(found))


def nothing_called(index: Index, what: What | None, label: str) -> Things | None:
    """An answer with what is spelled alike, where nothing carries the label; None where something does."""
    if any(index.is_labelled(kind, label) for kind in kinds(what)):
        return None
    known = sorted({one for kind in kinds(what) for one in index.labels(kind)})
    hints = nearest_labels(label, known)
    named = " or ".join(kinds(what)) if what != "place" else "region"
    if not known:
        reason = f"no {named} has a label yet" + ("" if index.scene.task else f": {after_a_task(index.scene)}")
    else:
        shown = ", ".join(hints or known[:MOST_NAMED])
        if not hints and len(known) > MOST_NAMED:
            shown += f" and {len(known) - MOST_NAMED} others"
        reason = f"no {named} is labelled {label!r}; {'the nearest labels are' if hints else 'there are'}: {shown}"
    return Things(nearest_labels=hints, reason=reason)


def not_there(index: Index, what: What, number: int) -> str:
    """That there is no such id, and which there are, in one sentence."""
    ids = index.ids(what).tolist()
    if not ids:
        held = f"no {PLURAL[what]}" + (
            "" if what == "place" or index.scene.task else f" yet: {after_a_task(index.scene)}"
        )
    elif len(ids) <= MOST_IDS:
        held = f"{PLURAL[what]} {', '.join(map(str, ids))}"
    else:
        held = f"{len(ids)} {PLURAL[what]} with ids from {ids[0]} to {ids[-1]}"
    return f"there is no {what} {number}; the scene has {held}"


def after_a_task(scene: Scene) -> str:
    """What regions and names wait for."""
    if scene.merged_of:
        return f"regions and names follow the tasks of {', '.join(scene.merged_of)}, and none of them was given any"
    return "regions and names follow a task, and none was given"


def nearest_labels(label: str, known: list[str]) -> list[str]:
    """Of the known labels, those spelled most alike, the most alike first."""
    folded = {same(one): one for one in reversed(known)}
    return [folded[one] for one in difflib.get_close_matches(same(label), list(folded), MOST_HINTS, ALIKE)]


def chosen_rows(index: Index, what: What, label: str) -> np.ndarray:
    """Rows (n,) of a kind, all of them without a label."""
    return index.labelled(what, label) if label else np.arange(len(index.ids(what)))

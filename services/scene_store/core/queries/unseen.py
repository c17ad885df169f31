"""What has not been seen: where a region of a label may be, the way there, and what is missing (pure)."""

import numpy as np

from prior_sg.schemas.answers import Missing, Outlook, Prospect
from prior_sg.schemas.foresight import ForeseenLabel, Foresight, Opening
from prior_sg.schemas.members import only_of_robots
from prior_sg.schemas.names import same
from prior_sg.schemas.queries import RouteBetween, Spot, WhatIsMissing, WhereToLook
from prior_sg.schemas.scene import Scene
from prior_sg.services.exploring import chances_per_metre, expected_metres
from prior_sg.services.scene_store.core.queries.index import Index
from prior_sg.services.scene_store.core.queries.labels import after_a_task, nearest_labels
from prior_sg.services.scene_store.core.queries.routes import NoSuchSpot, lengths_from, route
from prior_sg.services.scene_store.core.queries.things import things

DIGITS = 2


def outlook(index: Index, question: WhereToLook) -> Outlook:
    """Openings behind which a region of the label may be, the best to begin with first, and the way to the first."""
    if not foretold(index.scene):
        return Outlook(label=question.label, reason=_of_robots(index.scene))
    foresight, label = index.scene.foresight, _known(index, question.label)
    if not label:
        return Outlook(label=question.label, reason=_unknown(index, question.label))
    seen = things(index, "region", index.labelled("region", label))
    placed = [(opening, index.row("place", opening.place_id)) for opening in foresight.openings]
    held, rows = [one for one, row in placed if row is not None], [row for _, row in placed if row is not None]
    if not held:
        return Outlook(label=label, found=seen, reason="nothing is known to be open: no opening to unobserved space")
    try:
        lengths_m = lengths_from(index, question.start, question.clearance_m)
    except NoSuchSpot as error:
        return Outlook(label=label, found=seen, reason=str(error))
    ways_m = lengths_m[rows]
    prospects, total = _prospects(foresight, held, label, ways_m, index.points_m[rows], limit=question.limit)
    missing = {entry.label: entry.probability for entry in foresight.missing}
    if not prospects:
        reason = f"no way leads to any opening behind which {label!r} is at all likely"
        return Outlook(label=label, probability=missing.get(label, 0.0), found=seen, reason=reason)
    goal = Spot(what="place", id=prospects[0].opening.place_id)
    way = route(index, RouteBetween(start=question.start, goal=goal, clearance_m=question.clearance_m))
    return Outlook(
        label=label,
        prospects=prospects,
        probability=missing.get(label, 0.0),
        route=way,
        found=seen,
        total=total,
        look_m=foresight.look_m,
    )


def missing(index: Index, question: WhatIsMissing) -> Missing:
    """What is probably behind the openings."""
    if not foretold(index.scene):
        return Missing(reason=_of_robots(index.scene))
    foresight = index.scene.foresight
    reason = "" if foresight.openings or index.scene.task else f"nothing is expected yet: {after_a_task(index.scene)}"
    return Missing(
        labels=foresight.missing[: question.limit],
        openings=len(foresight.openings),
        reason=reason,
        total=len(foresight.missing),
    )


def foretold(scene: Scene) -> bool:
    """Whether anything can be foretold of this map; of a merged one, nothing where its robots follow several tasks."""
    return not scene.merged_of or bool(scene.foresight.openings)


def _of_robots(scene: Scene) -> str:
    what = "what has not been seen, where robots follow several tasks or nothing is open,"
    return only_of_robots(scene.robot, scene.merged_of, what)


def _prospects(
    foresight: Foresight, held: list[Opening], label: str, ways_m: np.ndarray, points_m: np.ndarray, *, limit: int
) -> tuple[list[Prospect], int]:
    """The best of them, and how many there are: only of those that are told a whole search is thought through."""
    entries = [_entry(opening, label) for opening in held]
    chances = np.array([entry.within if entry else 0.0 for entry in entries])
    toward = np.array([entry.toward if entry else 0.0 for entry in entries])
    likely = np.flatnonzero(((chances > 0) | (toward > 0)) & np.isfinite(ways_m))
    ways_m, points_m, chances, toward = ways_m[likely], points_m[likely], chances[likely], toward[likely]
    worth = chances_per_metre(ways_m, toward if toward.any() else chances, foresight.look_m)
    best = np.argsort(-worth, kind="stable")[:limit]
    metres = expected_metres(ways_m, points_m, chances, foresight.look_m, foresight.elsewhere_m, firsts=best)
    prospects = [
        Prospect(
            opening=held[likely[at]],
            probability=float(chances[at]),
            expected_m=round(float(metre), DIGITS),
            way_m=round(float(ways_m[at]), DIGITS),
            toward=float(toward[at]),
            per_metre=float(worth[at]),
        )
        for at, metre in zip(best.tolist(), metres, strict=True)
    ]
    return prospects, len(likely)


def _entry(opening: Opening, label: str) -> ForeseenLabel | None:
    return next((entry for entry in opening.labels if entry.label == label), None)


def _known(index: Index, label: str) -> str:
    """The prior's label of that name, whatever its case; empty = it has none."""
    return next((one for one in index.scene.labels if same(one) == same(label)), "")


def _unknown(index: Index, label: str) -> str:
    if not index.scene.labels:
        return f"no region is expected yet: {after_a_task(index.scene)}"
    near = nearest_labels(label, index.scene.labels)
    return f"the task knows no region {label!r}; it knows {', '.join(near or index.scene.labels)}"

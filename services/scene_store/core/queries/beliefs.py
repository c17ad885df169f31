"""One thing in full, its neighbours, and what a region may be (pure)."""

from collections import Counter

import numpy as np

from prior_sg.schemas.answers import Details, LabelBelief, Neighbour, Neighbourhood, PlaceDetails, RegionBeliefs, Words
from prior_sg.schemas.queries import BeliefsOf, ById, NeighboursOf
from prior_sg.services.scene_store.core.queries.index import Index
from prior_sg.services.scene_store.core.queries.labels import not_there
from prior_sg.services.scene_store.core.queries.things import thing

LEAST_BELIEF = 0.01


def details(index: Index, question: ById) -> Details:
    """One thing in full."""
    row = index.row(question.what, question.id)
    if row is None:
        return Details(reason=not_there(index, question.what, question.id))
    return Details(
        thing=thing(index, question.what, row),
        place=_place(index, row) if question.what == "place" else None,
        region=index.regions[row] if question.what == "region" else None,
        object=index.objects[row] if question.what == "object" else None,
    )


def neighbourhood(index: Index, question: NeighboursOf) -> Neighbourhood:
    """Over edges, over borders, or the region around an object."""
    row = index.row(question.what, question.id)
    if row is None:
        return Neighbourhood(reason=not_there(index, question.what, question.id))
    found = {"place": _over_edges, "region": _over_borders, "object": _around}[question.what](index, row)
    return Neighbourhood(neighbours=sorted(found, key=lambda one: one.thing.id))


def region_beliefs(index: Index, question: BeliefsOf) -> RegionBeliefs:
    """The mean over its places."""
    row = index.row("region", question.region)
    if row is None:
        return RegionBeliefs(reason=not_there(index, "region", question.region))
    rows = index.members(row)
    if not len(rows):
        return RegionBeliefs(thing=thing(index, "region", row), unknown=1.0)
    return RegionBeliefs(
        thing=thing(index, "region", row),
        beliefs=_told(index, index.scene.posteriors[rows].astype(np.float64).mean(axis=0), question.limit, 0.0),
        unknown=float(index.scene.unknown[rows].astype(np.float64).mean()),
        predicted_share=float(index.predicted[rows].mean()),
        places=len(rows),
        total=len(index.scene.labels),
    )


def words(index: Index) -> Words:
    """The vocabulary."""
    scene = index.scene
    return Words(
        environment=scene.environment,
        task=scene.task,
        space=scene.space,
        prior_digest=scene.prior_digest,
        labels=list(scene.labels),
        regions=dict(sorted(Counter(region.label for region in scene.regions).items())),
        objects=dict(sorted(Counter(item.label for item in scene.objects if item.label).items())),
        merged_of=list(scene.merged_of),
    )


def _place(index: Index, row: int) -> PlaceDetails:
    scene = index.scene
    openings = dict(zip(scene.frontier_ids.tolist(), scene.frontier_areas_m2.tolist(), strict=True))
    return PlaceDetails(
        radius_m=float(scene.radii_m[row]),
        beliefs=_told(index, scene.posteriors[row].astype(np.float64), len(scene.labels), LEAST_BELIEF),
        unknown=float(scene.unknown[row]),
        frontier_m2=openings.get(int(scene.place_ids[row]), 0.0),
    )


def _told(index: Index, probabilities: np.ndarray, limit: int, least: float) -> list[LabelBelief]:
    """Labels (label,) with their probabilities, the most probable first."""
    order = np.argsort(-probabilities, kind="stable")[:limit]
    return [
        LabelBelief(label=index.scene.labels[column], probability=float(probabilities[column]))
        for column in order.tolist()
        if probabilities[column] >= least
    ]


def _over_edges(index: Index, row: int) -> list[Neighbour]:
    rows, lengths_m = index.edges
    return [
        Neighbour(
            thing=thing(index, "place", int(rows[edge].sum() - row)),
            clearance_m=float(index.scene.clearances_m[edge]),
            length_m=float(lengths_m[edge]),
        )
        for edge in index.edges_of(row)
    ]


def _over_borders(index: Index, row: int) -> list[Neighbour]:
    region = index.regions[row]
    found = []
    for number in region.neighbour_ids:
        other = index.row("region", number)
        if other is not None:
            ways = [way for way in region.transitions if way.region == number]
            widest_m = max((way.clearance_m for way in ways), default=0.0)
            found.append(Neighbour(thing=thing(index, "region", other), clearance_m=widest_m, ways=ways))
    return found


def _around(index: Index, row: int) -> list[Neighbour]:
    holder = int(index.object_regions[row])
    return [Neighbour(thing=thing(index, "region", holder), clearance_m=0.0)] if holder >= 0 else []

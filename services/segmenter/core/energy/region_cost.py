"""Regions that must pay for themselves (beyond the paper; pure).

The energy counts places and edges, not regions: where looks waver, a few places here and there are cheaper under a
label of their own, and a map of five rooms falls into twenty regions. A description of the map names every region, so
each costs `cost` (minimum description length after Rissanen, 1978; label costs after Delong et al., 2012, per region
instead of per label): a region takes the label of a neighbour, and becomes part of it, where that raises the energy by
less.
"""

import numpy as np

from prior_sg.services.compiled import compiled
from prior_sg.services.segmenter.core.energy.mrf import Field
from prior_sg.services.segmenter.core.regions.components import numbered


def consolidated(field: Field, labels: np.ndarray, cost: float, changed: np.ndarray | None = None) -> np.ndarray:
    """Labels (place,) in which no region gains less than `cost` by its own label against its best neighbour's.

    Regions are taken by what they gain, least first, and never two that touch in one pass. A pass weighs those that
    were relabelled by the one before, and their neighbours: the others have been found to pay for themselves. So does
    the first with `changed` (place,): where costs, edges or labels are others than at the last call, and where that
    gave a region away; None = anywhere.
    """
    labels = labels.copy()
    if cost <= 0 or not len(field.edges):
        return labels
    relabelled = np.ones(len(labels), dtype=bool) if changed is None else changed
    while relabelled.any():
        before = labels.copy()
        _pass(labels, numbered(labels, field.edges), relabelled, *field, cost)
        relabelled = labels != before
    return labels


@compiled()
def _pass(labels, region_of, relabelled, unary, edges, weights, pairwise, cost):  # noqa: ANN001, ANN202, PLR0917
    """Weigh the regions that hold a relabelled place or touch one that does, and relabel some of them."""
    regions, count = region_of.max() + 1, unary.shape[1]
    label_of = np.zeros(regions, np.int64)
    renewed, weighed = np.zeros(regions, np.bool_), np.zeros(regions, np.bool_)
    for place in range(len(labels)):
        label_of[region_of[place]] = labels[place]
        if relabelled[place]:
            renewed[region_of[place]] = weighed[region_of[place]] = True
    for edge in range(len(edges)):
        one, other = region_of[edges[edge, 0]], region_of[edges[edge, 1]]
        if renewed[one] or renewed[other]:
            weighed[one] = weighed[other] = True
    costs = np.zeros((regions, count))  # of the region under each label while all others keep theirs
    for place in range(len(labels)):
        region = region_of[place]
        if weighed[region]:
            for label in range(count):
                costs[region, label] += unary[place, label]
    beside = np.zeros((regions, count), np.bool_)
    starts = np.zeros(regions + 1, np.int64)
    for edge in range(len(edges)):
        one, other = region_of[edges[edge, 0]], region_of[edges[edge, 1]]
        if one == other or not (weighed[one] or weighed[other]):
            continue
        for here, there in ((one, other), (other, one)):
            beside[here, label_of[there]] = True
            starts[here + 1] += 1
            for label in range(count):
                costs[here, label] += weights[edge] * pairwise[label, label_of[there]]
    for region in range(regions):
        starts[region + 1] += starts[region]
    neighbours, fill = np.empty(starts[-1], np.int64), starts[:-1].copy()
    for edge in range(len(edges)):
        one, other = region_of[edges[edge, 0]], region_of[edges[edge, 1]]
        if one != other and (weighed[one] or weighed[other]):
            neighbours[fill[one]], neighbours[fill[other]] = other, one
            fill[one] += 1
            fill[other] += 1
    gains, best = np.full(regions, np.inf), np.zeros(regions, np.int64)
    for region in range(regions):
        for label in range(count):
            gain = costs[region, label] - costs[region, label_of[region]]
            if weighed[region] and beside[region, label] and gain < gains[region]:
                gains[region], best[region] = gain, label
    settled, given = np.zeros(regions, np.bool_), label_of.copy()
    for region in np.argsort(gains, kind="mergesort"):
        if gains[region] >= cost:
            break
        free = not settled[region]
        for at in range(starts[region], starts[region + 1]):
            free = free and given[neighbours[at]] == label_of[neighbours[at]]
        if free:
            given[region] = best[region]
            for at in range(starts[region], starts[region + 1]):
                settled[neighbours[at]] = True
    for place in range(len(labels)):
        labels[place] = given[region_of[place]]

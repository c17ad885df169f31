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
from prior_sg.services.segmenter.core.map.arcs import Arcs, arcs_of, spread


def consolidated(
    field: Field, labels: np.ndarray, cost: float, changed: np.ndarray | None = None, ties: Arcs | None = None
) -> np.ndarray:
    """Labels (place,) in which no region gains less than `cost` by its own label against its best neighbour's.

    Regions are taken by what they gain, least first, and never two that touch in one pass. A pass weighs those that
    were relabelled by the one before, and their neighbours: the others have been found to pay for themselves. So does
    the first with `changed` (place,): where costs, edges or labels are others than at the last call, and where that
    gave a region away; None = anywhere. `ties` are the field's edges as arcs, where the caller has them.
    """
    labels = labels.copy()
    if cost <= 0 or not len(field.edges):
        return labels
    near = arcs_of(len(labels), field.edges, field.weights) if ties is None else ties
    region_of = np.full(len(labels), -1)
    rows = np.arange(len(labels)) if changed is None else np.flatnonzero(changed)
    while len(rows):
        rows = _pass(labels, rows, near, region_of, *field, cost)
    return labels


@compiled()
def _pass(labels, rows, near, region_of, unary, edges, weights, pairwise, cost):  # noqa: ANN001, ANN202, PLR0917
    """Weigh the regions that hold any of the places `rows` or touch one that does, and relabel some of them; returns
    the places (n,) relabelled. `region_of` (place,) is scratch, all -1 before and after.

    Sums run over places and edges in the order of their rows, and regions are numbered by their first places: what a
    region costs does not depend on which others are weighed.
    """
    places = _weighed(labels, rows, near, region_of)
    regions, count = _renumbered(places, region_of), unary.shape[1]
    label_of = np.zeros(regions, np.int64)
    costs = np.zeros((regions, count))  # of the region under each label while all others keep theirs
    for place in places:
        label_of[region_of[place]] = labels[place]
        for label in range(count):
            costs[region_of[place], label] += unary[place, label]
    borders = _borders(labels, places, near)
    beside = np.zeros((regions, count), np.bool_)
    starts = np.zeros(regions + 1, np.int64)
    for edge in borders:
        for side in range(2):
            here, there = region_of[edges[edge, side]], edges[edge, 1 - side]
            if here < 0:
                continue
            beside[here, labels[there]] = True
            starts[here + 1] += 1
            for label in range(count):
                costs[here, label] += weights[edge] * pairwise[label, labels[there]]
    for region in range(regions):
        starts[region + 1] += starts[region]
    neighbours, fill = np.empty(starts[-1], np.int64), starts[:-1].copy()  # a region, -1 = one that keeps its label
    for edge in borders:
        for side in range(2):
            here = region_of[edges[edge, side]]
            if here >= 0:
                neighbours[fill[here]] = region_of[edges[edge, 1 - side]]
                fill[here] += 1
    gains, best = np.full(regions, np.inf), np.zeros(regions, np.int64)
    for region in range(regions):
        for label in range(count):
            gain = costs[region, label] - costs[region, label_of[region]]
            if beside[region, label] and gain < gains[region]:
                gains[region], best[region] = gain, label
    settled, given = np.zeros(regions, np.bool_), label_of.copy()
    for region in np.argsort(gains, kind="mergesort"):
        if gains[region] >= cost:
            break
        free = not settled[region]
        for other in neighbours[starts[region] : starts[region + 1]]:
            free = free and (other < 0 or given[other] == label_of[other])
        if free:
            given[region] = best[region]
            for other in neighbours[starts[region] : starts[region + 1]]:
                if other >= 0:
                    settled[other] = True
    relabelled, found = np.empty(len(places), np.int64), 0
    for place in places:
        if given[region_of[place]] != labels[place]:
            labels[place] = given[region_of[place]]
            relabelled[found] = place
            found += 1
        region_of[place] = -1
    return relabelled[:found].copy()


@compiled()
def _weighed(labels, rows, near, region_of):  # noqa: ANN001, ANN202
    """Places (n,), ascending, of the regions that hold any of `rows` or touch one that does, with numbers."""
    members, count = np.empty(len(labels), np.int64), 0
    for row in rows:
        count = spread(row, labels, near, region_of, members, count)
    for index in range(count):
        place = members[index]
        for arc in range(near.starts[place], near.starts[place + 1]):
            count = spread(near.neighbours[arc], labels, near, region_of, members, count)
    return np.sort(members[:count])


@compiled()
def _renumbered(places, region_of):  # noqa: ANN001, ANN202
    """How many regions the ascending `places` are in; afterwards their numbers count from 0 in this order."""
    number_of, regions = np.full(len(places), -1), 0
    for place in places:
        if number_of[region_of[place]] < 0:
            number_of[region_of[place]] = regions
            regions += 1
        region_of[place] = number_of[region_of[place]]
    return regions


@compiled()
def _borders(labels, places, near):  # noqa: ANN001, ANN202
    """Numbers (n,), ascending, of the edges from `places` to places of other labels, each once."""
    found = [np.int64(0) for _ in range(0)]
    for place in places:
        for arc in range(near.starts[place], near.starts[place + 1]):
            if labels[near.neighbours[arc]] != labels[place]:
                found.append(np.int64(near.edges[arc]))
    crossing, count = np.sort(np.array(found, np.int64)), 0
    for edge in crossing:
        if not count or edge != crossing[count - 1]:
            crossing[count] = edge
            count += 1
    return crossing[:count]

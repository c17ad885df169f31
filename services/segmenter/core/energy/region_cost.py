"""Regions that must pay for themselves (beyond the paper; pure).

The energy counts places and edges, not regions: where looks waver, a few places here and there are cheaper under a
label of their own, and a map of five rooms falls into twenty regions. A description of the map names every region, so
each costs `cost` (minimum description length after Rissanen, 1978; label costs after Delong et al., 2012, per region
instead of per label): a region takes the label of a neighbour, and becomes part of it, where that raises the energy by
less.
"""

from collections.abc import Sequence

import numpy as np

from prior_sg.services.compiled import compiled
from prior_sg.services.segmenter.core.energy.mrf import Field
from prior_sg.services.segmenter.core.map.arcs import Arcs, arcs_of, spread

SPARSE = 32  # rows a place of a region, up to which going over them is quicker than sorting
MOST_CHANGED = 0.1  # of the places; with more, to go over former passes again takes longer than to begin anew


def consolidated(field: Field, labels: np.ndarray, cost: float) -> np.ndarray:
    """Labels (place,) in which no region gains less than `cost` by its own label against its best neighbour's.

    Regions are taken by what they gain, least first, and never two that touch in one pass; passes go on until one
    changes nothing.
    """
    return passes(field, labels, cost)[-1]


def passes(
    field: Field,
    labels: np.ndarray,
    cost: float,
    former: Sequence[np.ndarray] = (),
    *,
    changed: np.ndarray | None = None,
    ties: Arcs | None = None,
) -> list[np.ndarray]:
    """Labels (place,) before the first pass of `consolidated` and after each that changed any.

    What a pass makes of a region follows from the region and what it touches. So `former`, what was returned last on
    these rows, is gone over again where a place has other costs, weights or edges now (rows `changed`), or another
    label than it had before the same pass. It is changed in place. `ties` are the field's edges as arcs, where the
    caller has them.
    """
    if cost <= 0 or not len(field.edges):
        return [labels.copy()]
    near = arcs_of(len(labels), field.edges, field.weights) if ties is None else ties
    given = np.arange(len(labels)) if changed is None else changed
    if former and len(given) <= MOST_CHANGED * len(labels):
        rows = np.union1d(given, np.flatnonzero(labels != former[0]))
    else:
        rows, former = np.arange(len(labels)), ()
    after, region_of = [labels.copy(), *former[1:]], np.full(len(labels), -1)
    for number in range(1, len(after)):
        differs = _pass(after[number - 1], rows, near, region_of, field, cost, after[number])
        rows = np.union1d(given, differs)
    while len(rows):  # the last pass changed nothing but there
        after.append(after[-1].copy())
        rows = _pass(after[-2], rows, near, region_of, field, cost, after[-1])
    while len(after) > 1 and np.array_equal(after[-1], after[-2]):
        after.pop()
    return after


@compiled()
def _pass(labels, rows, near, region_of, field, cost, after):  # noqa: ANN001, ANN202, PLR0917
    """Put into `after` what one pass makes of `labels` around the places `rows`; returns the places (n,) where that is
    something else than what was there. `region_of` (place,) is scratch, all -1 before and after.

    Weighed are the regions that hold any of `rows`, those that touch these, and on from these and from whatever gains
    too little, all that it touches: who gives way may keep its neighbour from it.
    """
    starts, neighbours = near.starts, near.neighbours
    members, count = np.empty(len(labels), np.int64), 0  # of region after region; its number is where it begins
    for row in rows:
        count = spread(row, labels, starts, neighbours, region_of, members, count)
    count = _touched(members[:count], labels, starts, neighbours, region_of, members, count)
    certain, begin = count, 0
    gains, best, given = np.empty(len(labels)), np.empty(len(labels), np.int64), np.empty(len(labels), np.int64)
    settled = np.zeros(len(labels), np.bool_)
    poor = [np.int64(0) for _ in range(0)]
    while begin < count:
        end = begin
        while end < count and region_of[members[end]] == begin:
            end += 1
        inside = members[begin:end]
        _sort(inside, begin, region_of)
        given[begin] = labels[inside[0]]
        gains[begin], best[begin] = _gain(inside, labels, near, field)
        if gains[begin] < cost:
            poor.append(np.int64(begin))
        if begin < certain or gains[begin] < cost:
            count = _touched(inside, labels, starts, neighbours, region_of, members, count)
        begin = end
    _give(np.array(poor, np.int64), gains, best, given, settled, members[:count], labels, near, region_of)
    differs, found = np.empty(count, np.int64), 0
    for place in members[:count]:
        if after[place] != given[region_of[place]]:
            after[place] = given[region_of[place]]
            differs[found] = place
            found += 1
        region_of[place] = -1
    return differs[:found].copy()


@compiled()
def _touched(inside, labels, starts, neighbours, region_of, members, count):  # noqa: ANN001, ANN202, PLR0917
    """`spread` from all neighbours of the places `inside`, until every place of the map has a number."""
    for place in inside:
        if count == len(members):
            break
        for arc in range(starts[place], starts[place + 1]):
            if region_of[neighbours[arc]] < 0:  # most have one, and a call costs more than to look
                count = spread(neighbours[arc], labels, starts, neighbours, region_of, members, count)
    return count


@compiled()
def _gain(inside, labels, near, field):  # noqa: ANN001, ANN202
    """What the region of the places `inside` (ascending) gains against its best neighbour's label, and that label.

    Sums run in the order of places and edges: they are the same wherever the search for regions began.
    """
    own, starts, neighbours, numbers = labels[inside[0]], near.starts, near.neighbours, near.edges
    unary, weights, pairwise = field.unary, field.weights, field.pairwise
    costs, beside = np.zeros(unary.shape[1]), np.zeros(unary.shape[1], np.bool_)
    arcs, count = 0, 0
    for place in inside:
        arcs += starts[place + 1] - starts[place]
    across = np.empty(arcs, np.int64)  # number of an edge, times the labels, plus the label beyond it
    for place in inside:
        for label in range(len(costs)):
            costs[label] += unary[place, label]
        for arc in range(starts[place], starts[place + 1]):
            if labels[neighbours[arc]] != own:
                across[count] = np.int64(numbers[arc]) * len(costs) + labels[neighbours[arc]]
                count += 1
    across = across[:count]
    across.sort()
    for key in across:
        edge, other = key // len(costs), key % len(costs)
        beside[other] = True
        for label in range(len(costs)):
            costs[label] += weights[edge] * pairwise[label, other]
    gain, best = np.inf, own
    for label in range(len(costs)):
        if beside[label] and costs[label] - costs[own] < gain:
            gain, best = costs[label] - costs[own], label
    return gain, best


@compiled()
def _give(poor, gains, best, given, settled, members, labels, near, region_of):  # noqa: ANN001, ANN202, PLR0917
    """Give away the regions `poor`, least gain first and of equals that with the first place, none beside another."""
    starts, neighbours = near.starts, near.neighbours
    order = poor[np.argsort(members[poor])]
    for region in order[np.argsort(gains[order], kind="mergesort")]:
        free, index = not settled[region], region
        while index < len(members) and region_of[members[index]] == region:
            for arc in range(starts[members[index]], starts[members[index] + 1]):
                other = neighbours[arc]
                free = free and (region_of[other] == region or given[region_of[other]] == labels[other])
            index += 1
        if not free:
            continue
        given[region] = best[region]
        for place in members[region:index]:
            for arc in range(starts[place], starts[place + 1]):
                settled[region_of[neighbours[arc]]] = True


@compiled()
def _sort(inside, number, region_of):  # noqa: ANN001, ANN202
    """Put the places `inside`, which are those of this number, in ascending order."""
    low, high = inside[0], inside[0]
    for place in inside:
        low, high = min(low, place), max(high, place)
    if high - low > SPARSE * len(inside):
        inside.sort()
        return
    count = 0
    for place in range(low, high + 1):
        if region_of[place] == number:
            inside[count] = place
            count += 1

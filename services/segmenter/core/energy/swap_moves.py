"""Compiled alpha-beta-swaps, solved only where something changed (pure).

The swap of one pair of labels falls apart. Let place p have label alpha or beta, D(p) be what beta costs it more than
alpha against its neighbours of third labels, and S(p) the sum of w V(alpha, beta) over its neighbours with alpha or
beta. If D(p) >= S(p), alpha is best for p whatever those neighbours take; if D(p) <= -S(p), beta is. Such a place is
*forced*: it takes its label at no loss, and for its neighbours becomes one with a fixed label, which may force them in
turn. What stays free are connected *cores*, each a minimum cut of its own; beyond a place that is forced to keep its
label, nothing is different.

A change of label, cost or edge can open a better swap only in a core that holds a place whose costs changed: any better
swap is a sum of its connected parts, and a part without such a place was already tried. So each place carries one flag
per label, `pending`: whether the swap of its own label with that one is still to be tried there. When no flag is left,
no alpha-beta-swap lowers the energy. Work is thereby proportional to the change, not to the field.

A core may still span a whole region. Tried NEAR, it ends after a given number of places, beyond which labels stay as
they are; such a swap is exact for that local problem, and its flags become those of swaps to be tried DEEP.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from prior_sg.services.compiled import compiled
from prior_sg.services.segmenter.core.map.arcs import Arcs

UNSEEN, LISTED, FREE, TAKES_ALPHA, TAKES_BETA = 0, 1, 2, 3, 4
NOT_PENDING, NEAR, DEEP = 0, 1, 2  # a swap's flag; NEAR and DEEP less one are also the numbers of their queues
PLACE, BETA, SEEN, FREE_COUNT, CAPPED = range(5)  # entries of Work.core
HEAD, COUNT = 0, 1  # columns of Work.rings
SETTLED, SPENT, CUT = 0, 1, 2  # what `settle` says


class Work(NamedTuple):
    """Flags and scratch space; `pending`, `queues`, `queued` and `rings` hold state between calls."""

    pending: np.ndarray  # (place, label) uint8: NOT_PENDING, NEAR or DEEP
    queues: np.ndarray  # (2, place) int32 rings of places with a NEAR flag and with a DEEP one, first come first served
    queued: np.ndarray  # (2, place) uint8
    rings: np.ndarray  # (2, 2) int64 start and length of each ring
    core: np.ndarray  # (5,) int64 the core in hand: its first place and other label, sizes, whether it was ended
    mark: np.ndarray  # (place,) int8 UNSEEN, LISTED, FREE, TAKES_ALPHA or TAKES_BETA
    seen: np.ndarray  # (place,) int32 the places of the core in hand
    lean: np.ndarray  # (place,) D
    hold: np.ndarray  # (place,) S
    stack: np.ndarray  # (place + arc,) int32
    level: np.ndarray  # (place,) int32 distance to the sink
    arc: np.ndarray  # (place,) int64 next arc to try
    capacity: np.ndarray  # (arc,)


def empty_work(places: int, labels: int, arcs: int) -> Work:
    """Nothing pending."""
    return Work(
        pending=np.zeros((places, labels), np.uint8),
        queues=np.zeros((2, places), np.int32),
        queued=np.zeros((2, places), np.uint8),
        rings=np.zeros((2, 2), np.int64),
        core=np.zeros(5, np.int64),
        mark=np.zeros(places, np.int8),
        seen=np.empty(places, np.int32),
        lean=np.empty(places),
        hold=np.empty(places),
        stack=np.empty(places + arcs, np.int32),
        level=np.empty(places, np.int32),
        arc=np.empty(places, np.int64),
        capacity=np.empty(arcs),
    )


Cut = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], np.ndarray]  # as maxflow.binary_minimum


class Limits(NamedTuple):
    """How far one call goes."""

    depth: int  # NEAR: swaps with that flag only, in cores of at most `near` places; DEEP: all, in whole cores
    near: int  # places
    compiled_up_to: int  # free places of a core that compiled code cuts; larger ones go to the library
    units: int  # visits of places, about
    least_gain: float  # of energy


def run_swaps(  # noqa: PLR0917
    graph: Arcs,
    unary: np.ndarray,
    pairwise: np.ndarray,
    labels: np.ndarray,
    work: Work,
    cut: Cut,
    limits: Limits,
) -> None:
    """Try pending swaps and change `labels` (place,) int64 in place, until none is pending or the units are spent."""
    arrays = (graph, unary, pairwise, labels, work)
    units = limits.units
    while settle(*arrays, limits._replace(units=units)) == CUT:
        free, cost_alpha, cost_beta, edges, weights = core_in_hand(*arrays)
        work.mark[free] = np.where(cut(cost_alpha, cost_beta, edges, weights), TAKES_BETA, TAKES_ALPHA)
        units -= int(work.core[SEEN])
        commit(*arrays, limits)


def waiting(work: Work, depth: int) -> int:
    """Places with swaps to be tried, NEAR only or at any depth."""
    return int(work.rings[:depth, COUNT].sum())


@compiled()
def flag(place, depth, work):  # noqa: ANN001, ANN201
    """All swaps of this place's label are to be tried."""
    work.pending[place, :] = depth
    enqueue(place, depth - 1, work.queues, work.queued, work.rings)


@compiled()
def enqueue(place, ring, queues, queued, rings):  # noqa: ANN001, ANN201
    """Put the place at the end of the ring unless it is there."""
    if queued[ring, place] == 0:
        queued[ring, place] = 1
        end = rings[ring, HEAD] + rings[ring, COUNT]
        queues[ring, end % queues.shape[1]] = place
        rings[ring, COUNT] += 1


@compiled()
def flag_all(places, depth, work):  # noqa: ANN001, ANN201
    """`flag` for each of `places`."""
    for place in places:
        flag(place, depth, work)


@compiled()
def flag_around(places, depth, graph, work):  # noqa: ANN001, ANN201
    """`flag` for each of `places` and its neighbours: what to do after its label was changed from outside."""
    for place in places:
        flag(place, depth, work)
        for arc in range(graph.starts[place], graph.starts[place + 1]):
            flag(graph.neighbours[arc], depth, work)


@compiled()
def requeue(work):  # noqa: ANN001, ANN201
    """Fill the queues from the flags, in order of the rows."""
    for place in range(len(work.pending)):
        for label in range(work.pending.shape[1]):
            if work.pending[place, label] != NOT_PENDING:
                enqueue(place, work.pending[place, label] - 1, work.queues, work.queued, work.rings)


@compiled()
def sort_queues(work):  # noqa: ANN001, ANN201
    """Put the queues in the order of the rows, as `requeue` does: no place has a flag and is in no queue."""
    queues, queued, rings = work.queues, work.queued, work.rings
    places = np.empty(rings[0, COUNT] + rings[1, COUNT], np.int64)
    count = 0
    for ring in range(2):
        for step in range(rings[ring, COUNT]):
            place = queues[ring, (rings[ring, HEAD] + step) % queues.shape[1]]
            queued[ring, place] = 0
            places[count] = place
            count += 1
        rings[ring, HEAD] = rings[ring, COUNT] = 0
    for place in np.sort(places):
        for label in range(work.pending.shape[1]):
            if work.pending[place, label] != NOT_PENDING:
                enqueue(place, work.pending[place, label] - 1, queues, queued, rings)


@compiled()
def settle(graph, unary, pairwise, labels, work, limits):  # noqa: PLR0917, ANN001, ANN201
    """Take places from the queues and try their pending swaps, as `run_swaps` says."""
    core, rings, queues, queued = work.core, work.rings, work.queues, work.queued
    costs = np.empty(unary.shape[1])
    units = limits.units
    while units > 0:
        ring = 0 if rings[0, COUNT] > 0 else 1
        if ring == limits.depth or rings[ring, COUNT] == 0:
            return SETTLED
        place = queues[ring, rings[ring, HEAD]]
        beta = next_pending(place, limits.depth, graph, unary, pairwise, labels, work.pending, costs)
        units -= 1
        if beta < 0:
            queued[ring, place] = 0
            rings[ring, HEAD] = (rings[ring, HEAD] + 1) % queues.shape[1]
            rings[ring, COUNT] -= 1
            continue
        core[PLACE], core[BETA] = place, beta
        explore(graph, unary, pairwise, labels, work, limits.near if limits.depth == NEAR else len(labels))
        if core[FREE_COUNT] > limits.compiled_up_to:
            return CUT
        if core[FREE_COUNT] > 0:
            cut_core(graph, pairwise[labels[place], beta], work)
        units -= core[SEEN]
        commit(graph, unary, pairwise, labels, work, limits)
    return SPENT


@compiled()
def next_pending(place, depth, graph, unary, pairwise, labels, pending, costs):  # noqa: PLR0917, ANN001, ANN201
    """A label to try at `place`, -1 if none; clears the flags of labels that its neighbours force it not to take."""
    alpha = labels[place]
    like = conditional(place, graph.starts, graph.neighbours, graph.weights, unary, pairwise, labels, costs)
    found = -1
    for beta in range(len(costs)):
        if pending[place, beta] == NOT_PENDING:
            continue
        if beta == alpha or costs[beta] - costs[alpha] >= 2.0 * like * pairwise[alpha, beta]:
            pending[place, beta] = NOT_PENDING
        elif found < 0 and pending[place, beta] <= depth:
            found = beta
    return found


@compiled()
def conditional(place, starts, neighbours, weights, unary, pairwise, labels, costs):  # noqa: PLR0917, ANN001, ANN201
    """Fill in `costs` (label,) of each label while the neighbours keep theirs; return the like neighbours' weight."""
    like, own, count = 0.0, labels[place], len(costs)
    for label in range(count):
        costs[label] = unary[place, label]
    for arc in range(starts[place], starts[place + 1]):
        label, weight = labels[neighbours[arc]], weights[arc]
        if label == own:
            like += weight
        for other in range(count):
            costs[other] += weight * pairwise[label, other]
    return like


@compiled()
def explore(graph, unary, pairwise, labels, work, limit):  # noqa: PLR0917, ANN001, ANN201
    """Find the core around the place in hand: its free places, and the forced ones around them, into `seen`.

    It does not grow beyond places that are forced to keep their labels.
    """
    starts, neighbours, weights = graph.starts, graph.neighbours, graph.weights
    mark, lean, hold, seen, stack, core = work.mark, work.lean, work.hold, work.seen, work.stack, work.core
    first, beta = core[PLACE], core[BETA]
    alpha = labels[first]
    cost = pairwise[alpha, beta]
    seen[0], mark[first] = first, LISTED
    index, count, free, capped = 0, 1, 0, 0
    while index < count:
        place = seen[index]
        index += 1
        weigh(place, alpha, beta, starts, neighbours, weights, unary, pairwise, labels, mark, lean, hold)
        mark[place], stack[0] = FREE, place
        free += 1
        depth = 1
        while depth > 0:
            depth -= 1
            node = stack[depth]
            if mark[node] != FREE or not is_forced(node, alpha, labels, mark, lean, hold):
                continue
            free -= 1
            sign = cost if mark[node] == TAKES_ALPHA else -cost
            for arc in range(starts[node], starts[node + 1]):
                neighbour = neighbours[arc]
                if mark[neighbour] == FREE:
                    lean[neighbour] += sign * weights[arc]
                    hold[neighbour] -= cost * weights[arc]
                    stack[depth] = neighbour
                    depth += 1
        if mark[place] == FREE or mark[place] != (TAKES_ALPHA if labels[place] == alpha else TAKES_BETA):
            for arc in range(starts[place], starts[place + 1]):
                neighbour = neighbours[arc]
                if mark[neighbour] == UNSEEN and (labels[neighbour] == alpha or labels[neighbour] == beta):
                    if count >= limit:
                        capped = 1
                        continue
                    mark[neighbour], seen[count] = LISTED, neighbour
                    count += 1
    core[SEEN], core[FREE_COUNT], core[CAPPED] = count, free, capped
    if capped:
        close_off(alpha, beta, cost, graph, labels, work)


@compiled()
def weigh(place, alpha, beta, starts, neighbours, weights, unary, pairwise, labels, mark, lean, hold):  # noqa: PLR0917, ANN001, ANN201
    """D and S of a place, the forced neighbours counted as fixed."""
    cost, total, held = pairwise[alpha, beta], unary[place, beta] - unary[place, alpha], 0.0
    for arc in range(starts[place], starts[place + 1]):
        neighbour, weight = neighbours[arc], weights[arc]
        label = labels[neighbour]
        if label != alpha and label != beta:  # noqa: PLR1714 (compiled to two comparisons)
            total += weight * (pairwise[label, beta] - pairwise[label, alpha])
        elif mark[neighbour] == TAKES_ALPHA:
            total += weight * cost
        elif mark[neighbour] == TAKES_BETA:
            total -= weight * cost
        else:
            held += weight * cost
    lean[place], hold[place] = total, held


@compiled()
def is_forced(place, alpha, labels, mark, lean, hold):  # noqa: PLR0917, ANN001, ANN201
    """Mark a free place that one label suits whatever its free neighbours take; of two equal ones, its own."""
    for_alpha, for_beta = lean[place] >= hold[place], lean[place] <= -hold[place]
    if for_alpha and for_beta:
        for_alpha = labels[place] == alpha
    if for_alpha or for_beta:
        mark[place] = TAKES_ALPHA if for_alpha else TAKES_BETA
    return for_alpha or for_beta


@compiled()
def close_off(alpha, beta, cost, graph, labels, work):  # noqa: PLR0917, ANN001, ANN201
    """In a core that was ended, neighbours beyond the end keep their labels."""
    for index in range(work.core[SEEN]):
        place = work.seen[index]
        if work.mark[place] != FREE:
            continue
        for arc in range(graph.starts[place], graph.starts[place + 1]):
            neighbour = graph.neighbours[arc]
            if work.mark[neighbour] == UNSEEN:
                if labels[neighbour] == alpha:
                    work.lean[place] += cost * graph.weights[arc]
                elif labels[neighbour] == beta:
                    work.lean[place] -= cost * graph.weights[arc]


@compiled()
def commit(graph, unary, pairwise, labels, work, limits):  # noqa: PLR0917, ANN001, ANN201
    """Relabel the core in hand as marked if that gains more than the least, then update flags and clear marks."""
    core, seen, stack, mark, pending = work.core, work.seen, work.stack, work.mark, work.pending
    starts, neighbours, weights = graph.starts, graph.neighbours, graph.weights
    alpha, beta = labels[core[PLACE]], core[BETA]
    costs = np.empty(unary.shape[1])
    changed, gain = 0, 0.0
    for index in range(core[SEEN]):
        place = seen[index]
        wanted = alpha if mark[place] == TAKES_ALPHA else beta
        mark[place] = UNSEEN
        tried(place, alpha if labels[place] == beta else beta, core[CAPPED], work)
        if wanted != labels[place]:
            conditional(place, starts, neighbours, weights, unary, pairwise, labels, costs)
            gain += costs[labels[place]] - costs[wanted]
            pending[place, labels[place]] = pending[place, wanted]
            labels[place] = wanted
            stack[changed] = place
            changed += 1
    if gain <= limits.least_gain:
        for index in range(changed):
            labels[stack[index]] = alpha if labels[stack[index]] == beta else beta
        return
    for index in range(changed):
        place = stack[index]
        flag_after(place, alpha, beta, labels, work)
        for arc in range(starts[place], starts[place + 1]):
            flag_after(neighbours[arc], alpha, beta, labels, work)


@compiled()
def flag_after(place, alpha, beta, labels, work):  # noqa: ANN001, ANN201
    """Flag a place after a swap of alpha and beta nearby; that swap need not be tried again, unless it was ended."""
    kept_alpha, kept_beta = work.pending[place, alpha], work.pending[place, beta]
    flag(place, NEAR, work)
    in_pair = labels[place] == alpha or labels[place] == beta
    if in_pair and work.core[CAPPED] == 0:
        work.pending[place, alpha], work.pending[place, beta] = kept_alpha, kept_beta


@compiled()
def tried(place, label, capped, work):  # noqa: ANN001, ANN201
    """Note that the swap with `label` was tried at `place`: it is done with, or still to be tried DEEP."""
    if capped == 0:
        work.pending[place, label] = NOT_PENDING
    elif work.pending[place, label] == NEAR:
        work.pending[place, label] = DEEP
        enqueue(place, DEEP - 1, work.queues, work.queued, work.rings)


@compiled()
def cut_core(graph, cost, work):  # noqa: ANN001, ANN201
    """Decide the free places by a maximum flow (Dinic, 1970) on the arcs of the graph itself; nothing is copied.

    A place with D > 0 is fed by the source, one with D < 0 drained to the sink; those that can still reach the sink at
    the end take beta.
    """
    starts, neighbours, weights, twins = graph.starts, graph.neighbours, graph.weights, graph.twins
    mark, lean, level, stack = work.mark, work.lean, work.level, work.stack
    next_arc, capacity = work.arc, work.capacity
    seen = work.seen[: work.core[SEEN]]
    for place in seen:
        if mark[place] == FREE:
            for arc in range(starts[place], starts[place + 1]):
                capacity[arc] = weights[arc] * cost
    while rank(seen, starts, neighbours, twins, mark, lean, level, stack, capacity):
        for place in seen:
            next_arc[place] = starts[place]
        for place in seen:
            if mark[place] == FREE and lean[place] > 0 and level[place] >= 0:
                push(place, starts, neighbours, twins, mark, lean, level, stack, next_arc, capacity)
    for place in seen:
        if mark[place] == FREE:
            mark[place] = TAKES_BETA if level[place] >= 0 else TAKES_ALPHA


@compiled()
def rank(seen, starts, neighbours, twins, mark, lean, level, stack, capacity):  # noqa: PLR0917, ANN001, ANN201
    """Distance of each free place to the sink over arcs with capacity left, -1 = none; True if a fed place has one."""
    count, fed = 0, False
    for place in seen:
        level[place] = -1
        if mark[place] == FREE and lean[place] < 0:
            level[place] = 0
            stack[count] = place
            count += 1
    index = 0
    while index < count:
        place = stack[index]
        index += 1
        for arc in range(starts[place], starts[place + 1]):
            neighbour = neighbours[arc]
            if mark[neighbour] == FREE and level[neighbour] < 0 and capacity[twins[arc]] > 0:
                level[neighbour] = level[place] + 1
                fed |= lean[neighbour] > 0
                stack[count] = neighbour
                count += 1
    return fed


@compiled()
def push(source, starts, neighbours, twins, mark, lean, level, path, next_arc, capacity):  # noqa: PLR0917, ANN001, ANN201
    """Send what feeds `source` down the levels to drained places, until it is used up or nothing gets through.

    `path` is scratch for arcs, `next_arc` (place,) the arc to try next.
    """
    depth, place = 0, source
    while lean[source] > 0:
        if level[place] == 0 and lean[place] < 0:
            amount = min(lean[source], -lean[place])
            for step in range(depth):
                amount = min(amount, capacity[path[step]])
            lean[source] -= amount
            lean[place] += amount
            for step in range(depth):
                capacity[path[step]] -= amount
                capacity[twins[path[step]]] += amount
            depth, place = 0, source
            continue
        arc, end, below = next_arc[place], starts[place + 1], level[place] - 1
        if below >= 0:
            while arc < end and not (
                mark[neighbours[arc]] == FREE and level[neighbours[arc]] == below and capacity[arc] > 0
            ):
                arc += 1
        else:
            arc = end
        next_arc[place] = arc
        if arc < end:
            path[depth] = arc
            place = neighbours[arc]
            depth += 1
        elif depth > 0:
            depth -= 1
            place = source if depth == 0 else neighbours[path[depth - 1]]
            next_arc[place] += 1
        else:
            return


def core_in_hand(
    graph: Arcs, unary: np.ndarray, pairwise: np.ndarray, labels: np.ndarray, work: Work
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The free places' rows, then the arguments of `maxflow.binary_minimum` for them: 1 stands for beta."""
    place, beta = work.core[PLACE], work.core[BETA]
    seen = work.seen[: work.core[SEEN]]
    free = seen[work.mark[seen] == FREE].astype(np.int64)
    edges, weights = _core_edges(graph, free, work.mark, work.level, pairwise[labels[place], beta])
    return free, np.zeros(len(free)), work.lean[free], edges, weights


@compiled()
def _core_edges(graph, free, mark, local, cost):  # noqa: ANN001, ANN202
    count = 0
    for index, place in enumerate(free):
        local[place] = index
        count += graph.starts[place + 1] - graph.starts[place]
    edges, weights = np.empty((count, 2), np.int64), np.empty(count)
    count = 0
    for place in free:
        for arc in range(graph.starts[place], graph.starts[place + 1]):
            neighbour = graph.neighbours[arc]
            if neighbour > place and mark[neighbour] == FREE:
                edges[count, 0], edges[count, 1] = local[place], local[neighbour]
                weights[count] = graph.weights[arc] * cost
                count += 1
    return edges[:count], weights[:count]

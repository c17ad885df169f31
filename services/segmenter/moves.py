"""Compiled alpha-beta-swaps, solved only where something changed (pure).

The swap of one pair of labels falls apart. Let place p have label alpha or beta, D(p) be what beta costs it more than
alpha against its neighbours of third labels, and S(p) the sum of w V(alpha, beta) over its neighbours with alpha or
beta. If D(p) >= S(p), alpha is best for p whatever those neighbours take; if D(p) <= -S(p), beta is. Such a place is
*forced*: it takes its label at no loss, and for its neighbours becomes one with a fixed label, which may force them in
turn. What stays free are small connected *cores*, each a minimum cut of its own.

A change of label, cost or edge can open a better swap only in a core that holds a place whose costs changed: any better
swap is a sum of its connected parts, and a part without such a place was already tried. So each place carries one flag
per label, `pending`: whether the swap of its own label with that one is still to be tried there. When no flag is left,
no alpha-beta-swap lowers the energy. Work is thereby proportional to the change, not to the field.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numba import njit

from services.segmenter.adjacency import Adjacency

UNSEEN, FREE, TAKES_ALPHA, TAKES_BETA = 0, 1, 2, 3
HEAD, COUNT, PLACE, BETA, SEEN, FREE_COUNT = range(6)  # entries of Work.cursor
SETTLED, SPENT, CUT = 0, 1, 2  # what `settle` says


class Work(NamedTuple):
    """Flags and scratch space; only `pending`, `queue`, `queued` and `cursor` hold state between calls."""

    pending: np.ndarray  # (place, label) uint8
    queue: np.ndarray  # (place,) int32, a ring: places with a pending flag, first come first served
    queued: np.ndarray  # (place,) uint8
    cursor: np.ndarray  # (6,) int64: start and length of the ring; place and label of the core in hand, its sizes
    mark: np.ndarray  # (place,) int8 UNSEEN, FREE, TAKES_ALPHA or TAKES_BETA
    seen: np.ndarray  # (place,) int32 the places of the core in hand
    lean: np.ndarray  # (place,) D
    hold: np.ndarray  # (place,) S
    stack: np.ndarray  # (place,) int32
    level: np.ndarray  # (place,) int32 distance to the sink
    arc: np.ndarray  # (place,) int64 next arc to try
    capacity: np.ndarray  # (arc,)


def empty_work(places: int, labels: int, arcs: int) -> Work:
    """Nothing pending."""
    return Work(
        pending=np.zeros((places, labels), np.uint8),
        queue=np.zeros(places, np.int32),
        queued=np.zeros(places, np.uint8),
        cursor=np.zeros(6, np.int64),
        mark=np.zeros(places, np.int8),
        seen=np.empty(places, np.int32),
        lean=np.empty(places),
        hold=np.empty(places),
        stack=np.empty(places, np.int32),
        level=np.empty(places, np.int32),
        arc=np.empty(places, np.int64),
        capacity=np.empty(arcs),
    )


Cut = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], np.ndarray]  # as maxflow.binary_minimum


def run_swaps(  # noqa: PLR0917
    graph: Adjacency,
    unary: np.ndarray,
    pairwise: np.ndarray,
    labels: np.ndarray,
    work: Work,
    cut: Cut,
    compiled_up_to: int,
    units: int,
    least_gain: float,
) -> bool:
    """Try pending swaps and change `labels` (place,) int64 in place; True when nothing is pending any more.

    Ends after about `units` visits of places. Cores of at most `compiled_up_to` free places are cut by compiled code,
    larger ones by `cut`.
    """
    arrays = (graph, unary, pairwise, labels, work)
    while True:
        status = settle(*arrays, compiled_up_to, units, least_gain)
        if status != CUT:
            return status == SETTLED
        free, cost_alpha, cost_beta, edges, weights = core_in_hand(*arrays)
        work.mark[free] = np.where(cut(cost_alpha, cost_beta, edges, weights), TAKES_BETA, TAKES_ALPHA)
        units -= int(work.cursor[SEEN])
        commit(*arrays, least_gain)
        if units <= 0:
            return bool(work.cursor[COUNT] == 0)


@njit(cache=True, nogil=True)
def flag(place, work):  # noqa: ANN001, ANN201
    """All swaps of this place's label are to be tried."""
    work.pending[place, :] = 1
    enqueue(place, work)


@njit(cache=True, nogil=True)
def enqueue(place, work):  # noqa: ANN001, ANN201
    """Put the place at the end of the queue unless it is there."""
    if work.queued[place] == 0:
        work.queued[place] = 1
        work.queue[(work.cursor[HEAD] + work.cursor[COUNT]) % len(work.queue)] = place
        work.cursor[COUNT] += 1


@njit(cache=True, nogil=True)
def flag_all(places, work):  # noqa: ANN001, ANN201
    """`flag` for each of `places`."""
    for place in places:
        flag(place, work)


@njit(cache=True, nogil=True)
def enqueue_all(places, work):  # noqa: ANN001, ANN201
    """`enqueue` for each of `places`."""
    for place in places:
        enqueue(place, work)


@njit(cache=True, nogil=True)
def flag_around(places, graph, work):  # noqa: ANN001, ANN201
    """`flag` for each of `places` and its neighbours: what to do after its label was changed from outside."""
    for place in places:
        flag(place, work)
        for arc in range(graph.starts[place], graph.starts[place + 1]):
            flag(graph.neighbours[arc], work)


@njit(cache=True, nogil=True)
def settle(graph, unary, pairwise, labels, work, compiled_up_to, units, least_gain):  # noqa: PLR0917, ANN001, ANN201
    """Take places from the queue and try their pending swaps, as `run_swaps` says."""
    cursor = work.cursor
    costs = np.empty(unary.shape[1])
    while cursor[COUNT] > 0:
        if units <= 0:
            return SPENT
        place = work.queue[cursor[HEAD]]
        beta = next_pending(place, graph, unary, pairwise, labels, work, costs)
        units -= 1
        if beta < 0:
            work.queued[place] = 0
            cursor[HEAD] = (cursor[HEAD] + 1) % len(work.queue)
            cursor[COUNT] -= 1
            continue
        cursor[PLACE], cursor[BETA] = place, beta
        explore(graph, unary, pairwise, labels, work)
        if cursor[FREE_COUNT] > compiled_up_to:
            return CUT
        if cursor[FREE_COUNT] > 0:
            cut_core(graph, pairwise[labels[place], beta], work)
        units -= cursor[SEEN]
        commit(graph, unary, pairwise, labels, work, least_gain)
    return SETTLED


@njit(cache=True, nogil=True)
def next_pending(place, graph, unary, pairwise, labels, work, costs):  # noqa: PLR0917, ANN001, ANN201
    """A label to try at `place`, -1 if none; clears the flags of labels that its neighbours force it not to take."""
    alpha = labels[place]
    like = conditional(place, graph, unary, pairwise, labels, costs)
    found = -1
    for beta in range(len(costs)):
        if work.pending[place, beta] == 0:
            continue
        if beta == alpha or costs[beta] - costs[alpha] >= 2.0 * like * pairwise[alpha, beta]:
            work.pending[place, beta] = 0
        elif found < 0:
            found = beta
    return found


@njit(cache=True, nogil=True)
def conditional(place, graph, unary, pairwise, labels, costs):  # noqa: PLR0917, ANN001, ANN201
    """Fill in `costs` (label,) of each label while the neighbours keep theirs; return the like neighbours' weight."""
    like = 0.0
    costs[:] = unary[place]
    for arc in range(graph.starts[place], graph.starts[place + 1]):
        label, weight = labels[graph.neighbours[arc]], graph.weights[arc]
        if label == labels[place]:
            like += weight
        for other in range(len(costs)):
            costs[other] += weight * pairwise[label, other]
    return like


@njit(cache=True, nogil=True)
def explore(graph, unary, pairwise, labels, work):  # noqa: ANN001, ANN201
    """Find the core around the place in hand: its free places, and the forced ones around them, into `seen`."""
    cursor, seen, mark = work.cursor, work.seen, work.mark
    alpha, beta = labels[cursor[PLACE]], cursor[BETA]
    cursor[SEEN] = cursor[FREE_COUNT] = 0
    visit(cursor[PLACE], alpha, beta, graph, unary, pairwise, labels, work)
    index = 0
    while index < cursor[SEEN]:
        place = seen[index]
        index += 1
        if mark[place] != FREE:
            continue
        for arc in range(graph.starts[place], graph.starts[place + 1]):
            neighbour = graph.neighbours[arc]
            if mark[neighbour] == UNSEEN and (labels[neighbour] == alpha or labels[neighbour] == beta):
                visit(neighbour, alpha, beta, graph, unary, pairwise, labels, work)


@njit(cache=True, nogil=True)
def visit(place, alpha, beta, graph, unary, pairwise, labels, work):  # noqa: PLR0917, ANN001, ANN201
    """Weigh one place; if it is forced, let that spread over the free places seen so far."""
    lean, hold, cost = unary[place, beta] - unary[place, alpha], 0.0, pairwise[alpha, beta]
    for arc in range(graph.starts[place], graph.starts[place + 1]):
        neighbour, weight = graph.neighbours[arc], graph.weights[arc]
        label = labels[neighbour]
        if label not in (alpha, beta):
            lean += weight * (pairwise[label, beta] - pairwise[label, alpha])
        elif work.mark[neighbour] == TAKES_ALPHA:
            lean += weight * cost
        elif work.mark[neighbour] == TAKES_BETA:
            lean -= weight * cost
        else:
            hold += weight * cost
    work.lean[place], work.hold[place] = lean, hold
    work.seen[work.cursor[SEEN]] = place
    work.cursor[SEEN] += 1
    work.cursor[FREE_COUNT] += 1
    work.mark[place] = FREE
    force(place, alpha, beta, labels, work)
    depth = 0
    if work.mark[place] != FREE:
        work.stack[0] = place
        depth = 1
    while depth > 0:
        depth -= 1
        forced = work.stack[depth]
        sign = 1.0 if work.mark[forced] == TAKES_ALPHA else -1.0
        for arc in range(graph.starts[forced], graph.starts[forced + 1]):
            neighbour, weight = graph.neighbours[arc], graph.weights[arc]
            if work.mark[neighbour] == FREE:
                work.lean[neighbour] += sign * weight * cost
                work.hold[neighbour] -= weight * cost
                force(neighbour, alpha, beta, labels, work)
                if work.mark[neighbour] != FREE:
                    work.stack[depth] = neighbour
                    depth += 1


@njit(cache=True, nogil=True)
def force(place, alpha, beta, labels, work):  # noqa: ANN001, ANN201
    """Mark a free place that one label suits whatever its free neighbours take; of two equal ones, its own."""
    for_alpha, for_beta = work.lean[place] >= work.hold[place], work.lean[place] <= -work.hold[place]
    if for_alpha and for_beta:
        for_alpha = labels[place] == alpha
    if for_alpha or for_beta:
        work.mark[place] = TAKES_ALPHA if for_alpha else TAKES_BETA
        work.cursor[FREE_COUNT] -= 1


@njit(cache=True, nogil=True)
def commit(graph, unary, pairwise, labels, work, least_gain):  # noqa: PLR0917, ANN001, ANN201
    """Relabel the core in hand as marked if that gains more than `least_gain`, then update flags and clear marks."""
    cursor, seen, stack = work.cursor, work.seen, work.stack
    alpha, beta = labels[cursor[PLACE]], cursor[BETA]
    costs = np.empty(unary.shape[1])
    changed, gain = 0, 0.0
    for index in range(cursor[SEEN]):
        place = seen[index]
        wanted = alpha if work.mark[place] == TAKES_ALPHA else beta
        work.mark[place] = UNSEEN
        work.pending[place, alpha] = work.pending[place, beta] = 0
        if wanted != labels[place]:
            conditional(place, graph, unary, pairwise, labels, costs)
            gain += costs[labels[place]] - costs[wanted]
            labels[place] = wanted
            stack[changed] = place
            changed += 1
    if gain <= least_gain:
        for index in range(changed):
            place = stack[index]
            labels[place] = alpha if labels[place] == beta else beta
        return
    for index in range(changed):
        place = stack[index]
        flag_but(place, alpha, beta, work)
        for arc in range(graph.starts[place], graph.starts[place + 1]):
            neighbour = graph.neighbours[arc]
            if labels[neighbour] == alpha or labels[neighbour] == beta:
                flag_but(neighbour, alpha, beta, work)
            else:
                flag(neighbour, work)


@njit(cache=True, nogil=True)
def flag_but(place, alpha, beta, work):  # noqa: ANN001, ANN201
    """Flag a place with one of the two labels just swapped; whether their own swap is to be tried stays as it is."""
    first, second = work.pending[place, alpha], work.pending[place, beta]
    work.pending[place, :] = 1
    work.pending[place, alpha], work.pending[place, beta] = first, second
    enqueue(place, work)


@njit(cache=True, nogil=True)
def cut_core(graph, cost, work):  # noqa: ANN001, ANN201
    """Decide the free places by a maximum flow (Dinic, 1970) on the arcs of the graph itself; nothing is copied.

    A place with D > 0 is fed by the source, one with D < 0 drained to the sink; those that can still reach the sink at
    the end take beta.
    """
    seen, mark, level, lean, arc_of = work.seen, work.mark, work.level, work.lean, work.arc
    count = work.cursor[SEEN]
    for index in range(count):
        place = seen[index]
        if mark[place] == FREE:
            for arc in range(graph.starts[place], graph.starts[place + 1]):
                work.capacity[arc] = graph.weights[arc] * cost
    while rank(graph, work):
        for index in range(count):
            place = seen[index]
            arc_of[place] = graph.starts[place]
        for index in range(count):
            place = seen[index]
            if mark[place] == FREE and lean[place] > 0 and level[place] >= 0:
                push(place, graph, work)
    for index in range(count):
        place = seen[index]
        if mark[place] == FREE:
            mark[place] = TAKES_BETA if level[place] >= 0 else TAKES_ALPHA


@njit(cache=True, nogil=True)
def rank(graph, work):  # noqa: ANN001, ANN201
    """Distance of each free place to the sink over arcs with capacity left, -1 = none; True if a fed place has one."""
    seen, mark, level, stack = work.seen, work.mark, work.level, work.stack
    count, fed = 0, False
    for index in range(work.cursor[SEEN]):
        place = seen[index]
        level[place] = -1
        if mark[place] == FREE and work.lean[place] < 0:
            level[place] = 0
            stack[count] = place
            count += 1
    index = 0
    while index < count:
        place = stack[index]
        index += 1
        for arc in range(graph.starts[place], graph.starts[place + 1]):
            neighbour = graph.neighbours[arc]
            if mark[neighbour] == FREE and level[neighbour] < 0 and work.capacity[graph.twins[arc]] > 0:
                level[neighbour] = level[place] + 1
                fed |= work.lean[neighbour] > 0
                stack[count] = neighbour
                count += 1
    return fed


@njit(cache=True, nogil=True)
def push(source, graph, work):  # noqa: ANN001, ANN201
    """Send what feeds `source` down the levels to drained places, until it is used up or nothing gets through.

    `stack` holds the path's arcs.
    """
    lean, level, arc_of, path, capacity = work.lean, work.level, work.arc, work.stack, work.capacity
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
                capacity[graph.twins[path[step]]] += amount
            depth, place = 0, source
            continue
        end = graph.starts[place + 1]
        while arc_of[place] < end and not open_arc(arc_of[place], level[place], graph, work):
            arc_of[place] += 1
        if arc_of[place] < end:
            path[depth] = arc_of[place]
            place = graph.neighbours[arc_of[place]]
            depth += 1
        elif depth > 0:
            depth -= 1
            place = source if depth == 0 else graph.neighbours[path[depth - 1]]
            arc_of[place] += 1
        else:
            return


@njit(cache=True, nogil=True)
def open_arc(arc, level, graph, work):  # noqa: ANN001, ANN201
    """Whether the arc leads one level down to a free place and has capacity left."""
    neighbour = graph.neighbours[arc]
    if level == 0 or work.mark[neighbour] != FREE:
        return False
    return work.level[neighbour] == level - 1 and work.capacity[arc] > 0


def core_in_hand(
    graph: Adjacency, unary: np.ndarray, pairwise: np.ndarray, labels: np.ndarray, work: Work
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The free places' rows, then the arguments of `maxflow.binary_minimum` for them: 1 stands for beta."""
    place, beta = work.cursor[PLACE], work.cursor[BETA]
    seen = work.seen[: work.cursor[SEEN]]
    free = seen[work.mark[seen] == FREE].astype(np.int64)
    edges, weights = _core_edges(graph, free, work.mark, work.level, pairwise[labels[place], beta])
    return free, np.zeros(len(free)), work.lean[free], edges, weights


@njit(cache=True, nogil=True)
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

"""The minimum cut of one core, by compiled code on the graph's own arcs or as edges for a library (pure)."""

import numpy as np

from prior_sg.services.compiled import compiled
from prior_sg.services.segmenter.core.energy.swap_work import BETA, FREE, PLACE, SEEN, TAKES_ALPHA, TAKES_BETA, Work
from prior_sg.services.segmenter.core.map.arcs import Arcs


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

"""Cores of a swap: what stays free around a place when all that are forced have their labels (pure).

D(p), S(p) and *forced* are those of `swap_moves`.
"""

from prior_sg.services.compiled import compiled
from prior_sg.services.segmenter.core.energy.swap_work import (
    BETA,
    CAPPED,
    FREE,
    FREE_COUNT,
    LISTED,
    PLACE,
    SEEN,
    TAKES_ALPHA,
    TAKES_BETA,
    UNSEEN,
)


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


@compiled(inline="always")
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


@compiled(inline="always")
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

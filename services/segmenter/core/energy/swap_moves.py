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

from typing import NamedTuple

import numpy as np

from prior_sg.services.compiled import compiled
from prior_sg.services.segmenter.core.energy.maxflow import Cut
from prior_sg.services.segmenter.core.energy.swap_cores import explore
from prior_sg.services.segmenter.core.energy.swap_cuts import core_in_hand, cut_core
from prior_sg.services.segmenter.core.energy.swap_work import (
    BETA,
    CAPPED,
    COUNT,
    FREE_COUNT,
    HEAD,
    NEAR,
    NOT_PENDING,
    PLACE,
    SEEN,
    TAKES_ALPHA,
    TAKES_BETA,
    UNSEEN,
    Work,
    flag,
    tried,
)
from prior_sg.services.segmenter.core.map.arcs import Arcs

SETTLED, SPENT, CUT = 0, 1, 2  # what `settle` says


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


@compiled(inline="always")
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


@compiled(inline="always")
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


@compiled(inline="always")
def flag_after(place, alpha, beta, labels, work):  # noqa: ANN001, ANN201
    """Flag a place after a swap of alpha and beta nearby; that swap need not be tried again, unless it was ended."""
    kept_alpha, kept_beta = work.pending[place, alpha], work.pending[place, beta]
    flag(place, NEAR, work)
    in_pair = labels[place] == alpha or labels[place] == beta
    if in_pair and work.core[CAPPED] == 0:
        work.pending[place, alpha], work.pending[place, beta] = kept_alpha, kept_beta

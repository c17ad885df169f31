"""Compiled sequential tree-reweighted message passing, TRW-S (Kolmogorov, 2006; pure).

Messages run along the order of the rows and back. Each pass yields a labelling (every place in turn takes what its
decided predecessors and the messages of its successors make cheapest), and the pass back a lower bound on the energy of
every labelling. Restricted to some of the places, the others keep their labels and only their costs are felt.

Label arrays are padded with labels of cost FAR to a multiple of eight, so that the inner loops are whole vector
operations.
"""

from typing import NamedTuple

import numpy as np

from prior_sg.services.compiled import compiled

VECTOR = 8
UNROLLED = 4  # labels that one step of the inner loop takes
FAR = 1e30  # cost of a label that is not there
FAST = {"nnan", "nsz", "contract"}  # no NaN occurs; these let minima and products be vectorised


class Messages(NamedTuple):
    """Messages of one field; all arrays but two have one floating-point type."""

    costs: np.ndarray  # (place, padded label) unary, with the costs of fixed neighbours, of the places in hand
    incoming: np.ndarray  # (arc, padded label) what the arc's far end tells its near end
    pairwise: np.ndarray  # (label in whole steps of UNROLLED, padded label)
    inside: np.ndarray  # (place,) bool: in hand
    proposed: np.ndarray  # (place,) int64 the labelling of the last pass


def empty_messages(places: int, arcs: int, pairwise: np.ndarray, number: type) -> Messages:
    """Room for messages; no place is in hand yet."""
    labels = len(pairwise)
    padded = -(-labels // VECTOR) * VECTOR
    square: np.ndarray = np.zeros((-(-labels // UNROLLED) * UNROLLED, padded), number)
    square[:labels, :labels] = pairwise
    return Messages(
        costs=np.empty((places, padded), number),
        incoming=np.empty((arcs, padded), number),
        pairwise=square,
        inside=np.zeros(places, np.bool_),
        proposed=np.zeros(places, np.int64),
    )


@compiled()
def take_up(rows, graph, unary, labels, messages):  # noqa: ANN001, ANN201
    """Put the places `rows` in hand, without messages; all others keep `labels`."""
    count, pairwise = unary.shape[1], messages.pairwise
    costs, incoming, inside = messages.costs, messages.incoming, messages.inside
    starts, neighbours, weights = graph.starts, graph.neighbours, graph.weights
    for place in rows:
        inside[place] = True
    for place in rows:
        for label in range(count):
            costs[place, label] = unary[place, label]
        for label in range(count, costs.shape[1]):
            costs[place, label] = FAR
        for arc in range(starts[place], starts[place + 1]):
            incoming[arc] = 0
            neighbour = neighbours[arc]
            if not inside[neighbour]:
                for label in range(count):
                    costs[place, label] += weights[arc] * pairwise[labels[neighbour], label]


@compiled()
def lay_down(rows, messages):  # noqa: ANN001, ANN201
    """No place is in hand any more."""
    for place in rows:
        messages.inside[place] = False


@compiled(fastmath=FAST, inline="always")
def _tell(told, weight, pairwise, incoming, arc):  # noqa: ANN001, ANN202
    """The message to `arc`, min_i told[i] + weight V[i, j] less its least value, which is returned."""
    count, padded = pairwise.shape
    least = incoming.dtype.type(FAR)
    for label in range(padded):
        incoming[arc, label] = FAR
    for other in range(0, count, UNROLLED):
        told_0, told_1, told_2, told_3 = told[other], told[other + 1], told[other + 2], told[other + 3]
        for label in range(padded):
            low = min(told_0 + weight * pairwise[other, label], told_1 + weight * pairwise[other + 1, label])
            high = min(told_2 + weight * pairwise[other + 2, label], told_3 + weight * pairwise[other + 3, label])
            incoming[arc, label] = min(incoming[arc, label], low, high)
    for label in range(count):
        least = min(least, incoming[arc, label])
    for label in range(padded):
        incoming[arc, label] -= least
    return least


@compiled(fastmath=FAST)
def run_pass(rows, forward, graph, messages):  # noqa: ANN001, ANN201
    """One pass over `rows` (ascending) in order or back; fills in `proposed`, returns the bound."""
    starts, neighbours, weights, twins = graph.starts, graph.neighbours, graph.weights, graph.twins
    costs, incoming, pairwise = messages.costs, messages.incoming, messages.pairwise
    inside, proposed = messages.inside, messages.proposed
    count, padded = pairwise.shape
    number = costs.dtype.type
    known, open_ = np.empty(padded, costs.dtype), np.empty(padded, costs.dtype)
    decided, told = np.empty(padded, costs.dtype), np.empty(padded, costs.dtype)
    bound = 0.0
    for step in range(len(rows)):
        place = rows[step] if forward else rows[len(rows) - 1 - step]
        before = after = 0
        for label in range(padded):
            open_[label] = costs[place, label]
            known[label] = decided[label] = 0
        for arc in range(starts[place], starts[place + 1]):
            neighbour = neighbours[arc]
            if not inside[neighbour]:
                continue
            if (neighbour < place) == forward:
                before += 1
                weight, taken = number(weights[arc]), proposed[neighbour]
                for label in range(padded):
                    known[label] += incoming[arc, label]
                    decided[label] += weight * pairwise[taken, label]
            else:
                after += 1
                for label in range(padded):
                    open_[label] += incoming[arc, label]
        best, least = 0, number(FAR)
        for label in range(count):
            if open_[label] + decided[label] < open_[best] + decided[best]:
                best = label
            least = min(least, open_[label] + known[label])
        proposed[place] = best
        bound += least
        share = number(1.0 / max(before, after, 1))
        for label in range(padded):
            known[label] = share * (open_[label] + known[label] - least)
        for arc in range(starts[place], starts[place + 1]):
            neighbour = neighbours[arc]
            if not inside[neighbour] or (neighbour < place) == forward:
                continue
            for label in range(padded):
                told[label] = known[label] - incoming[arc, label]
            bound += _tell(told, number(weights[arc]), pairwise, incoming, twins[arc])
    return bound


@compiled()
def energy_of(rows, labels, graph, messages):  # noqa: ANN001, ANN201
    """Energy of the places in hand with `labels`, the costs against the others included."""
    total = 0.0
    for place in rows:
        label = labels[place]
        total += messages.costs[place, label]
        for arc in range(graph.starts[place], graph.starts[place + 1]):
            neighbour = graph.neighbours[arc]
            if neighbour > place and messages.inside[neighbour]:
                total += graph.weights[arc] * messages.pairwise[label, labels[neighbour]]
    return total

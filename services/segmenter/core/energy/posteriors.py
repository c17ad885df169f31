"""How sure the labels are (pure).

The posterior of a place follows from what each label would cost it while its neighbours keep theirs: the Gibbs
distribution of the energy, one place at a time. It needs the place and its neighbours only, so it is kept up to date at
the cost of a change. `temperature` corrects that evidence is repeated: neighbouring places were seen in the same
pictures, and the energy, which counts each of them, believes too firmly.
"""

import numpy as np
from numba import njit

from prior_sg.services.segmenter.core.energy.swap import Field
from prior_sg.services.segmenter.core.map.received import Adjacency


def conditional_costs(field: Field, near: Adjacency, labels: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Cost (row, label) of each label at the places `rows` while all others keep theirs."""
    return _conditional_costs(
        field.unary, near.starts, near.neighbours, near.edges, field.weights, field.pairwise, labels, rows
    )


def posteriors(costs: np.ndarray, temperature: float) -> np.ndarray:
    """Gibbs distribution (place, label) of costs (place, label)."""
    likelihoods = np.exp((costs.min(axis=1, keepdims=True) - costs) / temperature)
    return likelihoods / likelihoods.sum(axis=1, keepdims=True)


@njit(cache=True, nogil=True)
def _conditional_costs(unary, starts, neighbours, edges, weights, pairwise, labels, rows):  # noqa: ANN001, ANN202, PLR0917
    costs = np.empty((len(rows), unary.shape[1]))
    for index in range(len(rows)):
        row = rows[index]
        costs[index] = unary[row]
        for at in range(starts[row], starts[row + 1]):
            label = labels[neighbours[at]]
            for other in range(unary.shape[1]):
                costs[index, other] += weights[edges[at]] * pairwise[other, label]
    return costs

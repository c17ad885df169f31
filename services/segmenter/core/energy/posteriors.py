"""How sure the labels are (pure).

The posterior of a place follows from what each label would cost it while its neighbours keep theirs: the Gibbs
distribution of the energy, one place at a time. It needs the place and its neighbours only, so it is kept up to date at
the cost of a change. `temperature` corrects that evidence is repeated: neighbouring places were seen in the same
pictures, and the energy, which counts each of them, believes too firmly.
"""

import numpy as np

from prior_sg.services.compiled import compiled
from prior_sg.services.segmenter.core.energy.mrf import Field
from prior_sg.services.segmenter.core.energy.swap_moves import conditional
from prior_sg.services.segmenter.core.map.arcs import Arcs


def conditional_costs(field: Field, ties: Arcs, labels: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Cost (row, label) of each label at the places `rows` while all others keep theirs; `ties` are the field's edges
    with their weights, as arcs."""
    return _conditional_costs(field.unary, ties.starts, ties.neighbours, ties.weights, field.pairwise, labels, rows)


def posteriors(costs: np.ndarray, temperature: float) -> np.ndarray:
    """Gibbs distribution (place, label) of costs (place, label)."""
    likelihoods = np.exp((costs.min(axis=1, keepdims=True) - costs) / temperature)
    return likelihoods / likelihoods.sum(axis=1, keepdims=True)


@compiled()
def _conditional_costs(unary, starts, neighbours, weights, pairwise, labels, rows):  # noqa: ANN001, ANN202, PLR0917
    costs = np.empty((len(rows), unary.shape[1]))
    for index in range(len(rows)):
        conditional(rows[index], starts, neighbours, weights, unary, pairwise, labels, costs[index])
    return costs

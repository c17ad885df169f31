"""The Markov random field over places, and its energy (paper, Topological Regularization and Graph Cuts; pure).

A field is: `unary` (place, label) costs; `edges` (edge, 2) place rows with `weights` (edge,) >= 0; `pairwise`
(label, label) costs, symmetric, >= 0, zero diagonal, not necessarily a metric. Its energy is

    E(L) = sum_p unary[p, L(p)] + sum_(u,v) weights[u,v] * pairwise[L(u), L(v)].
"""

from typing import NamedTuple

import numpy as np

from prior_sg.services.compiled import compiled

RELATIVE_GAIN = 1e-12  # of the energy's magnitude; a smaller gain is rounding


class Field(NamedTuple):
    """A Markov random field, as the module says."""

    unary: np.ndarray  # (place, label) float64
    edges: np.ndarray  # (edge, 2) int64
    weights: np.ndarray  # (edge,) float64
    pairwise: np.ndarray  # (label, label) float64


def energy(field: Field, labels: np.ndarray) -> float:
    """E(L) (eq. mrf_energy)."""
    of_places, of_edges = _terms(*field, labels)
    return float(of_places.sum() + of_edges.sum())


@compiled()
def _terms(unary, edges, weights, pairwise, labels):  # noqa: ANN001, ANN202
    of_places, of_edges = np.empty(len(labels)), np.empty(len(edges))
    for place in range(len(labels)):
        of_places[place] = unary[place, labels[place]]
    for edge in range(len(edges)):
        of_edges[edge] = weights[edge] * pairwise[labels[edges[edge, 0]], labels[edges[edge, 1]]]
    return of_places, of_edges


def least_gain(unary: np.ndarray) -> float:
    """The smallest fall of the energy that counts as one, given the unary costs (place, label) that may take part."""
    return RELATIVE_GAIN * (float(np.abs(unary).sum()) + 1.0)

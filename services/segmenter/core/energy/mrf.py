"""The Markov random field over places, and its energy (paper, Topological Regularization and Graph Cuts; pure).

A field is: `unary` (place, label) costs; `edges` (edge, 2) place rows with `weights` (edge,) >= 0; `pairwise`
(label, label) costs, symmetric, >= 0, zero diagonal, not necessarily a metric. Its energy is

    E(L) = sum_p unary[p, L(p)] + sum_(u,v) weights[u,v] * pairwise[L(u), L(v)].
"""

from typing import NamedTuple

import numpy as np

from prior_sg.services.compiled import compiled
from prior_sg.services.segmenter.core.map.arcs import Arcs

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


class KeptTerms:
    """The terms of the last energy. Those that may have changed are found again, and all summed as in `energy`: it is
    the same to the last digit."""

    def __init__(self) -> None:
        nothing = np.zeros(0)
        self._edges, self._pairwise = np.zeros((0, 2), np.int64), nothing
        self._of_places, self._of_edges = nothing, nothing

    def energy(self, field: Field, labels: np.ndarray, ties: Arcs, rows: np.ndarray) -> float:
        """E(L); `ties` are the field's edges as arcs. Edges that are the same array are the same edges.

        `rows` (n,) hold every place with other costs or another label since, and an end of each edge of another weight.
        """
        known = field.edges is self._edges and len(labels) == len(self._of_places)
        if known and np.array_equal(field.pairwise, self._pairwise):
            _renew(*field, labels, rows, ties.starts, ties.edges, self._of_places, self._of_edges)
        else:
            self._edges, self._pairwise = field.edges, field.pairwise.copy()
            self._of_places, self._of_edges = _terms(*field, labels)
        return float(self._of_places.sum() + self._of_edges.sum())


@compiled()
def _renew(unary, edges, weights, pairwise, labels, rows, starts, arc_edges, of_places, of_edges):  # noqa: PLR0917, ANN001, ANN202
    """Bring up to date the terms of the places `rows` and of their edges."""
    for place in rows:
        of_places[place] = unary[place, labels[place]]
        for arc in range(starts[place], starts[place + 1]):
            edge = arc_edges[arc]
            of_edges[edge] = weights[edge] * pairwise[labels[edges[edge, 0]], labels[edges[edge, 1]]]


def least_gain(unary: np.ndarray) -> float:
    """The smallest fall of the energy that counts as one, given the unary costs (place, label) that may take part."""
    return RELATIVE_GAIN * (float(np.abs(unary).sum()) + 1.0)

"""MRF energy and its minimisation by alpha-beta-swap (paper, Topological Regularization and Graph Cuts; pure).

A field is: `unary` (place, label) costs; `edges` (edge, 2) place rows with `weights` (edge,) >= 0; `pairwise`
(label, label) costs, symmetric, >= 0, zero diagonal, not necessarily a metric. Its energy is

    E(L) = sum_p unary[p, L(p)] + sum_(u,v) weights[u,v] * pairwise[L(u), L(v)].
"""

from typing import NamedTuple

import numpy as np
from scipy import sparse

from services.segmenter.maxflow import binary_minimum

RELATIVE_GAIN = 1e-12  # of the energy's magnitude; a smaller gain is rounding


class Field(NamedTuple):
    """A Markov random field, as the module says."""

    unary: np.ndarray  # (place, label) float64
    edges: np.ndarray  # (edge, 2) int64
    weights: np.ndarray  # (edge,) float64
    pairwise: np.ndarray  # (label, label) float64


def energy(field: Field, labels: np.ndarray) -> float:
    """E(L) (eq. mrf_energy)."""
    first, second = labels[field.edges[:, 0]], labels[field.edges[:, 1]]
    unary = field.unary[np.arange(len(labels)), labels].sum()
    return float(unary + (field.weights * field.pairwise[first, second]).sum())


def conditional_costs(field: Field, labels: np.ndarray) -> np.ndarray:
    """Cost (place, label) of each label at each place while all its neighbours keep theirs."""
    n = len(labels)
    rows = np.concatenate((field.edges[:, 0], field.edges[:, 1]))
    columns = np.concatenate((field.edges[:, 1], field.edges[:, 0]))
    weights = sparse.csr_matrix((np.tile(field.weights, 2), (rows, columns)), shape=(n, n))
    return field.unary + weights @ field.pairwise[labels]


def minimise(field: Field, labels: np.ndarray) -> np.ndarray:
    """Labels (place,) from which no alpha-beta-swap lowers the energy, starting from `labels`.

    Pairs run in a fixed order. A pair is skipped while neither its places nor their neighbours changed since it was
    last solved, for its cut would be the same. Each accepted swap lowers the energy, so it ends.
    """
    labels = np.array(labels, dtype=np.int64)
    label_count = field.unary.shape[1]
    pairs = [(alpha, beta) for alpha in range(label_count) for beta in range(alpha + 1, label_count)]
    solved_at = dict.fromkeys(pairs, -1)
    touched_at = np.zeros(len(labels), dtype=np.int64)  # step at which a place or a neighbour last changed
    least_gain = RELATIVE_GAIN * (np.abs(field.unary).sum() + 1.0)
    step, improved = 0, True
    while improved:
        improved = False
        for pair in pairs:
            members = (labels == pair[0]) | (labels == pair[1])
            if not (touched_at[members] > solved_at[pair]).any():
                continue
            step += 1
            solved_at[pair] = step
            changed = swap_pair(field, labels, members, pair, least_gain)
            if changed.any():
                improved = True
                step += 1
                touched_at[_with_neighbours(field.edges, changed)] = step
    return labels


def swap_pair(
    field: Field, labels: np.ndarray, members: np.ndarray, pair: tuple[int, int], least_gain: float = 0.0
) -> np.ndarray:
    """Relabel in place the `members` (mask; all places labelled alpha or beta) with the best mix of the two.

    Returns the mask of places whose label changed; none when the gain is not above `least_gain`. For two labels with
    zero diagonal the problem is submodular whatever the other costs, so one cut is exact (Boykov et al., 2001).
    """
    alpha, beta = pair
    rows = np.flatnonzero(members)
    local = np.cumsum(members) - 1
    inner = np.flatnonzero(members[field.edges[:, 0]] & members[field.edges[:, 1]])
    edges = local[field.edges[inner]]
    weights = field.weights[inner] * field.pairwise[alpha, beta]
    costs = field.unary[rows][:, pair] + _border_costs(field, labels, members, local, pair)
    before = labels[rows] == beta
    after = binary_minimum(costs[:, 0], costs[:, 1], edges, weights)
    changed = np.zeros(len(labels), dtype=bool)
    if _cost(costs, edges, weights, before) - _cost(costs, edges, weights, after) > least_gain:
        changed[rows[before != after]] = True
        labels[rows] = np.where(after, beta, alpha)
    return changed


def _border_costs(
    field: Field, labels: np.ndarray, members: np.ndarray, local: np.ndarray, pair: tuple[int, int]
) -> np.ndarray:
    """Pairwise costs (member, 2) of alpha and beta against the neighbours that keep a third label."""
    first, second = field.edges[:, 0], field.edges[:, 1]
    border = np.flatnonzero(members[first] != members[second])
    first, second, weights = first[border], second[border], field.weights[border]
    inside = local[np.where(members[first], first, second)]
    outside = labels[np.where(members[first], second, first)]
    count = int(members.sum())
    costs = [np.bincount(inside, weights * field.pairwise[label, outside], minlength=count) for label in pair]
    return np.stack(costs, axis=1)


def _cost(costs: np.ndarray, edges: np.ndarray, weights: np.ndarray, takes_beta: np.ndarray) -> float:
    cut = takes_beta[edges[:, 0]] != takes_beta[edges[:, 1]]
    return float(np.where(takes_beta, costs[:, 1], costs[:, 0]).sum() + weights[cut].sum())


def _with_neighbours(edges: np.ndarray, mask: np.ndarray) -> np.ndarray:
    grown = mask.copy()
    grown[edges[mask[edges[:, 0]], 1]] = True
    grown[edges[mask[edges[:, 1]], 0]] = True
    return grown

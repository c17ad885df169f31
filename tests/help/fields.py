"""Random fields, and what is known of them without the solver under test."""

import itertools

import numpy as np

from prior_sg.services.segmenter.core.energy.maxflow import binary_minimum
from prior_sg.services.segmenter.core.energy.mrf import Field


def random_field(seed, places, labels, degree=3, metric=False):
    rng = np.random.default_rng(seed)
    first, second = np.triu_indices(places, 1)
    chosen = np.sort(rng.permutation(len(first))[: places * degree // 2])
    pairwise = rng.uniform(0.1, 3.0, (labels, labels))
    pairwise = np.ones((labels, labels)) if metric else pairwise + pairwise.T
    np.fill_diagonal(pairwise, 0)
    edges = np.stack((first[chosen], second[chosen]), axis=1)
    return Field(rng.uniform(0, 4, (places, labels)), edges, rng.uniform(0, 1, len(edges)), pairwise)


def random_tree(seed, places, labels):
    field = random_field(seed, places, labels)
    rng = np.random.default_rng([seed, 1])
    order = rng.permutation(places)
    edges = np.array([[order[child], order[rng.integers(child)]] for child in range(1, places)])
    return field._replace(edges=edges, weights=rng.uniform(0.1, 1, len(edges)))


def all_energies(field):
    """Every labelling (labelling, place) and its energy (labelling,)."""
    places, labels = field.unary.shape
    every = np.array(list(itertools.product(range(labels), repeat=places)))
    energies = field.unary[np.arange(places), every].sum(axis=1)
    for (u, v), weight in zip(field.edges, field.weights, strict=True):
        energies += weight * field.pairwise[every[:, u], every[:, v]]
    return every, energies


def best_swap(field, labels, pair):
    """The best labelling that changes only the two labels of `pair` into each other: one cut of the whole field."""
    members = np.isin(labels, pair)
    local = np.cumsum(members) - 1
    costs = field.unary[members][:, pair]
    inside = members[field.edges].all(axis=1)
    for (u, v), weight in zip(field.edges, field.weights, strict=True):
        for place, other in ((u, v), (v, u)):
            if members[place] and not members[other]:
                costs[local[place]] += weight * field.pairwise[labels[other], pair]
    weights = field.weights[inside] * field.pairwise[pair]
    after = labels.copy()
    takes_beta = binary_minimum(costs[:, 0], costs[:, 1], local[field.edges[inside]], weights)
    after[members] = np.where(takes_beta, pair[1], pair[0])
    return after

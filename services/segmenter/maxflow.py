"""Minimum cuts: the one function behind which the max-flow library sits (pure)."""

import maxflow as library
import numpy as np


def binary_minimum(cost_0: np.ndarray, cost_1: np.ndarray, edges: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The x in {0, 1}^n that minimises sum_i cost_x(i) + sum_(i,j) weights [x_i != x_j], as bool (n,).

    `cost_0`, `cost_1` (n,) are finite; `edges` (m, 2) are node numbers and `weights` (m,) are not negative. Exact: the
    labelling is a minimum cut (Boykov and Kolmogorov, 2004). A node is on the sink's side when it takes 1, and pays
    then the capacity of its edge from the source.
    """
    if not len(cost_0):
        return np.zeros(0, dtype=bool)
    base = np.minimum(cost_0, cost_1)
    graph = library.Graph[float](len(cost_0), len(edges))
    nodes = graph.add_nodes(len(cost_0))
    graph.add_grid_tedges(nodes, np.asarray(cost_1 - base, float), np.asarray(cost_0 - base, float))
    if len(edges):
        capacities = np.asarray(weights, float)
        graph.add_edges(np.ascontiguousarray(edges[:, 0]), np.ascontiguousarray(edges[:, 1]), capacities, capacities)
    graph.maxflow()
    return graph.get_grid_segments(nodes)

"""Minimum cuts: the functions behind which the max-flow libraries sit (pure).

Each returns the x in {0, 1}^n that minimises

    sum_i cost_x(i) + sum_(i,j) weights [x_i != x_j]

as bool (n,). `cost_0`, `cost_1` (n,) are finite; `edges` (m, 2) are node numbers and `weights` (m,) are not negative. A
node is on the sink's side when it takes 1, and pays then the capacity of its edge from the source.
"""

from collections.abc import Callable
from typing import Literal

import numpy as np
import scipy

try:
    import maxflow as library
except ModuleNotFoundError:
    library = None

MinCut = Literal["auto", "pymaxflow", "scipy"]
Cut = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], np.ndarray]
SCIPY_CAPACITY = 2**30  # SciPy counts in 32-bit integers: the capacities that leave the source sum to at most this


def binary_minimum(cost_0: np.ndarray, cost_1: np.ndarray, edges: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """By PyMaxflow (GPL), exact: the labelling is a minimum cut (Boykov and Kolmogorov, 2004)."""
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


def scipy_minimum(cost_0: np.ndarray, cost_1: np.ndarray, edges: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """By SciPy, for those who cannot use the GPL. Costs are rounded to integers, so the sum is least up to that.

    No capacity above `total`, the smaller sum of the terminals' on either side, can matter. A step of the integers is
    total / SCIPY_CAPACITY, so each edge in the cut is off by half of that at most: the sum found exceeds the least by
    less than total (n + m) / 2^30, 1e-4 of `total` for a hundred thousand nodes and edges.
    """
    count = len(cost_0)
    if not count:
        return np.zeros(0, dtype=bool)
    lean = np.asarray(cost_1 - cost_0, float)
    total = min(lean[lean > 0].sum(), -lean[lean < 0].sum())
    if total == 0.0:
        return np.full(count, bool(lean.sum() < 0))
    scale = SCIPY_CAPACITY / total
    source, sink = count, count + 1
    fed, drained = np.flatnonzero(lean > 0), np.flatnonzero(lean < 0)
    tails = np.concatenate((np.full(len(fed), source), drained, edges[:, 0], edges[:, 1]))
    heads = np.concatenate((fed, np.full(len(drained), sink), edges[:, 1], edges[:, 0]))
    capacities = np.concatenate((lean[fed], -lean[drained], weights, weights))
    capacities = np.rint(np.minimum(capacities, total) * scale).astype(np.int32)
    graph = scipy.sparse.csr_matrix((capacities, (tails, heads)), shape=(count + 2, count + 2))
    left = (graph - scipy.sparse.csgraph.maximum_flow(graph, source, sink).flow).tocsr()
    left.data[left.data < 0] = 0
    left.eliminate_zeros()
    from_source = scipy.sparse.csgraph.breadth_first_order(left, source, directed=True, return_predecessors=False)
    takes_1 = np.ones(count + 2, dtype=bool)
    takes_1[from_source] = False
    return takes_1[:count]


CUTS: dict[str, Cut] = {"pymaxflow": binary_minimum, "scipy": scipy_minimum}


class NoSuchLibrary(ValueError):
    """The library that was asked for is not installed; the message says what to do."""


def min_cut_in_use(wanted: MinCut) -> str:
    """The key of CUTS that serves a setting: `auto` is PyMaxflow where it is installed, else SciPy. Raises
    NoSuchLibrary."""
    if wanted == "pymaxflow" and library is None:
        raise NoSuchLibrary(
            "PyMaxflow is not installed: run `pip install 'prior-sg[fast-cut]'`, or set min_cut to scipy or auto"
        )
    return ("scipy" if library is None else "pymaxflow") if wanted == "auto" else wanted

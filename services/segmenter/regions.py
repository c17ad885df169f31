"""Regions: connected places with one label, with ids that last (paper, Instantiating the Instance Layers; pure)."""

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components

NO_REGION = -1


def components(labels: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Component number (place,) of each place in the graph of same-label edges (eq. connected_components).

    Numbers count from 0 in the order of each component's first place.
    """
    same = edges[labels[edges[:, 0]] == labels[edges[:, 1]]]
    graph = sparse.coo_matrix((np.ones(len(same), dtype=np.int8), (same[:, 0], same[:, 1])), shape=(len(labels),) * 2)
    numbers = connected_components(graph, directed=False)[1]
    _, first, inverse = np.unique(numbers, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[inverse]


def track(component: np.ndarray, previous: np.ndarray, next_id: int) -> tuple[np.ndarray, int]:
    """Region id (place,) of each place, and the next unused id.

    `component` (place,) from `components`, places in the order of their ids; `previous` (place,) holds the region ids
    before, NO_REGION for new places. An id follows the component that keeps most of its places (a split: the larger
    part), and a component that several ids would follow takes the one that brings most places (a merge); ties go to the
    older id and to the component of the older place. Components without an heir get new ids, in order.
    """
    known = previous != NO_REGION
    pairs, counts = np.unique(np.stack((previous[known], component[known]), axis=1), axis=0, return_counts=True)
    heir: dict[int, tuple[int, int]] = {}  # old id -> (places kept, component)
    for (old, number), count in zip(pairs.tolist(), counts.tolist(), strict=True):
        if old not in heir or count > heir[old][0]:
            heir[old] = (count, number)
    chosen: dict[int, tuple[int, int]] = {}  # component -> (places brought, old id)
    for old, (count, number) in sorted(heir.items()):
        if number not in chosen or count > chosen[number][0]:
            chosen[number] = (count, old)
    ids = np.empty(int(component.max(initial=-1)) + 1, dtype=np.int64)
    for number in range(len(ids)):
        if number in chosen:
            ids[number] = chosen[number][1]
        else:
            ids[number] = next_id
            next_id += 1
    return ids[component], next_id


def footprint_m2(positions_m: np.ndarray, radii_m: np.ndarray, cell_m: float) -> float:
    """Area of the union of discs (n, 2 or 3) with `radii_m` (n,), seen from above, counted on a grid of `cell_m`.

    Each disc covers, in each grid row it crosses, an interval of cell centres; intervals are added up as differences.
    """
    low = (positions_m[:, :2] - radii_m[:, None]).min(axis=0)
    x_cells, y_cells = ((positions_m[:, :2] - low) / cell_m).T.astype(np.float64)
    radii_cells = radii_m.astype(np.float64) / cell_m
    first_row = np.ceil(y_cells - radii_cells - 0.5).astype(np.int64)
    row_counts = np.maximum(np.floor(y_cells + radii_cells - 0.5).astype(np.int64) - first_row + 1, 0)
    disc = np.repeat(np.arange(len(radii_m)), row_counts)
    row = np.arange(len(disc)) - np.repeat(np.cumsum(row_counts) - row_counts, row_counts) + first_row[disc]
    half = np.sqrt(np.maximum(radii_cells[disc] ** 2 - (row + 0.5 - y_cells[disc]) ** 2, 0.0))
    start = np.ceil(x_cells[disc] - half - 0.5).astype(np.int64)
    stop = np.floor(x_cells[disc] + half - 0.5).astype(np.int64) + 1
    if not len(disc):
        return 0.0
    steps = np.zeros((row.max() + 1, max(stop.max(), start.max()) + 2), dtype=np.int32)
    np.add.at(steps, (row, start), 1)
    np.add.at(steps, (row, np.maximum(stop, start)), -1)
    return float((np.cumsum(steps, axis=1) > 0).sum() * cell_m**2)

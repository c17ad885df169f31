"""Local shape of the place graph: inclination against the horizontal, and how far it can be trusted (paper, Temporal
Aggregation and Geometric Descriptors; pure).

The neighbourhood N(p) of a place is every place within `neighbourhood_m` along the edges (eq. neighborhood_support).
The eigenvalues l1 >= l2 >= l3 of the covariance of its centres tell the shape. Where l2 is small against l1 the places
lie on a line, whose best plane could turn freely about it: there the inclination is that of the line, elsewhere that of
the plane. The world's z axis points up, so both are measured against gravity.
"""

import heapq
from typing import NamedTuple

import msgspec
import numpy as np

from prior_sg.services.compiled import compiled
from prior_sg.services.segmenter.core.map.received import ReceivedGraph, Step


class GeometryConfig(msgspec.Struct, frozen=True, kw_only=True):
    """What counts as the surface around a place; the paper leaves these values open."""

    neighbourhood_m: float = 2.0  # delta_max: reach of the neighbourhood along edges; about a flight of stairs
    saturation: float = 10.0  # N_sat: places at which half of the support is reached
    line_ratio: float = 0.1  # l2 / l1 below which a neighbourhood is a line

    def __post_init__(self) -> None:
        if not (self.neighbourhood_m > 0 and self.saturation > 0 and 0 <= self.line_ratio <= 1):
            raise ValueError("neighbourhood_m or saturation is not positive, or line_ratio not in [0, 1]")


class Shape(NamedTuple):
    """The geometric descriptor of some places."""

    inclination_rad: np.ndarray  # (place,) in [0, pi / 2]
    support: np.ndarray  # (place,) |N| / (|N| + N_sat)
    anisotropy: np.ndarray  # (place,) 1 - l3 / l1; 0 where all places coincide


def shape_of(graph: ReceivedGraph, rows: np.ndarray, cfg: GeometryConfig) -> Shape:
    """Shape around the places in `rows`."""
    near = graph.arcs
    counts, covariances = _moments(
        near.starts, near.neighbours, near.weights, graph.positions_m, rows, cfg.neighbourhood_m
    )
    values, vectors = np.linalg.eigh(covariances)  # ascending
    l1, l2, l3 = (np.maximum(values[:, axis], 0.0) for axis in (2, 1, 0))
    line = np.arcsin(np.clip(np.abs(vectors[:, 2, 2]), 0.0, 1.0))
    plane = np.arccos(np.clip(np.abs(vectors[:, 2, 0]), 0.0, 1.0))
    spread = l1 > np.finfo(float).eps
    return Shape(
        inclination_rad=np.where(spread, np.where(l2 < cfg.line_ratio * l1, line, plane), 0.0),
        support=counts / (counts + cfg.saturation),
        anisotropy=np.where(spread, 1.0 - l3 / np.where(spread, l1, 1.0), 0.0),
    )


def reach(graph: ReceivedGraph, rows: np.ndarray, limit_m: float) -> np.ndarray:
    """Rows of the places within `limit_m` along edges of any of `rows`, these included."""
    if not len(rows):
        return np.zeros(0, dtype=np.int64)
    near = graph.arcs
    return np.sort(_reach(near.starts, near.neighbours, near.weights, rows, limit_m))


def disturbed(before: ReceivedGraph, step: Step, limit_m: float) -> np.ndarray:
    """Mask (place,) of the places whose neighbourhood may differ from what it was before the step."""
    mask = np.zeros(len(step.graph.ids), dtype=bool)
    mask[reach(step.graph, np.flatnonzero(step.touched), limit_m)] = True
    if step.same_rows:
        mask[reach(before, np.flatnonzero(step.touched), limit_m)] = True
        return mask
    old = step.previous >= 0
    changed = np.concatenate((step.removed, step.previous[step.touched & old]))
    row_after = np.full(len(before.ids), -1)
    row_after[step.previous[old]] = np.flatnonzero(old)
    rows = row_after[reach(before, changed, limit_m)]
    mask[rows[rows >= 0]] = True
    return mask


@compiled()
def _moments(starts, neighbours, lengths_m, positions_m, rows, limit_m):  # noqa: ANN001, ANN202, PLR0917
    """Number of places (row,) and covariance of their centres (row, 3, 3) of each neighbourhood."""
    counts = np.zeros(len(rows), np.int64)
    covariances = np.zeros((len(rows), 3, 3))
    distances_m = np.full(len(starts) - 1, np.inf)
    for index in range(len(rows)):
        reached = _settle(starts, neighbours, lengths_m, rows[index : index + 1], limit_m, distances_m)
        mean = np.zeros(3)
        for row in reached:
            mean += positions_m[row]
        mean /= len(reached)
        for row in reached:
            offset = positions_m[row] - mean
            for i in range(3):
                for j in range(3):
                    covariances[index, i, j] += offset[i] * offset[j] / len(reached)
            distances_m[row] = np.inf
        counts[index] = len(reached)
    return counts, covariances


@compiled()
def _reach(starts, neighbours, lengths_m, rows, limit_m):  # noqa: ANN001, ANN202
    distances_m = np.full(len(starts) - 1, np.inf)
    return np.array(_settle(starts, neighbours, lengths_m, rows, limit_m, distances_m), np.int64)


@compiled()
def _settle(starts, neighbours, lengths_m, sources, limit_m, distances_m):  # noqa: ANN001, ANN202, PLR0917
    """Dijkstra from the sources up to the limit; returns each reached row once. `distances_m` starts at infinity and is
    left finite at the reached rows."""
    heap = [(0.0, np.int64(source)) for source in sources]
    reached = [np.int64(0) for _ in range(0)]
    for source in sources:
        if distances_m[source] == np.inf:
            distances_m[source] = 0.0
            reached.append(np.int64(source))
    while heap:
        distance_m, row = heapq.heappop(heap)
        if distance_m > distances_m[row]:
            continue
        for at in range(starts[row], starts[row + 1]):
            further_m = distance_m + lengths_m[at]
            other = neighbours[at]
            if further_m <= limit_m and further_m < distances_m[other]:
                if distances_m[other] == np.inf:
                    reached.append(np.int64(other))
                distances_m[other] = further_m
                heapq.heappush(heap, (further_m, np.int64(other)))
    return reached

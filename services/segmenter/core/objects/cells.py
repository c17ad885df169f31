"""Surfaces of objects as cells of a grid, each cell one integer (pure).

A detection's points, moved into the world, fill cells. A step along an axis adds a constant, so that neighbours are
found by search in sorted numbers; surfaces one cell apart count as the same.
"""

import numpy as np
import scipy

from prior_sg.schemas.objects import Detections
from prior_sg.services.compiled import compiled
from prior_sg.services.geometry import transform

AXIS_BITS = 21  # of a cell's number for each axis: 200 km of 0.1 m cells
_STEPS = np.stack(np.meshgrid(*[(-1, 0, 1)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
AROUND = (_STEPS[:, 0] << 2 * AXIS_BITS) + (_STEPS[:, 1] << AXIS_BITS) + _STEPS[:, 2]  # a cell and its 26 neighbours
COLUMNS = AROUND[_STEPS[:, 2] == 0]  # and the middles of the nine columns that these are


def packed(numbers: np.ndarray) -> np.ndarray:
    """Cell numbers (n, 3) as one integer each (n,), so that a step along an axis is a constant sum."""
    x, y, z = (numbers + (1 << AXIS_BITS - 1)).T
    return (x << 2 * AXIS_BITS) + (y << AXIS_BITS) + z


def unpacked(cells: np.ndarray) -> np.ndarray:
    """Inverse of `packed`."""
    mask = (1 << AXIS_BITS) - 1
    return np.stack((cells >> 2 * AXIS_BITS, cells >> AXIS_BITS & mask, cells & mask), 1) - (1 << AXIS_BITS - 1)


def bounds_of(cells: np.ndarray) -> np.ndarray:
    """Least and greatest numbers (2, 3) of some cells; of none, a box that is near nothing."""
    if not len(cells):
        return np.array([[1 << AXIS_BITS] * 3, [-(1 << AXIS_BITS)] * 3])
    numbers = unpacked(cells)
    return np.stack((numbers.min(axis=0), numbers.max(axis=0)))


def clouds_of(detections: Detections, cell_m: float) -> list[np.ndarray]:
    """The cells (cell,) that each detection's points fill in the world."""
    points_m = transform(detections.world_from_camera, detections.points_camera_m.astype(np.float64))
    clouds = np.split(_filled(points_m, cell_m), np.cumsum(detections.point_counts)[:-1])
    return [np.unique(cells) for cells in clouds[: len(detections.point_counts)]]


def cloud_of(detections: Detections, index: int, cell_m: float) -> np.ndarray:
    """The cells (cell,) of one detection."""
    end = int(detections.point_counts[: index + 1].sum())
    points_m = detections.points_camera_m[end - int(detections.point_counts[index]) : end]
    return np.unique(_filled(transform(detections.world_from_camera, points_m.astype(np.float64)), cell_m))


def _filled(points_m: np.ndarray, cell_m: float) -> np.ndarray:
    return packed(np.floor(points_m / cell_m).astype(np.int64))


def connected(cells: np.ndarray) -> list[np.ndarray]:
    """Cells (sorted) that touch each other, also at corners, the largest group first."""
    near = cells[:, None] + AROUND
    at = np.minimum(np.searchsorted(cells, near), len(cells) - 1)
    row, column = np.nonzero(cells[at] == near)
    links = scipy.sparse.csr_array((np.ones(len(row), bool), (row, at[row, column])), shape=(len(cells),) * 2)
    count, labels = scipy.sparse.csgraph.connected_components(links, directed=False)
    return sorted((cells[labels == part] for part in range(count)), key=len, reverse=True)


def shared(cells: np.ndarray, others: np.ndarray) -> float:
    """Share of the cells that are at most one cell from one of the others (both sorted)."""
    return count_near(cells, others, COLUMNS) / len(cells)


@compiled()
def count_near(cells: np.ndarray, others: np.ndarray, steps: np.ndarray) -> int:
    """How many of the cells have, at one of the steps from them, one of the others or its neighbour on the last axis.

    All int64 and sorted; a step along the last axis is 1.
    """
    count = 0
    for cell in cells:
        for step in steps:
            at = np.searchsorted(others, cell + step - 1)
            if at < len(others) and others[at] <= cell + step + 1:
                count += 1
                break
    return count

"""Where a person can stand and walk in a grid of voxels, on all levels, and the ways between.

The plane is divided into cells of CELL_M. A cell has up to LEVELS surfaces with HEADROOM_M above; two neighbouring ones
are joined where their heights differ by no more than a step, so that stairs join levels and tables do not.
"""

import heapq
from dataclasses import dataclass

import numpy as np

from prior_sg.services.compiled import compiled

CELL_M = 0.1
LEVELS = 6
HEADROOM_M = 1.75
STEP_M = 0.2
COMFORT_CELLS = 8  # a way keeps that far from obstacles where it can
NONE = -1


@dataclass(frozen=True)
class Ways:
    """The surfaces of a grid. Node i is surface i % LEVELS of cell (i // LEVELS) in row-major order."""

    heights: np.ndarray  # (x, y, LEVELS) int16: the first free voxel above each surface, NONE = no surface
    clearance: np.ndarray  # (x, y, LEVELS) uint8: cells to the nearest obstacle or drop, the cell itself counted
    origin_m: np.ndarray  # (3,)
    voxel_m: float

    def position_m(self, nodes: np.ndarray) -> np.ndarray:
        """Points (n, 3) on the ground."""
        cells, level = nodes // LEVELS, nodes % LEVELS
        i, j = np.divmod(cells, self.heights.shape[1])
        x, y = self.origin_m[0] + (i + 0.5) * CELL_M, self.origin_m[1] + (j + 0.5) * CELL_M
        return np.stack((x, y, self.origin_m[2] + self.heights[i, j, level] * self.voxel_m), axis=1)

    def reached(self, node: int, least_cells: int) -> np.ndarray:
        """Which nodes (flat, bool) one comes to from here, everywhere at least so many cells from obstacles."""
        return _flooded(self.heights, self.clearance, node, least_cells, round(STEP_M / self.voxel_m))

    def nearest(self, node: int, wanted: np.ndarray, least_cells: int) -> np.ndarray:
        """The way, as nodes, to the nearest of the wanted ones (flat, bool); empty where there is none."""
        limit = round(STEP_M / self.voxel_m)
        return _nearest(self.heights, self.clearance, node, wanted, least_cells, limit)


def ways_of(grid: np.ndarray, origin_m: np.ndarray, voxel_m: float) -> Ways:
    """Surfaces of a grid of matter (x, y, z)."""
    block = round(CELL_M / voxel_m)
    heights = _surfaces(grid, block, round(HEADROOM_M / voxel_m))
    clearance = _clearances(heights, round(STEP_M / voxel_m))
    return Ways(heights, clearance, origin_m, voxel_m)


@compiled()
def _surfaces(grid: np.ndarray, block: int, headroom: int) -> np.ndarray:
    nx, ny, nz = grid.shape[0] // block, grid.shape[1] // block, grid.shape[2]
    heights = np.full((nx, ny, LEVELS), NONE, np.int16)
    for i in range(nx):
        for j in range(ny):
            level, free = LEVELS, nz  # from above: open sky counts as free
            free = headroom
            for k in range(nz - 1, -1, -1):
                solid = False
                for a in range(i * block, (i + 1) * block):
                    for b in range(j * block, (j + 1) * block):
                        solid = solid or grid[a, b, k] != 0
                if not solid:
                    free += 1
                    continue
                if free >= headroom and level > 0 and k < nz - 1:
                    level -= 1
                    heights[i, j, level] = k + 1
                free = 0
    return heights


@compiled()
def _neighbour(heights: np.ndarray, i: int, j: int, height: int, limit: int) -> int:
    """The level of a cell that one steps to from a height, or NONE."""
    if i < 0 or j < 0 or i >= heights.shape[0] or j >= heights.shape[1]:
        return NONE
    for level in range(LEVELS):
        if heights[i, j, level] != NONE and abs(heights[i, j, level] - height) <= limit:
            return level
    return NONE


@compiled()
def _clearances(heights: np.ndarray, limit: int) -> np.ndarray:
    nx, ny, _ = heights.shape
    clearance = np.zeros(heights.shape, np.uint8)
    front = [(0, 0, 0) for _ in range(0)]
    for i in range(nx):
        for j in range(ny):
            for level in range(LEVELS):
                if heights[i, j, level] == NONE:
                    continue
                for a in range(i - 1, i + 2):
                    for b in range(j - 1, j + 2):
                        if _neighbour(heights, a, b, heights[i, j, level], limit) == NONE:
                            clearance[i, j, level] = 1
                if clearance[i, j, level] == 1:
                    front.append((i, j, level))
    distance = 1
    while len(front) > 0 and distance < 250:
        distance += 1
        following = [(0, 0, 0) for _ in range(0)]
        for i, j, level in front:
            for a in range(i - 1, i + 2):
                for b in range(j - 1, j + 2):
                    other = _neighbour(heights, a, b, heights[i, j, level], limit)
                    if other != NONE and clearance[a, b, other] == 0:
                        clearance[a, b, other] = distance
                        following.append((a, b, other))
        front = following
    return clearance


@compiled()
def _flooded(heights: np.ndarray, clearance: np.ndarray, node: int, least: int, limit: int) -> np.ndarray:
    ny = heights.shape[1]
    reached = np.zeros(heights.size, np.bool_)
    reached[node] = True
    front = [node]
    while len(front) > 0:
        here = front.pop()
        cell, level = here // LEVELS, here % LEVELS
        i, j = cell // ny, cell % ny
        for a in range(i - 1, i + 2):
            for b in range(j - 1, j + 2):
                other = _neighbour(heights, a, b, heights[i, j, level], limit)
                there = (a * ny + b) * LEVELS + other
                if other != NONE and clearance[a, b, other] >= least and not reached[there]:
                    reached[there] = True
                    front.append(there)
    return reached


@compiled()
def _nearest(  # noqa: PLR0917
    heights: np.ndarray, clearance: np.ndarray, node: int, wanted: np.ndarray, least: int, limit: int
) -> np.ndarray:
    ny = heights.shape[1]
    cost = np.full(heights.size, np.inf, np.float32)
    before = np.full(heights.size, NONE, np.int32)
    cost[node] = 0.0
    queue = [(np.float32(0.0), node)]
    here = NONE
    while len(queue) > 0:
        spent, here = heapq.heappop(queue)
        if wanted[here]:
            break
        if spent > cost[here]:
            continue
        cell, level = here // LEVELS, here % LEVELS
        i, j = cell // ny, cell % ny
        for a in range(i - 1, i + 2):
            for b in range(j - 1, j + 2):
                other = _neighbour(heights, a, b, heights[i, j, level], limit)
                if other == NONE or clearance[a, b, other] < least:
                    continue
                there = (a * ny + b) * LEVELS + other
                tight = max(0.0, 1.0 - clearance[a, b, other] / COMFORT_CELLS)
                length = 1.0 if a == i or b == j else 1.41421356
                total = np.float32(cost[here] + length * (1 + 2 * tight))
                if total < cost[there]:
                    cost[there] = total
                    before[there] = here
                    heapq.heappush(queue, (total, there))
    if here == NONE or not wanted[here]:
        return np.zeros(0, np.int64)
    backwards = [here]
    while backwards[-1] != node:
        backwards.append(before[backwards[-1]])
    way = np.zeros(len(backwards), np.int64)
    for k in range(len(backwards)):
        way[k] = backwards[len(backwards) - 1 - k]
    return way

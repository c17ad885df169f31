"""Regions and free space as nav_msgs/OccupancyGrid, from above (pure).

A cell belongs to the region whose places' spheres reach farthest beyond its middle, as on the live page's map: spheres
are taken 0.14 m larger, for they touch walls in single points. It is free where a sphere itself covers it, at that
place's height. What no sphere covers is unknown; a map of places knows no obstacles.

A grid's corner moves, and its sides grow, in steps of 2 m; cells double until there are no more than MOST_CELLS.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from prior_sg.deploy.ros import messages
from prior_sg.deploy.ros.messages import Classes
from prior_sg.deploy.viewing.footprint import PAD_M, STEP_M, height_field
from prior_sg.schemas.regions import NO_REGION
from prior_sg.schemas.scene import Scene

GRID = "nav_msgs/msg/OccupancyGrid"
MOST_CELLS = 4_000_000
UNKNOWN, FREE = -1, 0
MOST_VALUES = 100  # that a cell can have beside free and unknown


@dataclass(frozen=True)
class Layout:
    """Where the cells lie: (i, j) is along x and y from the corner."""

    corner_m: tuple[float, float]
    cell_m: float
    shape: tuple[int, int]


@dataclass(frozen=True)
class Ground:
    """What of the ground belongs to whom."""

    layout: Layout
    owners: np.ndarray  # (i, j) int64: region, NO_REGION = none
    free: np.ndarray  # (i, j) bool


def ground_of(scene: Scene, cell_m: float, heights_m: tuple[float, float] = (-np.inf, np.inf)) -> Ground:
    """The ground of the places whose middles lie between two heights."""
    z = scene.positions_m[:, 2]
    rows = np.flatnonzero((z >= heights_m[0]) & (z <= heights_m[1]))
    layout = layout_of(scene.positions_m[rows, :2], scene.radii_m[rows], cell_m)
    best, owners = np.full(layout.shape, 0.0, np.float32), np.full(layout.shape, NO_REGION, np.int64)
    free = np.zeros(layout.shape, bool)
    for region in np.unique(scene.place_regions[rows]).tolist():
        of = rows[scene.place_regions[rows] == region]
        window, field = _field(layout, scene.positions_m[of, :2].astype(np.float64), scene.radii_m[of])
        free[window] |= field > PAD_M
        wins = field > best[window]
        owners[window][wins] = region
        best[window][wins] = field[wins]
    return Ground(layout, owners, free)


def layout_of(positions_m: np.ndarray, radii_m: np.ndarray, cell_m: float) -> Layout:
    """Cells over discs (disc, 2), (disc,), of the size asked for or a power of two times it."""
    if not len(positions_m):
        return Layout((0.0, 0.0), cell_m, (1, 1))
    reach_m = radii_m.astype(np.float64)[:, None] + PAD_M
    low_m = np.floor((positions_m - reach_m).min(axis=0) / STEP_M) * STEP_M
    high_m = np.ceil((positions_m + reach_m).max(axis=0) / STEP_M) * STEP_M
    while np.prod(np.ceil((high_m - low_m) / cell_m)) > MOST_CELLS:
        cell_m *= 2
    across, along = np.ceil((high_m - low_m) / cell_m - 1e-9).astype(int).tolist()
    return Layout((float(low_m[0]), float(low_m[1])), cell_m, (max(across, 1), max(along, 1)))


def widened(ground: Ground, margin_m: float) -> Ground:
    """The same with a border that nobody owns."""
    border = int(np.ceil(margin_m / ground.layout.cell_m))
    x_m, y_m = (corner_m - border * ground.layout.cell_m for corner_m in ground.layout.corner_m)
    owners = np.pad(ground.owners, border, constant_values=NO_REGION)
    shape = owners.shape[0], owners.shape[1]
    return Ground(Layout((x_m, y_m), ground.layout.cell_m, shape), owners, np.pad(ground.free, border))


def _field(layout: Layout, positions_m: np.ndarray, radii_m: np.ndarray) -> tuple[tuple[slice, slice], np.ndarray]:
    """Over the window that some discs reach: by how much the farthest reaches beyond each cell's middle, metres."""
    at = (positions_m - layout.corner_m) / layout.cell_m - 0.5
    radii = (radii_m + PAD_M) / layout.cell_m
    low = np.maximum(np.floor((at - radii[:, None]).min(axis=0)).astype(int), 0)
    high = np.minimum(np.ceil((at + radii[:, None]).max(axis=0)).astype(int) + 1, layout.shape)
    field = height_field((int(high[0] - low[0]), int(high[1] - low[1])), at - low, radii)
    window = slice(int(low[0]), int(high[0])), slice(int(low[1]), int(high[1]))
    return window, field * np.float32(layout.cell_m)


class CellValues:
    """Gives regions the values 1 to 100, which they keep for life; one that is free again is taken last."""

    def __init__(self) -> None:
        self._values: dict[int, int] = {}
        self._free = list(range(1, MOST_VALUES + 1))

    def of(self, regions: Sequence[int]) -> dict[int, int]:
        """A value per region, the first served first; those that find none are left out."""
        there = set(regions)
        for region in [region for region in self._values if region not in there]:
            self._free.append(self._values.pop(region))
        for region in regions:
            if region not in self._values and self._free:
                self._values[region] = self._free.pop(0)
        return {region: self._values[region] for region in regions if region in self._values}


def region_cells(ground: Ground, values: Mapping[int, int]) -> np.ndarray:
    """Each cell's region by its value; FREE where free space, or a region without a value, is, else UNKNOWN (int8)."""
    unsaid = np.where(ground.free | (ground.owners != NO_REGION), FREE, UNKNOWN).astype(np.int8)
    return with_values(ground, values, unsaid)


def with_values(ground: Ground, values: Mapping[int, int], cells: np.ndarray) -> np.ndarray:
    """The cells (int8), those of some regions with their values."""
    if not values:
        return cells
    regions = np.array(sorted(values), np.int64)
    of_regions = np.array([values[region] for region in regions.tolist()], np.int8)
    at = np.minimum(np.searchsorted(regions, ground.owners), len(regions) - 1)
    return np.where(regions[at] == ground.owners, of_regions[at], cells)


def free_cells(ground: Ground) -> np.ndarray:
    """FREE or UNKNOWN (int8)."""
    return np.where(ground.free, FREE, UNKNOWN).astype(np.int8)


def occupancy_grid(classes: Classes, layout: Layout, cells: np.ndarray, frame: str) -> Any:
    """A grid of cells (i, j); the message has the rows along x, from the lowest y up. It has no stamp: it holds until
    the next, and one that says the same has the same bytes.
    """
    corner = messages.pose(classes, (*layout.corner_m, 0.0))
    load_time = messages.stamp(classes, messages.LATEST)
    about = classes["nav_msgs/msg/MapMetaData"](load_time, layout.cell_m, *layout.shape, corner)
    return classes[GRID](messages.header(classes, frame), about, np.ascontiguousarray(cells.T).reshape(-1))

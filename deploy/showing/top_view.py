"""The scene as seen from above, on a grid: free space by region, and how much of each column is wall.

World coordinates are turned by a quarter where the drawing asks for it.
"""

from dataclasses import dataclass

import numpy as np

from prior_sg.deploy.showing.colors import label_colors
from prior_sg.deploy.truth import voxel_owners
from prior_sg.schemas.places import VoxelMap
from prior_sg.schemas.scene import Scene

BAND_M = (0.3, 1.9)  # heights above the floor that make walls and walkable space
CEILING_GAP_M = 0.3
FURNITURE_SHARE, WALL_SHARE = 0.15, 0.7  # occupied part of a column within the band


@dataclass(frozen=True)
class Layers:
    """Top view on a grid: cell (i, j) is centred at (origin + (i, j) + 0.5) * cell_m of the drawing plane."""

    origin: np.ndarray  # (2,) int
    cell_m: float
    free: np.ndarray  # (i, j) bool
    walls: np.ndarray  # (i, j) share of the band that is occupied
    labels: np.ndarray  # (i, j) index into `shown_labels`, of the region that owns most of the column; -1 = none


def layers_of(scene: Scene, voxel_map: VoxelMap | None, turned: bool) -> Layers:
    """Walls and free space within the band; free columns are coloured by the places that own their voxels."""
    if voxel_map is None:
        voxel_m, occupied = 0.05, np.zeros((0, 3), int)
        places_m = np.concatenate((scene.positions_m[:, :2], np.full((len(scene.place_ids), 1), voxel_m / 2)), axis=1)
        free = _voxels_around(places_m, scene.radii_m, voxel_m)
    else:
        voxel_m, places_m = voxel_map.voxel_m, scene.positions_m
        low_m, high_m = _band(scene, voxel_map)
        free, occupied = (v[_between(v, voxel_m, low_m, high_m)] for v in (voxel_map.free, voxel_map.occupied))
    owners = voxel_owners(free, voxel_m, places_m, scene.radii_m)
    if voxel_map is None:
        free, owners = free[owners >= 0], owners[owners >= 0]
    return _columns(scene, voxel_m, _cells(free, turned), _cells(occupied, turned), owners)


def _columns(scene: Scene, cell_m: float, free: np.ndarray, occupied: np.ndarray, owners: np.ndarray) -> Layers:
    """Count voxels per cell: `free`, `occupied` are cells (n, 2) of the drawing plane, `owners` places of `free`."""
    cells = np.concatenate((free, occupied))
    if not len(cells):
        return Layers(np.zeros(2, int), cell_m, np.zeros((1, 1), bool), np.zeros((1, 1)), np.full((1, 1), -1))
    origin = cells.min(axis=0) - 1
    shape = tuple((cells.max(axis=0) - origin + 2).tolist())
    names, shown = {region.id: region.label for region in scene.regions}, shown_labels(scene)
    label_of_row = np.array([shown.index(names.get(region, "")) for region in scene.place_regions.tolist()] + [-1], int)
    votes = np.zeros((len(shown), *shape), np.int32)
    voters = owners >= 0
    np.add.at(votes, (label_of_row[owners[voters]], *(free[voters] - origin).T), 1)
    open_cells, walls = np.zeros(shape), np.zeros(shape)
    np.add.at(open_cells, tuple((free - origin).T), 1)
    np.add.at(walls, tuple((occupied - origin).T), 1)
    seen = walls + open_cells
    share = np.divide(walls, seen, out=np.zeros(shape), where=seen > 0)
    return Layers(origin, cell_m, open_cells > 0, share, np.where(votes.any(axis=0), votes.argmax(axis=0), -1))


def shown_labels(scene: Scene) -> list[str]:
    """Labels that may colour a cell; the empty one stands for places without a region."""
    return ["", *label_colors(scene)]


def _cells(voxels: np.ndarray, turned: bool) -> np.ndarray:
    return np.floor(plane(voxels + 0.5, turned)).astype(int)


def _voxels_around(places_m: np.ndarray, radii_m: np.ndarray, voxel_m: float) -> np.ndarray:
    """One flat layer of voxels (n, 3) that covers all discs."""
    if not len(places_m):
        return np.zeros((0, 3), int)
    low = np.floor((places_m[:, :2].min(axis=0) - radii_m.max()) / voxel_m).astype(int)
    high = np.ceil((places_m[:, :2].max(axis=0) + radii_m.max()) / voxel_m).astype(int)
    return np.stack([axis.ravel() for axis in np.mgrid[low[0] : high[0], low[1] : high[1], 0:1]], axis=1)


def _band(scene: Scene, voxel_map: VoxelMap) -> tuple[float, float]:
    """Heights that make the picture: above the floor, below the ceiling, found as the fullest occupied layers."""
    heights = np.concatenate((scene.trajectory[:, 2], scene.positions_m[:, 2]))
    if not len(heights) or not len(voxel_map.occupied):
        return -np.inf, np.inf
    middle_m = float(np.median(scene.trajectory[:, 2] if len(scene.trajectory) else heights))
    layers, counts = np.unique(voxel_map.occupied[:, 2], return_counts=True)
    layers_m = (layers + 0.5) * voxel_map.voxel_m
    below, above = layers_m < middle_m - BAND_M[0], layers_m > middle_m + BAND_M[0]
    floor_m = layers_m[below][counts[below].argmax()] if below.any() else middle_m - 1.5
    ceiling_m = layers_m[above][counts[above].argmax()] if above.any() else np.inf
    return floor_m + BAND_M[0], min(floor_m + BAND_M[1], max(ceiling_m - CEILING_GAP_M, middle_m))


def _between(voxels: np.ndarray, voxel_m: float, low_m: float, high_m: float) -> np.ndarray:
    z_m = (voxels[:, 2] + 0.5) * voxel_m
    return (z_m >= low_m) & (z_m <= high_m)


def plane(points: np.ndarray, turned: bool) -> np.ndarray:
    """World points (n, 2 or 3) in the drawing plane: x, y, or turned clockwise by a quarter."""
    x, y = np.asarray(points, float)[:, 0], np.asarray(points, float)[:, 1]
    return np.stack((y, -x) if turned else (x, y), axis=1)

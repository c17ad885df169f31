"""What follows from the map, renewed where labels changed: distances, places, edges, openings (pure)."""

import numpy as np

from prior_sg.services.place_graph.core.config import Config
from prior_sg.services.place_graph.core.ground import GroundGraph
from prior_sg.services.place_graph.core.skeleton import distance, places
from prior_sg.services.place_graph.core.skeleton.graph import Changes, PlaceGraph
from prior_sg.services.place_graph.core.state import State
from prior_sg.services.place_graph.core.volume import coarse
from prior_sg.services.place_graph.core.volume.grid import BLOCK, Box, VoxelGrid
from prior_sg.services.place_graph.core.volume.slicing import slices

TILE_VOXELS = 128  # side of the windows in which far-flung changes are worked off


def renew(state: State, changed: np.ndarray, cfg: Config) -> Changes:
    """Bring distances, places and edges up to date after the labels of the voxels (n, 3) changed."""
    if state.field is not state.grid:
        changed = coarse.renew_labels(state.grid, state.field, changed, cfg.coarseness)
    changes = Changes()
    if isinstance(state.graph, GroundGraph):
        for tiles in tile_groups(state.graph, changed, np.zeros(2), cfg):
            changes.add(renew_ground(state, state.graph, tiles, changed))
        return changes
    fields = [distance.refresh(state.field, tile, cfg.field_rules) for tile in _tiles(changed)]
    boxes = [box for box in fields if box is not None]
    for box in boxes:
        changes.add(_renewed_places(state.field, state.graph, box, cfg))
    for box in boxes:
        changes.opened |= state.openings.renew(state.field, state.graph, box)
    return changes


def tile_groups(graph: GroundGraph, changed: np.ndarray, camera_m: np.ndarray, cfg: Config) -> list[np.ndarray]:
    """The tiles (m, 2) that the voxels (n, 3) whose labels changed concern, in groups: at least one, maybe empty.

    As many tiles are in a group as cover the ground under as many blocks as a slice has, those nearest to the camera
    (2,) in the first.
    """
    if not len(changed):
        return [np.empty((0, 2), np.int64)]
    side = graph.ground.tile
    most = max(1, cfg.slice_blocks * BLOCK**2 // side**2)
    return slices(graph.concerned(changed), most, camera_m / (side * cfg.voxel_m))


def renew_ground(state: State, graph: GroundGraph, tiles: np.ndarray, changed: np.ndarray) -> Changes:
    """Bring some tiles (m, 2) up to date after the labels of the voxels (n, 3) changed, there and elsewhere."""
    if not len(tiles):
        return Changes()
    changes = graph.renew(state.grid, tiles)
    around = graph.box_of(tiles, Box(changed.min(axis=0), changed.max(axis=0) + 1))
    changes.opened |= state.openings.renew(state.grid, graph, around)
    return changes


def _tiles(changed: np.ndarray) -> list[np.ndarray]:
    """Voxels (n, 3) in groups that fit a window each."""
    if not len(changed):
        return []
    if (np.ptp(changed, axis=0) <= 2 * TILE_VOXELS).all():
        return [changed]
    _, group = np.unique(np.floor_divide(changed, TILE_VOXELS), axis=0, return_inverse=True)
    return [changed[group == number] for number in range(group.max() + 1)]


def _renewed_places(grid: VoxelGrid, graph: PlaceGraph, changed: Box, cfg: Config) -> Changes:
    cell_voxels = cfg.cell_voxels
    everything = places.whole_cells(grid.bounds, cell_voxels)
    # A changed group may win or lose a neighbour, one cell on, from or to a place one further. Places that touch lie up
    # to three cells apart: each has a group in the cell beside its own.
    region = places.whole_cells(changed, cell_voxels, 2).clipped(everything)
    window = region.grown(3 * cell_voxels).clipped(everything)
    return graph.update(grid, places.extract(grid, window, cfg.extraction_rules, region), region, changed)

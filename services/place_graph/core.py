"""The place graph of one robot: keyframes in, changes of the graph out (pure).

Hydra's 3D places (Hughes et al. 2022), kept up to date where the map changed: fuse the depth image, recompute distances
and the Voronoi diagram around changed voxels, re-extract places there, give them their old ids, and say what differs.
"""

from dataclasses import dataclass, field

import msgspec
import numpy as np

from schemas.frames import Keyframe, PoseUpdate
from schemas.places import PlaceDelta, VoxelMap
from services.place_graph import distance, places, tsdf
from services.place_graph.graph import Changes, PlaceGraph, Rules
from services.place_graph.grid import FREE, OCCUPIED, Box, VoxelGrid
from services.place_graph.published import Published

MAX_FIELD_VOXELS = 120  # offsets to the nearest obstacle are kept in 8 bits


class Config(msgspec.Struct, frozen=True, kw_only=True):
    """Hydra's parameters under Hydra's names; defaults of its habitat preset unless a comment says otherwise."""

    voxel_m: float = 0.1  # side of a voxel, of the map and of the Voronoi diagram; Hydra's diagram has 0.2
    truncation_m: float = 0.3  # the signed distance is clipped here, and nothing is fused farther behind a surface
    surface_voxels: float = 0.5  # a voxel whose signed distance is below this many voxels is an obstacle
    min_range_m: float = 0.2  # nearer measurements are the robot itself or noise
    max_range_m: float = 5.0  # nothing is fused farther from the camera; farther surfaces still clear what lies before
    max_weight: float = 1e5  # of one voxel's running mean
    max_distance_m: float = 3.0  # distances end here: half the height of the highest halls (Clio 3.0, habitat 4.5)
    voronoi_min_distance_m: float = 0.3  # the Voronoi diagram ends this close to obstacles
    parent_l1_separation: float = 20.0  # voxels: obstacles farther apart than this (L1) are distinct basis points ...
    parent_cos_angle_separation: float = 0.2  # ... and so are those seen under an angle with a smaller cosine
    compression_distance_m: float = 1.0  # side of the cells that become one place each
    min_node_distance_m: float = 0.4  # smallest radius of a place
    min_edge_distance_m: float = 0.2  # smallest clearance of an edge between touching places
    node_merge_distance_m: float = 0.5  # touching places nearer than this become one
    freespace_max_length_m: float = 2.0  # longest edge across free space
    freespace_min_clearance_m: float = 0.2  # smallest clearance of such an edge (habitat 0.5, uhumans2 0.2): doorways
    min_component_size: int = 3  # smaller connected parts of the graph are not published
    min_change_m: float = 0.01  # smaller changes of a position, radius or clearance are not published

    def __post_init__(self) -> None:
        if not 0 < self.voxel_m <= min(self.truncation_m, self.compression_distance_m):
            raise ValueError("voxel_m must be positive and at most truncation_m and compression_distance_m")
        if not self.max_distance_m / self.voxel_m <= MAX_FIELD_VOXELS:
            raise ValueError(f"max_distance_m may be at most {MAX_FIELD_VOXELS} voxels")
        if not 0 <= self.min_range_m < self.max_range_m:
            raise ValueError("min_range_m must be at least 0 and below max_range_m")

    def voxels(self, length_m: float) -> float:
        """A length in voxels."""
        return length_m / self.voxel_m

    @property
    def cell_voxels(self) -> int:
        """Voxels along one side of a compression cell."""
        return max(1, round(self.compression_distance_m / self.voxel_m))


@dataclass
class State:
    """Map and graph of one robot, and what its readers were told."""

    robot: str
    epoch: int
    graph: PlaceGraph
    grid: VoxelGrid = field(default_factory=VoxelGrid)
    published: Published = field(default_factory=Published)
    cameras_m: dict[int, tuple[float, float, float]] = field(default_factory=dict)  # of the keyframes seen, by frame id
    corrected: dict[int, np.ndarray] = field(default_factory=dict)  # newest pose given to a frame by an update
    rejected: int = 0  # keyframes that could not be used
    joined_frame_id: int = 0  # first keyframe heard live; earlier ones come from the archive
    revision: int = -1
    stamp_ns: int = 0
    frame_id: int = -1


def empty(robot: str, epoch: int, cfg: Config) -> State:
    """A map without observations."""
    rules = Rules(
        cell=cfg.cell_voxels,
        merge=cfg.voxels(cfg.node_merge_distance_m),
        edge=cfg.voxels(cfg.min_edge_distance_m),
        reach=cfg.voxels(cfg.freespace_max_length_m),
        free=cfg.voxels(cfg.freespace_min_clearance_m),
    )
    return State(robot, epoch, PlaceGraph(rules))


def integrate(state: State, keyframe: Keyframe, depth_m: np.ndarray, cfg: Config) -> PlaceDelta:
    """Fuse one keyframe with its decoded depth (h, w), metres, 0 = none, and return what changed in the place graph."""
    if (pose := state.corrected.get(keyframe.frame_id)) is not None:
        keyframe = msgspec.structs.replace(keyframe, world_from_camera=pose)
    changed = fuse(state, keyframe, depth_m, cfg)
    changes = refresh(state, changed, cfg) if changed is not None else Changes()
    return _publish(state, keyframe, changes, cfg)


def correct(state: State, update: PoseUpdate) -> None:
    """Take over corrected poses of keyframes that are still to come."""
    poses = zip(update.frame_ids.tolist(), np.array(update.world_from_camera), strict=True)
    state.corrected.update({i: pose for i, pose in poses if i not in state.cameras_m})


def reject(state: State, keyframe: Keyframe, cfg: Config) -> PlaceDelta:
    """Count a keyframe that cannot be used; the delta is empty."""
    state.rejected += 1
    return _publish(state, keyframe, Changes(), cfg)


def within_reach(keyframe: Keyframe, cfg: Config) -> bool:
    """Whether all that this keyframe may touch has voxel indices of 16 bits, as VoxelMap sends them."""
    reach_m = np.abs(keyframe.world_from_camera[:3, 3]).max() + 2 * cfg.max_range_m
    return bool(reach_m / cfg.voxel_m < np.iinfo(np.int16).max)


def fuse(state: State, keyframe: Keyframe, depth_m: np.ndarray, cfg: Config) -> Box | None:
    """Fuse a depth image into the map only; return the box of voxels whose label changed, if any."""
    return tsdf.integrate(
        state.grid,
        depth_m,
        keyframe.intrinsics,
        keyframe.world_from_camera,
        voxel_m=cfg.voxel_m,
        truncation_m=max(cfg.truncation_m, 2 * cfg.voxel_m),
        surface_m=cfg.surface_voxels * cfg.voxel_m,
        min_range_m=cfg.min_range_m,
        max_range_m=cfg.max_range_m,
        max_weight=cfg.max_weight,
    )


def refresh(state: State, changed: Box, cfg: Config) -> Changes:
    """Bring distances, places and edges up to date after voxel labels changed inside `changed`."""
    recomputed = distance.refresh(
        state.grid,
        changed,
        max_distance_voxels=cfg.voxels(cfg.max_distance_m),
        voronoi_min_voxels=cfg.voxels(cfg.voronoi_min_distance_m),
        parent_l1_voxels=cfg.parent_l1_separation,
        parent_cos=cfg.parent_cos_angle_separation,
    )
    cell_voxels = cfg.cell_voxels
    everything = places.whole_cells(state.grid.bounds, cell_voxels)
    # Merging looks one cell around a changed cell, and absorbed places one further: both must be seen whole.
    region = places.whole_cells(recomputed, cell_voxels, 1).clipped(everything)
    extraction = places.extract(
        state.grid,
        region.grown(2 * cell_voxels).clipped(everything),
        cell_voxels,
        cfg.voxels(cfg.min_node_distance_m) ** 2,
        cfg.voxels(cfg.node_merge_distance_m) ** 2,
    )
    return state.graph.update(state.grid, extraction, region)


def snapshot(state: State, cfg: Config) -> PlaceDelta:
    """Everything published so far as one delta, ids ascending, at the last revision."""
    fields = state.published.snapshot(cfg.voxel_m)
    return PlaceDelta(
        robot=state.robot,
        epoch=state.epoch,
        revision=state.revision,
        stamp_ns=state.stamp_ns,
        frame_id=state.frame_id,
        snapshot=True,
        past_frame_ids=np.array(sorted(state.cameras_m), np.int64),
        past_cameras_m=np.array([state.cameras_m[i] for i in sorted(state.cameras_m)], np.float32).reshape(-1, 3),
        **fields,
    )


def voxel_map(state: State, cfg: Config) -> VoxelMap:
    """Free and occupied voxels, in ascending order."""
    free, occupied = (state.grid.voxels_with(label).astype(np.int16) for label in (FREE, OCCUPIED))
    return VoxelMap(robot=state.robot, voxel_m=cfg.voxel_m, free=free, occupied=occupied)


def _publish(state: State, keyframe: Keyframe, changes: Changes, cfg: Config) -> PlaceDelta:
    """The delta of one keyframe; it has the next revision also when it is empty."""
    state.revision += 1
    state.stamp_ns, state.frame_id = keyframe.stamp_ns, keyframe.frame_id
    x, y, z = keyframe.world_from_camera[:3, 3].tolist()
    state.cameras_m[keyframe.frame_id] = (x, y, z)
    fields = state.published.update(state.graph, changes, cfg.voxel_m, cfg.min_component_size, cfg.min_change_m)
    return PlaceDelta(
        robot=state.robot,
        epoch=state.epoch,
        revision=state.revision,
        stamp_ns=keyframe.stamp_ns,
        frame_id=keyframe.frame_id,
        camera_m=(x, y, z),
        **fields,
    )

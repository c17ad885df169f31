"""The place graph of one robot: keyframes in, changes of the graph out (pure).

Hydra's 3D places (Hughes et al. 2022), kept up to date where the map changed: fuse the depth image, repair distances
and the Voronoi diagram around changed voxels, extract places there again, give them their old ids, say what differs.
Or its 2D places, pieces of ground, which need the map only.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from prior_sg.schemas.frames import Keyframe, PoseUpdate
from prior_sg.schemas.places import PlaceDelta, VoxelMap
from prior_sg.services import images
from prior_sg.services.place_graph.core.archive import Archive, Kept, moved
from prior_sg.services.place_graph.core.config import Config
from prior_sg.services.place_graph.core.ground import GroundGraph, GroundRules
from prior_sg.services.place_graph.core.ledger import Published
from prior_sg.services.place_graph.core.openings import Openings
from prior_sg.services.place_graph.core.skeleton import distance, places
from prior_sg.services.place_graph.core.skeleton.graph import Changes, PlaceGraph, Rules
from prior_sg.services.place_graph.core.trajectory import Track
from prior_sg.services.place_graph.core.volume import tsdf
from prior_sg.services.place_graph.core.volume.grid import BLOCK, FREE, OCCUPIED, Box, VoxelGrid

TILE_VOXELS = 128  # side of the windows in which far-flung changes are worked off


@dataclass
class State:
    """Map and graph of one robot, and what its readers were told."""

    robot: str
    epoch: int
    graph: PlaceGraph
    archive: Archive
    openings: Openings
    grid: VoxelGrid = field(default_factory=VoxelGrid)
    published: Published = field(default_factory=Published)
    track: Track = field(default_factory=Track)
    cameras_m: dict[int, tuple[float, float, float]] = field(default_factory=dict)  # by frame id, of those fused
    seen: set[int] = field(default_factory=set)  # frame ids of all keyframes, also the refused
    corrected: dict[int, np.ndarray] = field(default_factory=dict)  # newest pose given to a frame by an update
    updates: dict[int, int] = field(default_factory=dict)  # newest revision of pose updates, by epoch
    rejected: int = 0  # keyframes that could not be used
    joined_frame_id: int = 0  # first keyframe heard live; earlier ones come from the archive
    revision: int = -1
    stamp_ns: int = 0
    frame_id: int = -1
    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of the world, as the newest keyframe says


def empty(robot: str, epoch: int, cfg: Config) -> State:
    """A map without observations."""
    openings = Openings(int(1.5 * cfg.cell_voxels))
    return State(robot, epoch, _no_places(cfg), Archive(cfg.archive_mb * 1e6), openings)


def _no_places(cfg: Config) -> PlaceGraph:
    if cfg.places == "2d":
        return GroundGraph(
            GroundRules(
                clearance=round(cfg.voxels(cfg.surface_min_clearance_m)),
                step=max(1, round(cfg.voxels(cfg.surface_max_step_m))),
                slope=cfg.surface_max_slope,
                piece=cfg.voxels(cfg.pure_final_place_size_m),
                points=cfg.min_final_place_points,
                cluster=round(cfg.min_cluster_area_m2 / cfg.voxel_m**2),
                overlap=cfg.voxels(cfg.place_overlap_threshold_m),
                rise=cfg.voxels(cfg.place_max_neighbor_z_diff_m),
            )
        )
    rules = Rules(
        cell=cfg.cell_voxels,
        merge=cfg.voxels(cfg.node_merge_distance_m),
        edge=cfg.voxels(cfg.min_edge_distance_m),
        reach=cfg.voxels(cfg.freespace_max_length_m) if cfg.add_freespace_edges else 0.0,
        free=cfg.voxels(cfg.freespace_min_clearance_m),
        check=cfg.freespace_num_nodes_to_check,
        find=cfg.freespace_num_neighbors_to_find,
        overlap=cfg.voxels(cfg.overlap_min_clearance_m),
        overlap_check=cfg.overlap_num_neighbors_to_check if cfg.add_overlap_edges else 0,
    )
    return PlaceGraph(rules)


def integrate(state: State, keyframe: Keyframe, cfg: Config) -> PlaceDelta:
    """Fuse one keyframe and return what changed in the place graph.

    A keyframe that cannot be used leaves the map as it is; the delta's `event` says why. One whose pose has jumped is
    kept, for a pose update or the keyframes that follow may show where it was taken.
    """
    keyframe = moved(keyframe, state.corrected.get(keyframe.frame_id, keyframe.world_from_camera))
    try:
        depth_m = _usable_depth(keyframe, cfg)
    except images.ImageFault as fault:
        return reject(state, keyframe, str(fault), cfg)
    jump_m = 0.0 if keyframe.frame_id in state.corrected else state.track.jump_m(keyframe, cfg.bounds)
    if jump_m and (reason := _distrust(state, keyframe, depth_m, jump_m, cfg)):
        state.archive.put(keyframe, fused=False)
        return reject(state, keyframe, reason, cfg)
    state.origin_m = keyframe.origin_m
    event = _order(state, keyframe)
    changed = [_fuse_kept(state, keyframe, depth_m, cfg)]
    if jump_m:
        event = f"believed again at keyframe {keyframe.frame_id}: the pose stays where it jumped to and fits the map"
        changed += _fuse_doubted(state, cfg)
    state.track.believe(keyframe)
    changes = refresh(state, np.concatenate(changed), cfg)
    _leave_behind(state, keyframe, cfg)
    return _publish(state, keyframe, changes, cfg, event)


def correct(state: State, update: PoseUpdate, cfg: Config) -> PlaceDelta | None:
    """Move keyframes to their corrected poses: the map becomes what it would be, had these poses been known.

    None when the update has been seen before. Keyframes that are still to come are moved when they come; those that
    the archive no longer holds stay where they are, which the delta's `event` says.
    """
    if update.revision <= state.updates.get(update.epoch, -1):
        return None
    state.updates[update.epoch] = update.revision
    poses = dict(zip(update.frame_ids.tolist(), np.array(update.world_from_camera), strict=True))
    state.corrected.update(poses)
    changed = [np.empty((0, 3), np.int64)]
    moved_ids, lost = [], 0
    for frame_id, pose in sorted(poses.items()):
        kept = state.archive.get(frame_id)
        if kept is not None:
            changed += _move(state, kept, pose, cfg)
            moved_ids.append(frame_id)
        elif frame_id in state.cameras_m:
            lost += 1
    changed += _reconsidered(state, cfg)
    event = f"{lost} of {len(poses)} keyframes are no longer archived and keep their poses" if lost else ""
    changes = refresh(state, np.concatenate(changed), cfg)
    return _delta(state, changes, cfg, stamp_ns=update.stamp_ns, event=event, moved_ids=moved_ids)


def reject(state: State, keyframe: Keyframe, reason: str, cfg: Config) -> PlaceDelta:
    """Count a keyframe that cannot be used; the delta says why and changes nothing."""
    state.rejected += 1
    event = f"keyframe {keyframe.frame_id} refused: {reason}"
    state.stamp_ns, state.frame_id = max(state.stamp_ns, keyframe.stamp_ns), keyframe.frame_id
    state.seen.add(keyframe.frame_id)
    return _delta(state, Changes(), cfg, stamp_ns=keyframe.stamp_ns, event=event)


def fuse(state: State, keyframe: Keyframe, depth_m: np.ndarray, cfg: Config, sign: int = tsdf.ADD) -> np.ndarray:
    """Fuse a depth image into the map only, or take it out; return the voxels (n, 3) whose label changed."""
    view = tsdf.View(depth_m, keyframe.intrinsics, keyframe.world_from_camera)
    return tsdf.integrate(state.grid, view, cfg.fusion, sign)


def refresh(state: State, changed: np.ndarray, cfg: Config) -> Changes:
    """Bring distances, places and edges up to date after the labels of the voxels (n, 3) changed."""
    changes = Changes()
    if isinstance(state.graph, GroundGraph):
        boxes: list[Box] = [Box(part.min(axis=0), part.max(axis=0) + 1) for part in _tiles(changed)]
        for box in boxes:
            changes.add(state.graph.renew(state.grid, box))
    else:
        fields = [_renewed_field(state, part, cfg) for part in _tiles(changed)]
        boxes = [box for box in fields if box is not None]
        for box in boxes:
            changes.add(_renewed_places(state, state.graph, box, cfg))
    for box in boxes:
        changes.opened |= state.openings.renew(state.grid, state.graph, box)
    return changes


def snapshot(state: State, cfg: Config) -> PlaceDelta:
    """Everything published so far as one delta, ids ascending, at the last revision."""
    fields = state.published.snapshot(cfg.voxel_m) | state.openings.all(cfg.voxel_m)
    if isinstance(state.graph, GroundGraph):
        fields |= state.graph.tell(state.published.places, cfg.voxel_m)
    return PlaceDelta(
        robot=state.robot,
        epoch=state.epoch,
        revision=state.revision,
        stamp_ns=state.stamp_ns,
        frame_id=state.frame_id,
        snapshot=True,
        origin_m=state.origin_m,
        **_cameras(state, sorted(state.cameras_m)),
        **fields,
    )


def voxel_map(state: State, cfg: Config) -> VoxelMap:
    """Free and occupied voxels, in ascending order."""
    free, occupied = (state.grid.voxels_with(label).astype(np.int16) for label in (FREE, OCCUPIED))
    return VoxelMap(robot=state.robot, voxel_m=cfg.voxel_m, free=free, occupied=occupied)


def _usable_depth(keyframe: Keyframe, cfg: Config) -> np.ndarray:
    """Its depth, if all that it may touch has voxel indices of 16 bits, as VoxelMap sends them. Raises ImageFault."""
    reach_m = np.abs(keyframe.world_from_camera[:3, 3]).max() + 2 * cfg.max_range_m
    if not reach_m / cfg.voxel_m < np.iinfo(np.int16).max:
        raise images.ImageFault(f"its camera is {reach_m:.0f} m from the origin, farther than voxel indices reach")
    return images.depth_of(keyframe, cfg.max_principal_offset)


def _distrust(state: State, keyframe: Keyframe, depth_m: np.ndarray, jump_m: float, cfg: Config) -> str:
    """Why a keyframe whose pose has jumped cannot be believed; empty when it can."""
    reason = f"its pose jumps by {jump_m:.2f} m"
    view = tsdf.View(depth_m, keyframe.intrinsics, keyframe.world_from_camera)
    state.track.doubt(keyframe, cfg.bounds, tsdf.contradiction(state.grid, view, cfg.fusion))
    latest = state.track.contradictions[-cfg.relocalised_after :]
    if len(latest) < cfg.relocalised_after:
        return reason
    share = float(np.mean(latest))
    return f"{reason}, and {share:.0%} of the depth contradicts the map" if share > cfg.max_contradiction else ""


def _order(state: State, keyframe: Keyframe) -> str:
    """What to say of a keyframe that is late; the map does not mind the order."""
    if state.joined_frame_id and keyframe.frame_id < state.joined_frame_id:
        return ""  # fetched from the archive
    late_s = (state.track.newest_ns - keyframe.stamp_ns) / 1e9
    return f"keyframe {keyframe.frame_id} is out of order by {late_s:.3f} s; fused all the same" if late_s > 0 else ""


def _fuse_kept(state: State, keyframe: Keyframe, depth_m: np.ndarray, cfg: Config) -> np.ndarray:
    """Fuse a keyframe and keep it for pose updates; returns the voxels (n, 3) whose label changed."""
    state.archive.put(keyframe, fused=True)
    _remember(state, keyframe)
    return fuse(state, keyframe, depth_m, cfg)


def _fuse_doubted(state: State, cfg: Config) -> Iterator[np.ndarray]:
    """Fuse the keyframes of a jump that has turned out to be right."""
    for frame_id in state.track.astray_ids():
        kept = state.archive.get(frame_id)
        if kept is not None and not kept.fused:
            state.track.correct(kept.keyframe)
            yield _fuse_kept(state, kept.keyframe, images.depth_of(kept.keyframe, cfg.max_principal_offset), cfg)


def _reconsidered(state: State, cfg: Config) -> Iterator[np.ndarray]:
    """Fuse keyframes that were refused beside wrong poses and fit the corrected ones."""
    for keyframe in list(state.archive.unfused()):
        if not state.track.jump_m(keyframe, cfg.bounds):
            state.track.believe(keyframe)
            yield _fuse_kept(state, keyframe, images.depth_of(keyframe, cfg.max_principal_offset), cfg)


def _move(state: State, kept: Kept, world_from_camera: np.ndarray, cfg: Config) -> Iterator[np.ndarray]:
    """Take an archived keyframe out of the map and fuse it from elsewhere; yields the voxels whose label changed."""
    there = moved(kept.keyframe, world_from_camera)
    if kept.fused and (there.world_from_camera == kept.keyframe.world_from_camera).all():
        return
    depth_m = images.depth_of(kept.keyframe, cfg.max_principal_offset)
    if kept.fused:
        yield fuse(state, kept.keyframe, depth_m, cfg, tsdf.REMOVE)
    yield _fuse_kept(state, there, depth_m, cfg)
    state.track.correct(there)


def _leave_behind(state: State, keyframe: Keyframe, cfg: Config) -> None:
    """Compress what is far from the camera; where even that must be dropped, its places freeze."""
    center = keyframe.world_from_camera[:3, 3] / cfg.voxel_m
    for key in state.grid.leave(center, cfg.voxels(cfg.map_window_max_radius_m), cfg.map_mb * 1e6):
        low = np.array(key, np.int64) * BLOCK
        state.graph.freeze(Box(low, low + BLOCK))


def _remember(state: State, keyframe: Keyframe) -> None:
    x, y, z = keyframe.world_from_camera[:3, 3].tolist()
    state.cameras_m[keyframe.frame_id] = (x, y, z)
    state.seen.add(keyframe.frame_id)


def _tiles(changed: np.ndarray) -> list[np.ndarray]:
    """Voxels (n, 3) in groups that fit a window each."""
    if not len(changed):
        return []
    if (np.ptp(changed, axis=0) <= 2 * TILE_VOXELS).all():
        return [changed]
    _, group = np.unique(np.floor_divide(changed, TILE_VOXELS), axis=0, return_inverse=True)
    return [changed[group == number] for number in range(group.max() + 1)]


def _renewed_field(state: State, changed: np.ndarray, cfg: Config) -> Box | None:
    return distance.refresh(
        state.grid,
        changed,
        max_distance_voxels=cfg.voxels(cfg.max_distance_m),
        voronoi_min_voxels=cfg.voxels(max(cfg.voronoi_min_distance_m, cfg.min_distance_m)),
        parent_l1_voxels=cfg.parent_l1_separation,
        parent_cos=cfg.parent_cos_angle_separation,
    )


def _renewed_places(state: State, graph: PlaceGraph, changed: Box, cfg: Config) -> Changes:
    cell_voxels = cfg.cell_voxels
    everything = places.whole_cells(state.grid.bounds, cell_voxels)
    # A changed group may win or lose a neighbour, one cell on, from or to a place one further. Places that touch lie up
    # to three cells apart: each has a group in the cell beside its own.
    region = places.whole_cells(changed, cell_voxels, 2).clipped(everything)
    extraction = places.extract(
        state.grid,
        region.grown(3 * cell_voxels).clipped(everything),
        cell_voxels,
        cfg.voxels(cfg.min_node_distance_m) ** 2,
        cfg.voxels(cfg.node_merge_distance_m) ** 2,
        cfg.merge_policy == "distance",
    )
    return graph.update(state.grid, extraction, region, changed)


def _publish(state: State, keyframe: Keyframe, changes: Changes, cfg: Config, event: str) -> PlaceDelta:
    """The delta of one keyframe; it has the next revision also when it is empty."""
    state.stamp_ns, state.frame_id = max(state.stamp_ns, keyframe.stamp_ns), keyframe.frame_id
    return _delta(
        state,
        changes,
        cfg,
        stamp_ns=keyframe.stamp_ns,
        event=event,
        camera_m=state.cameras_m[keyframe.frame_id],
    )


def _delta(
    state: State,
    changes: Changes,
    cfg: Config,
    *,
    stamp_ns: int,
    event: str,
    camera_m: tuple[float, float, float] | None = None,
    moved_ids: Sequence[int] = (),
) -> PlaceDelta:
    state.revision += 1
    fields = state.published.update(state.graph, changes, cfg.voxel_m, cfg.min_component_size, cfg.min_diff_m)
    shown = state.published.places
    gone = (*fields["removed_ids"].tolist(), *fields["merged_ids"][:, 0].tolist())
    looked_at = changes.opened.union(fields["place_ids"].tolist(), gone)
    fields |= state.openings.tell(looked_at, shown, cfg.voxel_m, cfg.frontier_min_area_m2)
    if isinstance(state.graph, GroundGraph):
        fields |= state.graph.tell(shown.keys() & changes.touched.union(fields["place_ids"].tolist()), cfg.voxel_m)
    state.openings.forget(i for i in changes.touched if i not in state.graph.places)
    return PlaceDelta(
        robot=state.robot,
        epoch=state.epoch,
        revision=state.revision,
        stamp_ns=stamp_ns,
        frame_id=state.frame_id,
        camera_m=camera_m,
        event=event,
        origin_m=state.origin_m,
        **_cameras(state, moved_ids),
        **fields,
    )


def _cameras(state: State, frame_ids: Sequence[int]) -> dict[str, Any]:
    return {
        "past_frame_ids": np.array(frame_ids, np.int64),
        "past_cameras_m": np.array([state.cameras_m[i] for i in frame_ids], np.float32).reshape(-1, 3),
    }

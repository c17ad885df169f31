"""What readers are told of the map: changes, everything, or the voxels themselves (pure)."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from prior_sg.schemas.places import PlaceDelta, VoxelMap
from prior_sg.services.place_graph.core.columns import CameraColumns, GroundColumns, Heading, no_ground, place_delta
from prior_sg.services.place_graph.core.config import Config
from prior_sg.services.place_graph.core.ground import GroundGraph
from prior_sg.services.place_graph.core.skeleton.graph import Changes
from prior_sg.services.place_graph.core.state import State
from prior_sg.services.place_graph.core.volume.grid import FREE, OCCUPIED


class Cause(NamedTuple):
    """What a delta follows from."""

    stamp_ns: int
    event: str = ""
    camera_m: tuple[float, float, float] | None = None  # of the keyframe
    moved_ids: Sequence[int] = ()  # keyframes whose cameras an update moved


def publish(state: State, changes: Changes, cfg: Config, cause: Cause) -> PlaceDelta:
    """The delta that follows from `changes`; it has the next revision also when it is empty."""
    state.revision += 1
    graph = state.ledger.update(state.graph, changes, cfg.graph_voxel_m, cfg.min_component_size, cfg.min_diff_m)
    shown, told_ids = state.ledger.places, graph.places.place_ids.tolist()
    looked_at = changes.opened.union(told_ids, graph.gone.place_ids)
    openings = state.openings.update(looked_at, shown, cfg.graph_voxel_m, cfg.frontier_min_area_m2)
    state.openings.forget(i for i in changes.touched if i not in state.graph.places)
    return place_delta(
        _heading(state)._replace(stamp_ns=cause.stamp_ns, camera_m=cause.camera_m, event=cause.event),
        graph,
        openings,
        _shapes(state, shown.keys() & changes.touched.union(told_ids), cfg),
        _cameras(state, cause.moved_ids),
    )


def snapshot(state: State, cfg: Config) -> PlaceDelta:
    """Everything published so far as one delta, ids ascending, at the last revision; it follows from all keyframes so
    far, of which an older one may have come last, from an archive."""
    return place_delta(
        _heading(state)._replace(snapshot=True, frame_id=max(state.seen, default=-1)),
        state.ledger.snapshot(cfg.graph_voxel_m),
        state.openings.snapshot(cfg.graph_voxel_m),
        _shapes(state, state.ledger.places, cfg),
        _cameras(state, sorted(state.cameras_m)),
    )


def voxel_map(state: State, cfg: Config) -> VoxelMap:
    """Free and occupied voxels, in ascending order."""
    free, occupied = (state.grid.voxels_with(label).astype(np.int16) for label in (FREE, OCCUPIED))
    return VoxelMap(robot=state.robot, voxel_m=cfg.voxel_m, free=free, occupied=occupied)


def _heading(state: State) -> Heading:
    return Heading(state.robot, state.epoch, state.revision, state.stamp_ns, state.frame_id, origin_m=state.origin_m)


def _shapes(state: State, ids: Iterable[int], cfg: Config) -> GroundColumns:
    return state.graph.shapes(ids, cfg.graph_voxel_m) if isinstance(state.graph, GroundGraph) else no_ground()


def _cameras(state: State, frame_ids: Sequence[int]) -> CameraColumns:
    return CameraColumns(
        past_frame_ids=np.array(frame_ids, np.int64),
        past_cameras_m=np.array([state.cameras_m[i] for i in frame_ids], np.float32).reshape(-1, 3),
    )

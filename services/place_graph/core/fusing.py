"""Keyframes into the map and out of it again; what each changes is the voxels (n, 3) whose label changed (pure)."""

from collections.abc import Iterator

import numpy as np

from prior_sg.schemas.frames import Keyframe
from prior_sg.services import images
from prior_sg.services.place_graph.core.archive import Kept, moved
from prior_sg.services.place_graph.core.config import Config
from prior_sg.services.place_graph.core.state import State
from prior_sg.services.place_graph.core.volume import tsdf
from prior_sg.services.place_graph.core.volume.grid import BLOCK, Box


def fuse(state: State, keyframe: Keyframe, depth_m: np.ndarray, cfg: Config, sign: int = tsdf.ADD) -> np.ndarray:
    """Fuse a depth image into the map only, or take it out; return the voxels (n, 3) whose label changed."""
    view = tsdf.View(depth_m, keyframe.intrinsics, keyframe.world_from_camera)
    return tsdf.integrate(state.grid, view, cfg.fusion, sign)


def fuse_and_keep(state: State, keyframe: Keyframe, depth_m: np.ndarray, cfg: Config) -> np.ndarray:
    """Fuse a keyframe and keep it for pose updates; returns the voxels (n, 3) whose label changed."""
    state.archive.put(keyframe, fused=True)
    x, y, z = keyframe.world_from_camera[:3, 3].tolist()
    state.cameras_m[keyframe.frame_id] = (x, y, z)
    return fuse(state, keyframe, depth_m, cfg)


def fuse_doubted(state: State, latest: Keyframe, cfg: Config) -> Iterator[np.ndarray]:
    """Fuse the keyframes of a jump that has turned out to be right with the latest one of their camera."""
    for frame_id in state.trajectory.astray_ids(latest):
        kept = state.archive.get(frame_id)
        if kept is not None and not kept.fused:
            state.trajectory.correct(kept.keyframe)
            yield _fuse_kept(state, kept.keyframe, cfg)


def fuse_reconsidered(state: State, cfg: Config) -> Iterator[np.ndarray]:
    """Fuse keyframes that were refused beside wrong poses and fit the corrected ones."""
    for keyframe in list(state.archive.unfused()):
        if not state.trajectory.jump_m(keyframe, cfg.bounds):
            state.trajectory.believe(keyframe)
            yield _fuse_kept(state, keyframe, cfg)


def move(state: State, kept: Kept, world_from_camera: np.ndarray, cfg: Config) -> Iterator[np.ndarray]:
    """Take an archived keyframe out of the map and fuse it from elsewhere; yields the voxels whose label changed."""
    there = moved(kept.keyframe, world_from_camera)
    if kept.fused and (there.world_from_camera == kept.keyframe.world_from_camera).all():
        return
    depth_m = images.depth_of(kept.keyframe, cfg.max_principal_offset)
    if kept.fused:
        yield fuse(state, kept.keyframe, depth_m, cfg, tsdf.REMOVE)
    yield fuse_and_keep(state, there, depth_m, cfg)
    state.trajectory.correct(there)


def leave_behind(state: State, keyframe: Keyframe, cfg: Config) -> None:
    """Compress what is far from the camera; where even that must be dropped, its places freeze."""
    center_m, radius_m = keyframe.world_from_camera[:3, 3], cfg.map_window_max_radius_m
    limit_bytes = cfg.map_mb * 1e6
    if state.field is not state.grid:
        state.field.leave(center_m / cfg.graph_voxel_m, cfg.voxels(radius_m), np.inf)
        limit_bytes -= state.field.size_bytes
    for key in state.grid.leave(center_m / cfg.voxel_m, radius_m / cfg.voxel_m, limit_bytes):
        low = np.array(key, np.int64) * BLOCK
        dropped = Box(low // cfg.coarseness, (low + BLOCK) // cfg.coarseness)
        state.graph.freeze(dropped)
        if state.field is not state.grid:
            state.field.forget(dropped)


def _fuse_kept(state: State, keyframe: Keyframe, cfg: Config) -> np.ndarray:
    return fuse_and_keep(state, keyframe, images.depth_of(keyframe, cfg.max_principal_offset), cfg)

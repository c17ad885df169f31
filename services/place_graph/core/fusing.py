"""Keyframes into the map and out of it again; what each changes is the voxels (n, 3) whose label changed (pure)."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from prior_sg.schemas.frames import Keyframe
from prior_sg.services import images
from prior_sg.services.place_graph.core.archive import Kept, moved
from prior_sg.services.place_graph.core.config import Config
from prior_sg.services.place_graph.core.state import State
from prior_sg.services.place_graph.core.volume import tsdf
from prior_sg.services.place_graph.core.volume.grid import BLOCK, FAR_D2, UNKNOWN_D2, Box, VoxelGrid
from prior_sg.services.place_graph.core.volume.slicing import halved, slices

PORTIONS = 8  # of a slice, after each of which one asks whether too much follows from it
# Voxels whose distances are looked at again for each that changes: per one that was an obstacle, and per squared
# distance of one that was free (what steps of `world:campus:20`, seen 100 m far, took).
LEAVES_VOXELS, ENTERS_VOXELS = 75.0, 2.0


class Slice(NamedTuple):
    """A part of the work on a view: some of the blocks (n, 3) that it concerns."""

    view: tsdf.View
    blocks: np.ndarray


def fuse(state: State, keyframe: Keyframe, depth_m: np.ndarray, cfg: Config, sign: int = tsdf.ADD) -> np.ndarray:
    """Fuse a depth image into the map only, or take it out; return the voxels (n, 3) whose label changed."""
    view = tsdf.View(depth_m, keyframe.intrinsics, keyframe.world_from_camera)
    return tsdf.integrate(state.grid, view, cfg.fusion, tsdf.blocks_of(view, cfg.fusion), sign)


def fuse_slice(state: State, part: Slice, cfg: Config) -> np.ndarray:
    """Fuse one slice; returns the voxels (n, 3) whose label changed."""
    return tsdf.integrate(state.grid, part.view, cfg.fusion, part.blocks)


def fuse_slices(state: State, work: list[Slice], cfg: Config) -> Iterator[tuple[np.ndarray, bool]]:
    """Fuse slices; yields the voxels (n, 3) whose label changed when they are to be followed up, and whether all is
    fused.

    They are after each slice, and amid one of several from which more follows than `Config.most_voxels`.
    """
    for number, part in enumerate(work, 1):
        portions = halved(part.blocks, max(1, cfg.most_blocks // PORTIONS)) if len(work) > 1 else [part.blocks]
        found, expected = [], 0.0
        for count, blocks in enumerate(portions, 1):
            found.append(tsdf.integrate(state.grid, part.view, cfg.fusion, blocks))
            whole = count == len(portions)
            if not whole:
                expected += expected_voxels(state.field, found[-1], cfg)
            if whole or expected > cfg.most_voxels:
                yield np.concatenate(found), whole and number == len(work)
                found, expected = [], 0.0


def expected_voxels(field: VoxelGrid, changed: np.ndarray, cfg: Config) -> float:
    """About how many voxels of a field will be given other distances after labels of the map's voxels (n, 3) changed.

    Far more follows from an obstacle that is gone, or that stands where all was free, than from a first look.
    """
    if not len(changed):
        return 0.0
    voxels = changed // cfg.coarseness
    box = Box.around(voxels)
    d2 = field.gather("d2", box, UNKNOWN_D2)[tuple((voxels - box.low).T)].astype(np.float64)
    d2[d2 == FAR_D2] = cfg.voxels(cfg.max_distance_m) ** 2
    weights = np.where(d2 == 0, LEAVES_VOXELS, 1.0 + ENTERS_VOXELS * np.maximum(d2, 0.0))
    return float(weights.sum()) / cfg.coarseness**3


def slices_of(state: State, keyframe: Keyframe, depth_m: np.ndarray, cfg: Config) -> list[Slice]:
    """Keep a keyframe for pose updates, and say in which slices it is to be fused: at least one."""
    _keep(state, keyframe)
    view = tsdf.View(depth_m, keyframe.intrinsics, keyframe.world_from_camera)
    camera = keyframe.world_from_camera[:2, 3] / (BLOCK * cfg.voxel_m)
    return [Slice(view, blocks) for blocks in slices(tsdf.blocks_of(view, cfg.fusion), cfg.most_blocks, camera)]


def slices_of_doubted(state: State, latest: Keyframe, cfg: Config) -> Iterator[Slice]:
    """The same for the keyframes of a jump that has turned out to be right with the latest one of their camera."""
    for frame_id in state.trajectory.astray_ids(latest):
        kept = state.archive.get(frame_id)
        if kept is not None and not kept.fused:
            state.trajectory.correct(kept.keyframe)
            yield from slices_of(state, kept.keyframe, images.depth_of(kept.keyframe, cfg.max_principal_offset), cfg)


def fuse_reconsidered(state: State, cfg: Config) -> Iterator[np.ndarray]:
    """Fuse keyframes that were refused beside wrong poses and fit the corrected ones."""
    for keyframe in list(state.archive.unfused()):
        if not state.trajectory.jump_m(keyframe, cfg.bounds):
            state.trajectory.believe(keyframe)
            _keep(state, keyframe)
            yield fuse(state, keyframe, images.depth_of(keyframe, cfg.max_principal_offset), cfg)


def move(state: State, kept: Kept, world_from_camera: np.ndarray, cfg: Config) -> Iterator[np.ndarray]:
    """Take an archived keyframe out of the map and fuse it from elsewhere; yields the voxels whose label changed."""
    there = moved(kept.keyframe, world_from_camera)
    if kept.fused and (there.world_from_camera == kept.keyframe.world_from_camera).all():
        return
    depth_m = images.depth_of(kept.keyframe, cfg.max_principal_offset)
    if kept.fused:
        yield fuse(state, kept.keyframe, depth_m, cfg, tsdf.REMOVE)
    _keep(state, there)
    yield fuse(state, there, depth_m, cfg)
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


def _keep(state: State, keyframe: Keyframe) -> None:
    state.archive.put(keyframe, fused=True)
    x, y, z = keyframe.world_from_camera[:3, 3].tolist()
    state.cameras_m[keyframe.frame_id] = (x, y, z)

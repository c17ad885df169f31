"""Why a keyframe cannot be used: its images, where it says it is, or both (pure)."""

import numpy as np

from prior_sg.schemas.frames import Keyframe
from prior_sg.services import images
from prior_sg.services.place_graph.core.config import Config
from prior_sg.services.place_graph.core.state import State
from prior_sg.services.place_graph.core.volume import tsdf


def usable_depth(keyframe: Keyframe, cfg: Config) -> np.ndarray:
    """Its depth (h, w) in metres, if all that it may touch has voxel indices of 16 bits, as VoxelMap sends them.

    Raises ImageFault.
    """
    reach_m = np.abs(keyframe.world_from_camera[:3, 3]).max() + 2 * cfg.max_range_m
    if not reach_m / cfg.voxel_m < np.iinfo(np.int16).max:
        raise images.ImageFault(f"its camera is {reach_m:.0f} m from the origin, farther than voxel indices reach")
    return images.depth_of(keyframe, cfg.max_principal_offset)


def jump_of(state: State, keyframe: Keyframe, cfg: Config) -> float:
    """By how many metres its pose has jumped, 0 = not at all; a pose that an update gave is believed."""
    return 0.0 if keyframe.frame_id in state.corrections else state.trajectory.jump_m(keyframe, cfg.bounds)


def distrust(state: State, keyframe: Keyframe, depth_m: np.ndarray, jump_m: float, cfg: Config) -> str:
    """Why a keyframe whose pose has jumped cannot be believed; empty when it can."""
    reason = f"its pose jumps by {jump_m:.2f} m"
    view = tsdf.View(depth_m, keyframe.intrinsics, keyframe.world_from_camera)
    state.trajectory.doubt(keyframe, cfg.bounds, tsdf.contradiction(state.grid, view, cfg.fusion))
    latest = state.trajectory.way_of(keyframe).contradictions[-cfg.relocalised_after :]
    if len(latest) < cfg.relocalised_after:
        return reason
    share = float(np.mean(latest))
    return f"{reason}, and {share:.0%} of the depth contradicts the map" if share > cfg.max_contradiction else ""


def lateness(state: State, keyframe: Keyframe) -> str:
    """What to say of a keyframe that is late; the map does not mind the order."""
    if state.joined_frame_id and keyframe.frame_id < state.joined_frame_id:
        return ""  # fetched from the archive
    late_s = (state.trajectory.newest_ns - keyframe.stamp_ns) / 1e9
    return f"keyframe {keyframe.frame_id} is out of order by {late_s:.3f} s; fused all the same" if late_s > 0 else ""

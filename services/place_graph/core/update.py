"""The place graph of one robot: keyframes in, changes of the graph out (pure).

Hydra's 3D places (Hughes et al. 2022), kept up to date where the map changed: fuse the depth image, repair distances
and the Voronoi diagram around changed voxels, extract places there again, give them their old ids, say what differs.
Or its 2D places, pieces of ground, which need the map only.
"""

from collections.abc import Iterator

import numpy as np

from prior_sg.schemas.frames import Keyframe, PoseUpdate
from prior_sg.schemas.places import PlaceDelta
from prior_sg.services.images import ImageFault
from prior_sg.services.place_graph.core.archive import moved
from prior_sg.services.place_graph.core.config import Config
from prior_sg.services.place_graph.core.fusing import (
    Slice,
    fuse_reconsidered,
    fuse_slice,
    fuse_slices,
    leave_behind,
    move,
    slices_of,
    slices_of_doubted,
)
from prior_sg.services.place_graph.core.ground import GroundGraph
from prior_sg.services.place_graph.core.publishing import Cause, publish
from prior_sg.services.place_graph.core.refusals import distrust, jump_of, lateness, usable_depth
from prior_sg.services.place_graph.core.renewal import renew, renew_ground, tile_groups
from prior_sg.services.place_graph.core.skeleton.graph import Changes
from prior_sg.services.place_graph.core.state import State


def integrate(state: State, keyframe: Keyframe, cfg: Config) -> Iterator[PlaceDelta | None]:
    """Fuse one keyframe, step by step, and yield after each what changed in the place graph; None = nothing.

    Only the last step makes the keyframe one of those `seen`, and always yields a delta.

    A keyframe that cannot be used leaves the map as it is; the delta's `event` says why. One whose pose has jumped is
    kept, for a pose update or the keyframes that follow may show where it was taken.
    """
    keyframe = moved(keyframe, state.corrections.pose(keyframe.frame_id, keyframe.world_from_camera))
    try:
        depth_m = usable_depth(keyframe, cfg)
    except ImageFault as fault:
        yield reject(state, keyframe, str(fault), cfg)
        return
    jump_m = jump_of(state, keyframe, cfg)
    if jump_m and (reason := distrust(state, keyframe, depth_m, jump_m, cfg)):
        state.archive.put(keyframe, fused=False)
        yield reject(state, keyframe, reason, cfg)
        return
    state.origin_m = keyframe.origin_m
    event = lateness(state, keyframe)
    work = slices_of(state, keyframe, depth_m, cfg)
    if jump_m:
        event = f"believed again at keyframe {keyframe.frame_id}: the pose stays where it jumped to and fits the map"
        work += slices_of_doubted(state, keyframe, cfg)
    state.trajectory.believe(keyframe)
    state.follows_from(keyframe)
    news = Cause(keyframe.stamp_ns, event, state.cameras_m[keyframe.frame_id])
    for changes, last in _steps(state, keyframe, work, cfg):
        if last:
            leave_behind(state, keyframe, cfg)
            state.seen.add(keyframe.frame_id)
        if last or changes.touched or changes.opened:
            yield publish(state, changes, cfg, news)
            news = Cause(keyframe.stamp_ns)
        else:
            yield None


def _steps(state: State, keyframe: Keyframe, work: list[Slice], cfg: Config) -> Iterator[tuple[Changes, bool]]:
    """Fuse slices and follow them up, step by step; after each, what changed in the graph, and whether that was all.

    A slice is followed up before more is fused: distances hold where no label has changed unnoticed. Ground is
    divided tile by tile, and a change concerns tiles around it, which slices would divide again and again: all slices
    are fused first, and followed up in groups of tiles.
    """
    if not isinstance(state.graph, GroundGraph):
        for changed, last in fuse_slices(state, work, cfg):
            yield renew(state, changed, cfg), last
        return
    found = []
    for part in work:
        found.append(fuse_slice(state, part, cfg))
        if len(work) > 1:
            yield Changes(), False
    changed = np.concatenate(found)
    groups = tile_groups(state.graph, changed, keyframe.world_from_camera[:2, 3], cfg)
    for number, tiles in enumerate(groups, 1):
        yield renew_ground(state, state.graph, tiles, changed), number == len(groups)


def correct(state: State, update: PoseUpdate, cfg: Config) -> PlaceDelta | None:
    """Move keyframes to their corrected poses: the map becomes what it would be, had these poses been known.

    None when the update has been seen before, or there is no map yet: readers keep that of a predecessor. Keyframes
    that are still to come are moved when they come; those that the archive no longer holds stay, which the
    delta's `event` says.
    """
    poses = state.corrections.take(update)
    if poses is None or not state.seen:
        return None
    changed = [np.empty((0, 3), np.int64)]
    moved_ids, lost = [], 0
    for frame_id, pose in sorted(poses.items()):
        kept = state.archive.get(frame_id)
        if kept is not None:
            changed += move(state, kept, pose, cfg)
            moved_ids.append(frame_id)
        elif frame_id in state.cameras_m:
            lost += 1
    changed += fuse_reconsidered(state, cfg)
    event = f"{lost} of {len(poses)} keyframes are no longer archived and keep their poses" if lost else ""
    changes = renew(state, np.concatenate(changed), cfg)
    return publish(state, changes, cfg, Cause(update.stamp_ns, event, moved_ids=moved_ids))


def reject(state: State, keyframe: Keyframe, reason: str, cfg: Config) -> PlaceDelta:
    """Count a keyframe that cannot be used; the delta says why and changes nothing."""
    state.refused[keyframe.frame_id] = reason
    state.follows_from(keyframe)
    state.seen.add(keyframe.frame_id)
    event = f"keyframe {keyframe.frame_id} refused: {reason}"
    return publish(state, Changes(), cfg, Cause(keyframe.stamp_ns, event))

"""The place graph of one robot: keyframes in, changes of the graph out (pure).

Hydra's 3D places (Hughes et al. 2022), kept up to date where the map changed: fuse the depth image, repair distances
and the Voronoi diagram around changed voxels, extract places there again, give them their old ids, say what differs.
Or its 2D places, pieces of ground, which need the map only.
"""

import numpy as np

from prior_sg.schemas.frames import Keyframe, PoseUpdate
from prior_sg.schemas.places import PlaceDelta
from prior_sg.services.images import ImageFault
from prior_sg.services.place_graph.core.archive import moved
from prior_sg.services.place_graph.core.config import Config
from prior_sg.services.place_graph.core.fusing import fuse_and_keep, fuse_doubted, fuse_reconsidered, leave_behind, move
from prior_sg.services.place_graph.core.publishing import publish
from prior_sg.services.place_graph.core.refusals import distrust, jump_of, lateness, usable_depth
from prior_sg.services.place_graph.core.renewal import renew
from prior_sg.services.place_graph.core.skeleton.graph import Changes
from prior_sg.services.place_graph.core.state import State


def integrate(state: State, keyframe: Keyframe, cfg: Config) -> PlaceDelta:
    """Fuse one keyframe and return what changed in the place graph.

    A keyframe that cannot be used leaves the map as it is; the delta's `event` says why. One whose pose has jumped is
    kept, for a pose update or the keyframes that follow may show where it was taken.
    """
    keyframe = moved(keyframe, state.corrections.pose(keyframe.frame_id, keyframe.world_from_camera))
    try:
        depth_m = usable_depth(keyframe, cfg)
    except ImageFault as fault:
        return reject(state, keyframe, str(fault), cfg)
    jump_m = jump_of(state, keyframe, cfg)
    if jump_m and (reason := distrust(state, keyframe, depth_m, jump_m, cfg)):
        state.archive.put(keyframe, fused=False)
        return reject(state, keyframe, reason, cfg)
    state.origin_m = keyframe.origin_m
    event = lateness(state, keyframe)
    changed = [fuse_and_keep(state, keyframe, depth_m, cfg)]
    if jump_m:
        event = f"believed again at keyframe {keyframe.frame_id}: the pose stays where it jumped to and fits the map"
        changed += fuse_doubted(state, keyframe, cfg)
    state.trajectory.believe(keyframe)
    changes = renew(state, np.concatenate(changed), cfg)
    leave_behind(state, keyframe, cfg)
    state.heard(keyframe)
    camera_m = state.cameras_m[keyframe.frame_id]
    return publish(state, changes, cfg, stamp_ns=keyframe.stamp_ns, event=event, camera_m=camera_m)


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
    return publish(state, changes, cfg, stamp_ns=update.stamp_ns, event=event, moved_ids=moved_ids)


def reject(state: State, keyframe: Keyframe, reason: str, cfg: Config) -> PlaceDelta:
    """Count a keyframe that cannot be used; the delta says why and changes nothing."""
    state.refused[keyframe.frame_id] = reason
    state.heard(keyframe)
    event = f"keyframe {keyframe.frame_id} refused: {reason}"
    return publish(state, Changes(), cfg, stamp_ns=keyframe.stamp_ns, event=event)

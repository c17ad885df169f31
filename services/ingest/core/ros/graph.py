"""Poses that a SLAM has optimised, as corrections of the frames between them (pure).

A pose graph has fewer nodes than there are frames. How far a node was moved from where its stamp's frame was is taken
to hold there, and in between in proportion to time; before the first and after the last node, as there.
"""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from prior_sg.services.geometry import inverse
from prior_sg.services.ingest.core.frames import View
from prior_sg.services.ingest.core.poses import PoseError
from prior_sg.services.ingest.core.ros.transforms import Stamped, Track


def corrected(trail: Sequence[View], nodes: Sequence[Stamped], within_ns: int) -> np.ndarray:
    """Corrected poses (n, 4, 4) of frames, oldest first; both are poses of the same body in the same world.

    Raises PoseError where no node belongs to a frame.
    """
    poses = np.array([view.world_from_camera for view in trail]).reshape(-1, 4, 4)
    track = _track(trail, poses)
    moved: dict[int, np.ndarray] = {}
    for node in sorted(nodes, key=lambda node: node.stamp_ns):
        if node.is_motion() and node.stamp_ns not in moved:
            try:
                before = track.at(node.stamp_ns, within_ns)
            except PoseError:
                continue
            moved[node.stamp_ns] = node.matrix() @ inverse(before)
    if not moved:
        raise PoseError("no pose of the graph has the stamp of a frame")
    at_ns = np.array([view.stamp_ns for view in trail])
    return _between(np.array(list(moved)), np.array(list(moved.values())), at_ns) @ poses


def _between(stamps_ns: np.ndarray, motions: np.ndarray, at_ns: np.ndarray) -> np.ndarray:
    """Motions (n, 4, 4) at stamps (n,), of those at rising stamps."""
    seconds, at_s = (stamps_ns - stamps_ns[0]) / 1e9, (np.clip(at_ns, stamps_ns[0], stamps_ns[-1]) - stamps_ns[0]) / 1e9
    found = np.tile(np.eye(4), (len(at_ns), 1, 1))
    if len(stamps_ns) == 1:
        return found @ motions[0]
    found[:, :3, :3] = Slerp(seconds, Rotation.from_matrix(motions[:, :3, :3]))(at_s).as_matrix()
    found[:, :3, 3] = np.column_stack([np.interp(at_s, seconds, motions[:, axis, 3]) for axis in range(3)])
    return found


def _track(trail: Sequence[View], poses: np.ndarray) -> Track:
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_quat() if len(poses) else ()
    samples = [
        Stamped(view.stamp_ns, "", "", tuple(pose[:3, 3]), tuple(turn))
        for view, pose, turn in zip(trail, poses, turns, strict=True)
    ]
    return Track(samples, moves=True)

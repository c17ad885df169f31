"""How two maps lie to each other by the printed markers that both show (pure).

A marker has a spot and a heading, so one that both maps show gives the whole motion; several give a better heading.
People print a marker twice, move it, or take it home: those that contradict each other are refused.
"""

from typing import NamedTuple

import numpy as np

from prior_sg.deploy.fleet.core.finding.config import MatchConfig
from prior_sg.deploy.fleet.core.finding.frames import fitted
from prior_sg.schemas.markers import MarkerKey, SceneMarker
from prior_sg.schemas.scene import Scene
from prior_sg.services.geometry import inverse, pose_from_quaternion, rotation_angle_rad, transform

FARTHEST_M = 1e6  # from a map's zero; what is told of beyond is nonsense, and its squares are no numbers
ARM_M = 1.0  # a spot that is 5 cm off counts as much as a heading that is 3 degrees off


class Marked(NamedTuple):
    """What the markers of two maps say. Without `b_from_a` nothing, for the reason `why`."""

    b_from_a: np.ndarray | None  # (4, 4) level motion
    spots_a_m: np.ndarray  # (marker, 3) of the shared ones, in both maps
    spots_b_m: np.ndarray
    why: str


def pose_of(marker: SceneMarker) -> np.ndarray:
    """world_from_marker (4, 4)."""
    return pose_from_quaternion(np.array(marker.position_m), np.array(marker.quaternion_xyzw))


def by_markers(a: Scene, b: Scene, cfg: MatchConfig) -> Marked | None:
    """How b lies to a by their markers; None where they share none, or none that both are sure of."""
    of_a, of_b = ({marker.key: marker for marker in scene.markers if _sure(marker)} for scene in (a, b))
    shared = sorted(of_a.keys() & of_b.keys())
    if not shared:
        return None
    poses = np.array([[pose_of(held[key]) for key in shared] for held in (of_a, of_b)])
    motion = fitted(_limbs(poses[0]), _limbs(poses[1]))
    why = _fault_of(motion, poses, shared, b.robot, cfg)
    spots_a_m, spots_b_m = poses[:, :, :3, 3]
    return Marked(None if why else motion, spots_a_m, spots_b_m, why)


def _sure(marker: SceneMarker) -> bool:
    return not marker.doubt and max(map(abs, marker.position_m)) < FARTHEST_M


def doubts_of(a: Scene, b: Scene) -> str:
    """Why markers that both maps show say nothing, as a sentence; empty where there are none."""
    of_a, of_b = ({marker.key: marker for marker in scene.markers} for scene in (a, b))
    told = [
        f"{key} says nothing, for in {scene.robot} {held[key].doubt}"
        for key in sorted(of_a.keys() & of_b.keys())
        for scene, held in ((a, of_a), (b, of_b))
        if held[key].doubt
    ]
    return "; ".join(told)


def _limbs(poses: np.ndarray) -> np.ndarray:
    """Points (n, 3) that stand for the poses of markers: middles, and the ends of three arms."""
    arms = np.array(((0, 0, 0), (ARM_M, 0, 0), (0, ARM_M, 0), (0, 0, ARM_M)))
    return np.asarray((arms @ poses[:, :3, :3].transpose(0, 2, 1) + poses[:, None, :3, 3]).reshape(-1, 3))


def _fault_of(b_from_a: np.ndarray, poses: np.ndarray, shared: list[MarkerKey], robot_b: str, cfg: MatchConfig) -> str:
    """Why markers with these poses (2, marker, 4, 4) cannot all be what they seem; empty when they can."""
    spots_a_m, spots_b_m = poses[:, :, :3, 3]
    off_m = np.linalg.norm(transform(b_from_a, spots_a_m) - spots_b_m, axis=1)
    reach_m = np.linalg.norm(spots_a_m - spots_a_m.mean(axis=0), axis=1)
    far = off_m - cfg.markers_m - cfg.tolerance_share * reach_m
    names = " and ".join(map(str, shared))
    worst = int(far.argmax())
    if far[worst] > 0:
        return f"{names} disagree: {shared[worst]} would lie {off_m[worst]:.1f} m from where {robot_b} has it"
    turns = [rotation_angle_rad(inverse(two) @ b_from_a @ one) for one, two in zip(*poses, strict=True)]
    worst = int(np.argmax(turns))
    if turns[worst] > cfg.markers_rad:
        turn_deg = np.degrees(turns[worst])
        return f"{names} disagree: {shared[worst]} would be turned by {turn_deg:.0f} degrees from how {robot_b} has it"
    return ""

"""Hydra's trajectory beside that of the images: whether both mean one world, and where a loop closure moved it (pure).

A keyframe is paired with the agent node nearest in time. What later moves that node moves the keyframe with it, by the
same rigid motion of the world, whatever stands between robot and camera.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from prior_sg.deploy.hydra.core.graph import HydraGraph
from prior_sg.services.geometry import inverse, rotation_angle_rad

PAIRED_WITHIN_NS = 500_000_000
MOST_WAITING = 1024  # keyframes that wait for Hydra's agent to come to their stamps; the oldest are forgotten
FEWEST = 3  # pairs before their distance says something
SAME = 1e-6  # entries of two poses that differ by no more


class Pair(NamedTuple):
    """A keyframe and where the robot was when its pose was believed; (4, 4) each."""

    agent_stamp_ns: int
    world_from_agent: np.ndarray
    world_from_camera: np.ndarray


@dataclass
class Poses:
    """Keyframes and their pairs."""

    pairs: dict[int, Pair] = field(default_factory=dict)  # by frame id
    told: dict[int, np.ndarray] = field(default_factory=dict)  # corrected pose of frames, as told
    _waiting: dict[int, tuple[int, np.ndarray]] = field(default_factory=dict)  # frame id: stamp and pose

    def heard(self, frame_id: int, stamp_ns: int, world_from_camera: np.ndarray) -> None:
        """A keyframe has come."""
        if frame_id not in self.pairs:
            self._waiting[frame_id] = stamp_ns, np.array(world_from_camera)
            while len(self._waiting) > MOST_WAITING:
                del self._waiting[next(iter(self._waiting))]

    def follow(self, graph: HydraGraph, min_change_m: float, min_turn_rad: float) -> dict[int, np.ndarray]:
        """Pair the keyframes that wait, and return the poses (4, 4) of those that Hydra has moved since."""
        if not len(graph.agent_stamps_ns):
            return {}
        order = np.argsort(graph.agent_stamps_ns, kind="stable")
        stamps_ns, agents = graph.agent_stamps_ns[order], graph.world_from_agent[order]
        self._pair(stamps_ns, agents)
        if not self.pairs:
            return {}
        now = agents[_nearest(stamps_ns, np.array([pair.agent_stamp_ns for pair in self.pairs.values()]))]
        then = np.array([pair.world_from_agent for pair in self.pairs.values()])
        still = (np.abs(now - then) <= SAME).all(axis=(1, 2)).tolist()
        moved = {}
        for frame_id, agent, same in zip(self.pairs, now, still, strict=True):
            if same and frame_id not in self.told:
                continue
            pair = self.pairs[frame_id]
            pose = agent @ inverse(pair.world_from_agent) @ pair.world_from_camera
            if _differs(self.told.get(frame_id, pair.world_from_camera), pose, min_change_m, min_turn_rad):
                moved[frame_id] = self.told[frame_id] = pose
        return moved

    def _pair(self, stamps_ns: np.ndarray, agents: np.ndarray) -> None:
        for frame_id, (stamp_ns, pose) in list(self._waiting.items()):
            row = int(_nearest(stamps_ns, np.array([stamp_ns]))[0])
            if abs(int(stamps_ns[row]) - stamp_ns) <= PAIRED_WITHIN_NS:
                self.pairs[frame_id] = Pair(int(stamps_ns[row]), agents[row].copy(), pose)
                del self._waiting[frame_id]

    def apart_m(self) -> float:
        """Median distance of camera and robot at the same times; 0 while too few are known."""
        apart = [np.linalg.norm(p.world_from_agent[:3, 3] - p.world_from_camera[:3, 3]) for p in self.pairs.values()]
        return float(np.median(apart)) if len(apart) >= FEWEST else 0.0


def _differs(known: np.ndarray, pose: np.ndarray, min_change_m: float, min_turn_rad: float) -> bool:
    shift_m = float(np.linalg.norm(pose[:3, 3] - known[:3, 3]))
    return shift_m > min_change_m or rotation_angle_rad(pose @ inverse(known)) > min_turn_rad


def _nearest(stamps_ns: np.ndarray, wanted_ns: np.ndarray) -> np.ndarray:
    """The row of the nearest of ascending stamps, for each of those wanted."""
    after = np.minimum(np.searchsorted(stamps_ns, wanted_ns), len(stamps_ns) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(wanted_ns - stamps_ns[before] <= stamps_ns[after] - wanted_ns, before, after)

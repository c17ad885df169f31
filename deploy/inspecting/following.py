"""Whether the place graph will follow the camera: poses judged as in a run in which no depth speaks against them."""

import math

import numpy as np

from prior_sg.schemas.frames import Keyframe
from prior_sg.services.ingest.core.inspection import Finding
from prior_sg.services.ingest.core.inspection.findings import problem
from prior_sg.services.place_graph.core.config import Config
from prior_sg.services.place_graph.core.trajectory import Trajectory

REFUSED_PROBLEM = 0.05  # share of the keyframes
ROOM = 1.5  # times the speed that was seen, for what was not


class Following:
    """Keyframes in the order in which they come."""

    def __init__(self, cfg: Config) -> None:
        self._cfg = cfg
        self._trajectory = Trajectory()
        self._last: dict[str, Keyframe] = {}  # by camera
        self._keyframes = self._refused = 0
        self._speeds_m_s: list[float] = []  # from a keyframe to one that is refused

    def see(self, keyframe: Keyframe) -> None:
        """The next one."""
        self._keyframes += 1
        last, self._last[keyframe.camera] = self._last.get(keyframe.camera), keyframe
        if self._trajectory.jump_m(keyframe, self._cfg.bounds):
            self._trajectory.doubt(keyframe, self._cfg.bounds, contradiction=0.0)
            if len(self._trajectory.way_of(keyframe).contradictions) < self._cfg.relocalised_after:
                self._refused += 1
                self._speeds_m_s += [] if last is None else _speeds_m_s(last, keyframe)
                return
        self._trajectory.believe(keyframe)

    def findings(self) -> list[Finding]:
        """A problem, where many keyframes would be refused for their speed."""
        if self._refused <= REFUSED_PROBLEM * self._keyframes or not self._speeds_m_s:
            return []
        speed_m_s, bound_m_s = float(np.median(self._speeds_m_s)), self._cfg.max_speed_m_s
        text = (
            f"the place graph will refuse about {self._refused} of {self._keyframes} keyframes: they lie apart as at"
            f" {speed_m_s:.1f} m/s, and it believes {bound_m_s:g}"
        )
        believes = f"--set place_graph.max_speed_m_s={math.ceil(ROOM * speed_m_s)}"
        return [
            problem(
                "speed", text, f"{believes} where it moves so fast; else --rate HZ, --stamp-unit or --position-scale"
            )
        ]


def _speeds_m_s(before: Keyframe, after: Keyframe) -> list[float]:
    gone_s = (after.stamp_ns - before.stamp_ns) / 1e9
    gone_m = float(np.linalg.norm(after.world_from_camera[:3, 3] - before.world_from_camera[:3, 3]))
    return [gone_m / gone_s] if gone_s > 0 else []

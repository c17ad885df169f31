"""A jump of the world under a robot, spread over the keyframes that drifted before it (pure).

A SLAM that closes a loop moves the robot at once, but the error had grown along the way. Without its pose graph the
best that can be said is that it grew evenly with the way travelled since the last jump.
"""

from collections.abc import Sequence

import numpy as np

from prior_sg.services.ingest.core.frames import View
from prior_sg.services.opencv import cv2


def spread(trail: Sequence[View], now: View, after_from_before: np.ndarray) -> list[np.ndarray]:
    """Corrected world_from_camera (4, 4) of keyframes since the last jump, oldest first.

    `now` is the newest frame, before the jump: what is there moves by all of it, the first keyframe by nothing. From
    one of a robot's cameras to another is no way travelled.
    """
    camera_m, steps_m, last = now.world_from_camera[:3, 3], list[float](), dict[str, np.ndarray]()
    for view in (*trail, now):
        here_m = view.world_from_camera[:3, 3]
        steps_m.append(float(np.linalg.norm(here_m - last.get(view.camera, here_m))))
        last[view.camera] = here_m
    travelled_m = np.cumsum(steps_m)
    shares = travelled_m[:-1] / travelled_m[-1] if travelled_m[-1] > 0 else np.ones(len(trail))
    return [
        _part(share, camera_m, after_from_before) @ view.world_from_camera
        for share, view in zip(shares, trail, strict=True)
    ]


def _part(share: float, around_m: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """A share of a motion (4, 4): turned about a point, and moved, by that share."""
    turn = cv2.Rodrigues(motion[:3, :3])[0]
    shift_m = motion[:3, :3] @ around_m + motion[:3, 3] - around_m
    part = np.eye(4)
    part[:3, :3] = cv2.Rodrigues(share * turn)[0]
    part[:3, 3] = around_m - part[:3, :3] @ around_m + share * shift_m
    return part

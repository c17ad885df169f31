"""Images as gravity has them: networks were trained on pictures with the floor below (pure)."""

import math

import numpy as np

PLUMB_SHARE = 0.35  # of gravity that must lie in the image plane; a camera that looks further up or down has no upright


def quarter_turns(world_from_camera: np.ndarray) -> int:
    """Clockwise quarter turns, 0 to 3, after which down in the world is nearest to down in the image.

    `world_from_camera` (4, 4), world z up; none for a camera that looks almost straight up or down.
    """
    right, down = (-world_from_camera[2, :2]).tolist()  # gravity in camera coordinates, x right and y down
    if math.hypot(right, down) < PLUMB_SHARE:
        return 0
    return round(math.atan2(right, down) / (math.pi / 2)) % 4


def turned(image: np.ndarray, turns: int) -> np.ndarray:
    """The image (h, w, ...) after clockwise quarter turns; itself after none."""
    return np.ascontiguousarray(np.rot90(image, -turns)) if turns else image


def turned_back(boxes_px: np.ndarray, turns: int, width_px: int, height_px: int) -> np.ndarray:
    """Boxes (n, 4) of a turned image, left top right bottom edge, on the image before the turns (size of that one)."""
    sizes = [(width_px, height_px) if turn % 2 == 0 else (height_px, width_px) for turn in range(turns)]
    for _, before_height_px in reversed(sizes):
        left, top, right, bottom = boxes_px.T
        boxes_px = np.stack((top, before_height_px - right, bottom, before_height_px - left), axis=1)
    return boxes_px

"""Medians of depth patches (pure): by partition, which NumPy does faster than compiled counting, and without numba."""

import numpy as np


def patch_medians(depth_m: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """Median of the positive values in each square patch, 0 where there is none: float32 (patch,).

    `depth_m` float32 (h, w); `boxes` int (patch, 3): left, top, side.
    """
    medians = np.zeros(len(boxes), np.float32)
    for row, (left, top, side) in enumerate(boxes.tolist()):
        patch = depth_m[top : top + side, left : left + side]
        values = patch[patch > 0]
        if not len(values):
            continue
        lower = (len(values) - 1) // 2
        values.partition(lower)
        upper = values[lower] if len(values) % 2 else values[lower + 1 :].min()
        medians[row] = np.float32(0.5) * (values[lower] + upper)
    return medians

"""Medians of depth patches by counting, compiled: exact, and many times faster than sorting (pure)."""

import numpy as np

from prior_sg.services.compiled import compiled

HALF = 1 << 16


@compiled()
def patch_medians(depth_m: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """Median of the positive values in each square patch, 0 where there is none: float32 (patch,).

    `depth_m` float32 (h, w); `boxes` int (patch, 3): left, top, side. Bits of positive floats sort like the floats, so
    two rounds of counting, upper and lower half of the bits, find any order statistic.
    """
    bits = depth_m.view(np.uint32)
    medians = np.zeros(len(boxes), np.float32)
    for patch in range(len(boxes)):
        left, top, side = boxes[patch]
        counts = np.zeros(HALF, np.int32)
        total = 0
        for row in range(top, top + side):
            for column in range(left, left + side):
                if depth_m[row, column] > 0:
                    counts[bits[row, column] >> 16] += 1
                    total += 1
        if total:
            first = _ranked(bits, depth_m, boxes[patch], counts, (total - 1) // 2)
            second = first if total % 2 else _ranked(bits, depth_m, boxes[patch], counts, total // 2)
            medians[patch] = np.float32(0.5) * (first + second)
    return medians


@compiled()
def _ranked(bits: np.ndarray, depth_m: np.ndarray, box: np.ndarray, counts: np.ndarray, rank: int) -> np.float32:
    """The value of a rank, given the counts of the upper halves."""
    upper = 0
    while rank >= counts[upper]:
        rank -= counts[upper]
        upper += 1
    left, top, side = box
    lower_counts = np.zeros(HALF, np.int32)
    for row in range(top, top + side):
        for column in range(left, left + side):
            if depth_m[row, column] > 0 and bits[row, column] >> 16 == upper:
                lower_counts[bits[row, column] & 0xFFFF] += 1
    lower = 0
    while rank >= lower_counts[lower]:
        rank -= lower_counts[lower]
        lower += 1
    value = np.empty(1, np.uint32)
    value[0] = (upper << 16) | lower
    return value.view(np.float32)[0]

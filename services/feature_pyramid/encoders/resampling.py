"""Resizing of crops as networks were trained with it (Pillow, torchvision): what shrinks is averaged by the kernel.

A resize is two products with a matrix of weights, one per axis, so that it needs neither PyTorch nor Pillow.
"""

from collections.abc import Callable
from functools import lru_cache

import numpy as np

Kernel = Callable[[np.ndarray], np.ndarray]


def _triangle(offsets: np.ndarray) -> np.ndarray:
    return np.maximum(1 - np.abs(offsets), 0)


def _cubic(offsets: np.ndarray) -> np.ndarray:
    """Keys's cubic convolution with a = -0.5."""
    at = np.abs(offsets)
    near, far = (1.5 * at - 2.5) * at * at + 1, ((-0.5 * at + 2.5) * at - 4) * at + 2
    return np.where(at < 1, near, np.where(at < 2, far, 0))


KERNELS: dict[str, tuple[Kernel, float]] = {"bilinear": (_triangle, 1.0), "bicubic": (_cubic, 2.0)}  # and their radius


def resampled(crop: np.ndarray, side_px: int, interpolation: str) -> np.ndarray:
    """A crop, uint8 (h, w, 3), as float32 (3, side, side) in [0, 255]."""
    planes = np.ascontiguousarray(crop.transpose(2, 0, 1), np.float32)  # which products need to be fast
    height, width = crop.shape[:2]
    if height != side_px:
        planes = weights(height, side_px, interpolation) @ planes
    if width != side_px:
        planes = planes @ weights(width, side_px, interpolation).T
    return np.clip(planes, 0, 255)


@lru_cache(maxsize=64)
def weights(source_px: int, target_px: int, interpolation: str) -> np.ndarray:
    """How much each source pixel counts in each target pixel: float32 (target, source), rows sum to one."""
    kernel, radius = KERNELS[interpolation]
    scale = source_px / target_px
    stretch = max(scale, 1.0)
    centers = (np.arange(target_px) + 0.5) * scale
    sources = np.arange(source_px)
    # The pixels that count are those whose index, not whose middle, is within reach: as in the libraries.
    first = np.maximum((centers - radius * stretch + 0.5).astype(int), 0)
    last = np.minimum((centers + radius * stretch + 0.5).astype(int), source_px)
    reach = (sources >= first[:, None]) & (sources < last[:, None])
    found = np.where(reach, kernel((sources + 0.5 - centers[:, None]) / stretch), 0.0)
    return (found / found.sum(axis=1, keepdims=True)).astype(np.float32)

"""Compiled loops; what they compute stands in `descriptors` and `objects` (pure)."""

import numpy as np
from numba import njit

ROWS_PER_BLOCK = 128  # places multiplied at once: their sums stay in the processor's cache


@njit(cache=True, nogil=True, fastmath=True)
def weigh(
    query_states: np.ndarray, crop_states: np.ndarray, layer_starts: np.ndarray, gamma: float
) -> tuple[np.ndarray, np.ndarray]:
    """Weights (place, crop) and trust (place,), float32: eqs. spatial_affinity, scale_trust, observation_trust.

    States are float32 (n, 3): pixel u, v and scale sigma in pixels.
    """
    places, crops, layers = len(query_states), len(crop_states), len(layer_starts)
    weights, trust = np.empty((places, crops), np.float32), np.zeros(places, np.float32)
    crop_logs, sharpness = np.log(crop_states[:, 2]), np.float32(1.0 / gamma)
    for place in range(places):
        u, v, sigma = query_states[place]
        area, log = sigma**2, np.log(sigma)
        for layer in range(layers):
            end = layer_starts[layer + 1] if layer + 1 < layers else crops
            best = np.float32(0.0)
            for crop in range(layer_starts[layer], end):
                du, dv = u - crop_states[crop, 0], v - crop_states[crop, 1]
                spatial = (du * du + dv * dv) / (np.float32(2.0) * (area + crop_states[crop, 2] ** 2))
                scale = (log - crop_logs[crop]) ** 2 * sharpness
                weight = np.exp(-(spatial + scale))
                weights[place, crop] = weight
                best = max(best, weight)
            trust[place] += best
    return weights, trust


@njit(cache=True, nogil=True)
def accumulate(
    sums: np.ndarray, slots: np.ndarray, weights: np.ndarray, trust: np.ndarray, embeddings: np.ndarray
) -> None:
    """sums[slots] += (trust * weights) @ embeddings, float32, in blocks of rows; no slot twice."""
    dim = embeddings.shape[1]
    scaled = np.empty((ROWS_PER_BLOCK, weights.shape[1]), np.float32)
    products = np.empty((ROWS_PER_BLOCK, dim), np.float32)
    for start in range(0, len(slots), ROWS_PER_BLOCK):
        count = min(ROWS_PER_BLOCK, len(slots) - start)
        for row in range(count):
            for crop in range(weights.shape[1]):
                scaled[row, crop] = weights[start + row, crop] * trust[start + row]
        np.dot(scaled[:count], embeddings, products[:count])
        for row in range(count):
            target = sums[slots[start + row]]
            for column in range(dim):
                target[column] += products[row, column]


@njit(cache=True, nogil=True)
def count_near(cells: np.ndarray, others: np.ndarray, steps: np.ndarray) -> int:
    """How many of the cells have, at one of the steps from them, one of the others or its neighbour on the last axis.

    All int64 and sorted; a step along the last axis is 1.
    """
    count = 0
    for cell in cells:
        for step in steps:
            at = np.searchsorted(others, cell + step - 1)
            if at < len(others) and others[at] <= cell + step + 1:
                count += 1
                break
    return count

"""How rectangles are divided, and rooms lined up and joined, by many kinds of plans (pure)."""

from collections.abc import Sequence

import numpy as np

from prior_sg.deploy.evaluation.worlds.outline import Rect
from prior_sg.deploy.evaluation.worlds.plan import Unbuildable, rounded


def parts(rng: np.random.Generator, length_m: float, weights: Sequence[float], least_m: float) -> list[float]:
    """A length divided about as the weights say, each part at least so long, on a grid of 0.1 m. Raises Unbuildable."""
    shares = np.array(weights, float) * rng.uniform(0.8, 1.25, len(weights))
    free_m = length_m - least_m * len(weights)
    if free_m < -1e-6:
        raise Unbuildable(f"{len(weights)} rooms do not fit into {length_m:.1f} m")
    wanted = np.maximum(shares / shares.sum() * length_m - least_m, 0)
    cuts = [rounded(least_m + free_m * float(share), 0.1) for share in wanted / max(wanted.sum(), 1e-9)]
    cuts[int(np.argmax(cuts))] += length_m - sum(cuts)
    return [rounded(cut, 0.1) for cut in cuts]


def between(rng: np.random.Generator, low_m: float, high_m: float) -> float:
    """A length from a range, on a grid of 0.1 m."""
    return rounded(float(rng.uniform(low_m, high_m)), 0.1)


def picked(rng: np.random.Generator, options: Sequence[str], count: int) -> list[str]:
    """So many different ones, in random order."""
    return [options[i] for i in rng.permutation(len(options))[:count].tolist()]


def halved(rng: np.random.Generator, rect: Rect, count: int, least_m: float) -> list[Rect]:
    """A rectangle cut in two again and again, along its longer side. Raises Unbuildable."""
    if count == 1:
        return [rect]
    fewer = count // 2
    weights = [fewer, count - fewer] if rng.random() < 0.5 else [count - fewer, fewer]
    along_x = rect.width >= rect.depth
    cuts = parts(rng, rect.width if along_x else rect.depth, weights, least_m)
    halves = rect.cut_x(cuts) if along_x else rect.cut_y(cuts)
    return [
        piece for half, share in zip(halves, weights, strict=True) for piece in halved(rng, half, int(share), least_m)
    ]

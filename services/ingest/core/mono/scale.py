"""How a network's output becomes metres: factors that fit it to points of known depth, followed over time (pure).

INVERSE  the output d is inverse depth up to a scale and a shift of each picture (Ranftl et al. 2020, equation 1):
         1/z = f_1 d + f_2
METRIC   the output d is depth up to a scale: 1/z = f_1 / d

In both 1/z is linear in the factors f, with a row x of (d, 1) or (1/d) for each pixel. Of candidates from as few points
as suffice the one is taken with the least sum(min(e^2, 1)) (MSAC, Torr and Zisserman 2000), e the error over what
it may be; then f solves N f = y with N = sum(g x x') and y = sum(g x/z) over the points it fits, where g is one over
the variance of a point and of the network. N and y of earlier frames are added with the weight exp(-dt / SMOOTH_NS), as
in recursive least squares with forgetting. x' N^-1 x is the variance of 1/z at a pixel; where it is too large, nothing
is said.
"""

from dataclasses import dataclass
from itertools import combinations
from math import exp

import numpy as np

INVERSE, METRIC = "inverse", "metric"
KINDS = (INVERSE, METRIC)
FEWEST = 24  # points with parallax
PARALLAX = 0.06  # most that a point's inverse depth may be unsure of, as a share of it
TOLERANCE, SPREAD = 0.1, 0.05  # error of the network that is still a fit, and its standard deviation; shares of 1/z
LEAST_SHARE = 0.6  # of points that a scale has to fit
CANDIDATES = 48  # points of which candidates are made
WORTH = 20.0  # points that a frame counts for at most: the network's errors are those of surfaces, not of pixels
ROUNDS = 4
SMOOTH_NS, HELD_NS = 300_000_000, 1_000_000_000  # forgetting; and how long a scale is believed without parallax
UNSURE = 0.2  # standard deviation of 1/z, as a share of it, beyond which a pixel is no measurement
SINGULAR = 1e-9
USUAL = 0.4  # inverse depth, 1/m, of what is not known yet
LEAST = 1e-9  # outputs of a metric network below are no depth


class ScaleError(ValueError):
    """Metres cannot be told of a frame; the text is the reason."""


@dataclass(frozen=True)
class Fit:
    """What is known of the factors at a time."""

    stamp_ns: int
    normal: np.ndarray  # N, (k, k)
    right: np.ndarray  # y, (k,)

    @property
    def factors(self) -> np.ndarray:
        """f, (k,)."""
        return np.linalg.solve(self.normal, self.right)

    def inverse_depth(self, output: np.ndarray, kind: str) -> tuple[np.ndarray, np.ndarray]:
        """1/z (...), 1/m, of a network's output of any shape, and its standard deviation; not finite = none."""
        rows = rows_of(output, kind)
        variance = np.einsum("...i,ij,...j->...", rows, np.linalg.inv(self.normal), rows)
        return rows @ self.factors, np.sqrt(variance)

    def depth_m(self, output: np.ndarray, kind: str) -> np.ndarray:
        """Depth, metres, 0 = none, of a network's output (h, w)."""
        inverse_depth, sigma = self.inverse_depth(output, kind)
        with np.errstate(invalid="ignore"):
            told = np.isfinite(inverse_depth) & (inverse_depth > 0) & (sigma <= UNSURE * inverse_depth)
        return np.divide(1.0, inverse_depth, out=np.zeros(output.shape), where=told)


class Scaling:
    """The factors of a sequence, frame by frame."""

    def __init__(self, kind: str) -> None:
        self.kind = kind
        self.usual = USUAL  # inverse depth, 1/m, of the newest frame that told one
        self._last: Fit | None = None

    def check(self, stamp_ns: int, inverse_depth: np.ndarray, sigma: np.ndarray) -> Fit | None:
        """The last factors, where points (n,) tell no new ones, else None. Raises ScaleError where there are none."""
        count = int((sigma <= PARALLAX * inverse_depth).sum())
        if count >= FEWEST:
            return None
        if (last := self._before(stamp_ns)) is not None:
            return last
        raise ScaleError(
            f"nothing tells the scale of its depth: {count} points are seen with parallax, {FEWEST} are needed; the "
            "camera has to move sideways past things with corners"
        )

    def take(self, stamp_ns: int, output: np.ndarray, inverse_depth: np.ndarray, sigma: np.ndarray) -> Fit:
        """The factors at a frame: `output` (n,) of the network at points whose inverse depth (n,) is measured.

        Without parallax the last ones hold for HELD_NS. Raises ScaleError.
        """
        told = sigma <= PARALLAX * inverse_depth
        if held := self.check(stamp_ns, inverse_depth, sigma):
            return held
        fit = fitted(stamp_ns, rows_of(output[told], self.kind), inverse_depth[told], sigma[told])
        if (last := self._before(stamp_ns)) is not None:
            weight = exp(-(stamp_ns - last.stamp_ns) / SMOOTH_NS)
            fit = Fit(stamp_ns, fit.normal + weight * last.normal, fit.right + weight * last.right)
        self._last, self.usual = fit, float(np.median(inverse_depth[told]))
        return fit

    def _before(self, stamp_ns: int) -> Fit | None:
        """The last one that was told, where it is neither old nor, after a look ahead, of later."""
        last = self._last
        return last if last is not None and 0 <= stamp_ns - last.stamp_ns <= HELD_NS else None


def rows_of(output: np.ndarray, kind: str) -> np.ndarray:
    """x (..., k) of a network's output (...); not finite where that is no depth."""
    output = np.asarray(output, np.float64)
    if kind == INVERSE:
        return np.stack((output, np.ones_like(output)), axis=-1)
    return np.divide(1.0, output, out=np.full(output.shape, np.nan), where=output > LEAST)[..., None]


def fitted(stamp_ns: int, rows: np.ndarray, inverse_depth: np.ndarray, sigma: np.ndarray) -> Fit:
    """The factors that one frame's points (n, k), (n,), (n,) tell. Raises ScaleError."""
    usable = np.isfinite(rows).all(axis=1)
    rows, inverse_depth, sigma = rows[usable], inverse_depth[usable], sigma[usable]
    allowed = np.sqrt((3 * sigma) ** 2 + (TOLERANCE * inverse_depth) ** 2)
    weights = 1 / (sigma**2 + (SPREAD * inverse_depth) ** 2)
    factors = _best(rows, inverse_depth, allowed)
    for _ in range(ROUNDS):
        fits = np.abs(rows @ factors - inverse_depth) < allowed
        share = float(fits.mean()) if len(fits) else 0.0
        if share < LEAST_SHARE:
            raise ScaleError(f"the network's depth fits {share:.0%} of the points whose depth its movement shows")
        within = np.where(fits, weights, 0.0) * min(1.0, WORTH / fits.sum())
        normal, right = (rows * within[:, None]).T @ rows, (rows * within[:, None]).T @ inverse_depth
        if np.linalg.cond(normal / np.outer(*(np.sqrt(np.diag(normal)),) * 2)) > 1 / SINGULAR:
            raise ScaleError("the network gives the same everywhere")
        factors = np.linalg.solve(normal, right)
    if not factors[0] > 0:
        raise ScaleError(
            "the network's output falls where inverse depth rises: --depth-output says whether it is inverse depth or "
            "depth"
        )
    return Fit(stamp_ns, normal, right)


def _best(rows: np.ndarray, inverse_depth: np.ndarray, allowed: np.ndarray) -> np.ndarray:
    """The candidate that fits most points best; zero where no points make one."""
    size = rows.shape[1]
    order = np.argsort(rows[:, 0], kind="stable")
    chosen = order[np.unique(np.linspace(0, len(order) - 1, CANDIDATES).astype(int))] if len(order) else order
    groups = np.array(list(combinations(chosen.tolist(), size)), int).reshape(-1, size)
    matrices = rows[groups]
    apart = np.abs(np.linalg.det(matrices)) > SINGULAR * np.abs(rows[:, 0]).max(initial=0.0)
    if not apart.any():
        return np.zeros(size)
    candidates = np.linalg.solve(matrices[apart], inverse_depth[groups[apart]][..., None])[..., 0]
    errors = (candidates @ rows.T - inverse_depth) / allowed
    found: np.ndarray = candidates[int(np.minimum(errors**2, 1.0).sum(axis=1).argmin())]
    return found

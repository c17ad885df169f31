"""Which landmarks of two maps may be the same, and which of these pairs agree with each other (pure).

Two pairs agree when both maps have the same distance between their landmarks, the same difference of heights, and a
heading in common: gravity is known, so a motion has four numbers. A set in which all agree is a maximum clique of the
pairs' graph, sought for each window of headings.
"""

from typing import NamedTuple

import numpy as np

from prior_sg.deploy.fleet.core.finding.cliques import maximum_clique
from prior_sg.deploy.fleet.core.finding.config import MatchConfig
from prior_sg.deploy.fleet.core.finding.frames import apart, fitted, wrapped
from prior_sg.deploy.fleet.core.finding.landmarks import OBJECT, Landmarks
from prior_sg.services.geometry import transform

LEAST_CLIQUE = 3
NEAR_M = 0.8  # below this distance two landmarks tell no heading
SIZE_SPREAD = 0.35  # standard deviation of the log of a size of one object in two maps
RADIUS_SPREAD_M = 0.12
PLAIN = -0.4  # what a pair of hubs or doors is worth before their sizes are compared
AROUND = 1.5  # how much neighbourhoods alike are worth
MEAN_AROUND = 0.5  # what any two neighbourhoods of one map's kind have in common


class Pairs(NamedTuple):
    """Landmarks of map a and of map b that may be the same, likeliest first."""

    rows_a: np.ndarray  # (pair,)
    rows_b: np.ndarray  # (pair,)
    alike: np.ndarray  # (pair,) log-likelihood ratio


class Hypothesis(NamedTuple):
    """One motion, and the pairs that speak for it."""

    b_from_a: np.ndarray  # (4, 4)
    pairs: np.ndarray  # (n,) numbers of Pairs
    weight: float


def pairs_of(a: Landmarks, b: Landmarks, cfg: MatchConfig) -> Pairs:
    """The likeliest pairs."""
    alike = likeness(a, b)
    rows_a, rows_b = np.nonzero(alike > cfg.least_alike)
    scores = alike[rows_a, rows_b]
    order = np.argsort(-scores, kind="stable")[: cfg.most_pairs]
    return Pairs(rows_a[order], rows_b[order], scores[order])


def likeness(a: Landmarks, b: Landmarks) -> np.ndarray:
    """Log-likelihood ratio (a, b) of being the same against being any two; minus infinity of different kinds.

    A name that is everywhere tells less: chance is the share of each name among all objects of both maps.
    """
    objects = np.concatenate((a.beliefs[a.kinds == OBJECT], b.beliefs[b.kinds == OBJECT]))
    share = objects.mean(axis=0) if len(objects) else np.ones(a.beliefs.shape[1])
    names = np.log(np.maximum((a.beliefs / np.maximum(share, 1e-6)) @ b.beliefs.T, 1e-6))
    logs = np.log(np.maximum(a.sizes_m[:, None], 0.05)) - np.log(np.maximum(b.sizes_m[None], 0.05))
    sizes = 1.0 - ((logs / SIZE_SPREAD) ** 2).sum(axis=2) / 2
    radii = PLAIN + 1.0 - ((a.sizes_m[:, None, 0] - b.sizes_m[None, :, 0]) / RADIUS_SPREAD_M) ** 2 / 2
    around = AROUND * (a.surroundings @ b.surroundings.T - MEAN_AROUND)
    same = a.kinds[:, None] == b.kinds[None]
    of_object = (a.kinds == OBJECT)[:, None]
    return np.where(same, np.where(of_object, names + sizes, radii) + around, -np.inf)


def hypotheses(a: Landmarks, b: Landmarks, cfg: MatchConfig) -> list[Hypothesis]:
    """Motions b_from_a for which sets of pairs speak, the heaviest first, no two alike."""
    pairs = pairs_of(a, b, cfg)
    if len(pairs.alike) < LEAST_CLIQUE:
        return []
    points_a, points_b = a.positions_m[pairs.rows_a], b.positions_m[pairs.rows_b]
    agree, turns, turning = _agreement(points_a, points_b, pairs, cfg)
    found: list[Hypothesis] = []
    for middle in np.arange(-np.pi, np.pi, cfg.window_rad):
        window = agree & (~turning | (np.abs(wrapped(turns - middle)) < cfg.window_rad))
        useful = np.flatnonzero((window & turning).any(axis=1))
        if len(useful) < LEAST_CLIQUE:
            continue
        clique = useful[maximum_clique(window[np.ix_(useful, useful)]).nodes]
        if len(clique) >= LEAST_CLIQUE and (made := _settled(points_a, points_b, pairs, clique, cfg)) is not None:
            found.append(made)
    middle_m = a.positions_m.mean(axis=0)
    kept: list[Hypothesis] = []
    for one in sorted(found, key=lambda made: -made.weight):
        if not any(_same(one.b_from_a, other.b_from_a, middle_m, cfg) for other in kept):
            kept.append(one)
    return kept[: cfg.hypotheses]


def _same(one: np.ndarray, other: np.ndarray, around_m: np.ndarray, cfg: MatchConfig) -> bool:
    gap_m, gap_rad = apart(one, other, around_m)
    return gap_m < cfg.distinct_m and gap_rad < cfg.distinct_rad


def _agreement(
    points_a: np.ndarray, points_b: np.ndarray, pairs: Pairs, cfg: MatchConfig
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which pairs agree (pair, pair), the heading of b against a that any two say, and whether they say one."""
    gaps_a, gaps_b = points_a[:, None] - points_a, points_b[:, None] - points_b
    lengths_a, lengths_b = (np.linalg.norm(gaps[..., :2], axis=2) for gaps in (gaps_a, gaps_b))
    slack_m = cfg.tolerance_m + cfg.tolerance_share * lengths_a
    agree = (np.abs(lengths_a - lengths_b) < slack_m) & (np.abs(gaps_a[..., 2] - gaps_b[..., 2]) < cfg.height_m)
    agree &= pairs.rows_a[:, None] != pairs.rows_a
    agree &= pairs.rows_b[:, None] != pairs.rows_b
    turns = wrapped(np.arctan2(gaps_b[..., 1], gaps_b[..., 0]) - np.arctan2(gaps_a[..., 1], gaps_a[..., 0]))
    return agree, turns, np.minimum(lengths_a, lengths_b) > NEAR_M


def _settled(
    points_a: np.ndarray, points_b: np.ndarray, pairs: Pairs, clique: np.ndarray, cfg: MatchConfig
) -> Hypothesis | None:
    """The motion of a clique, fitted again to all pairs that it brings together, each landmark once."""
    chosen, pose = clique, np.eye(4)
    for _ in range(3):
        if len(chosen) < LEAST_CLIQUE:
            return None
        pose = fitted(points_a[chosen], points_b[chosen], np.maximum(pairs.alike[chosen], 0.0) + 0.3)
        off_m = np.linalg.norm(transform(pose, points_a) - points_b, axis=1)
        chosen = _each_once(np.flatnonzero(off_m < 1.5 * cfg.tolerance_m), off_m, pairs)
    if len(chosen) < LEAST_CLIQUE:
        return None
    return Hypothesis(pose, chosen, float(np.maximum(pairs.alike[chosen], 0.1).sum()))


def _each_once(near: np.ndarray, off_m: np.ndarray, pairs: Pairs) -> np.ndarray:
    """Of pairs that share a landmark, the nearest."""
    taken_a: set[int] = set()
    taken_b: set[int] = set()
    kept = []
    for at in near[np.argsort(off_m[near], kind="stable")].tolist():
        one, other = int(pairs.rows_a[at]), int(pairs.rows_b[at])
        if one not in taken_a and other not in taken_b:
            taken_a.add(one)
            taken_b.add(other)
            kept.append(at)
    return np.array(kept, np.int64)

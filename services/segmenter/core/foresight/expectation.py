"""What a prior and a map together expect: from one region to the next (pure).

    log T(i, r) = a log P(ri <-> rj) + b log P(r | E0) + f(n_r) + m log(1 + c_ir) + const

is the distribution of the label r of another region that one comes to from a region of label i. n_r regions of r have
been found, so f takes away what is there once, and adds what is there often: a home has one kitchen, a ward many
patient rooms. c_ir is how often a region of i was seen beside one of r in this very map.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from prior_sg.schemas.priors import Prior
from prior_sg.schemas.regions import Region
from prior_sg.services.segmenter.core.foresight.config import ForesightConfig

FLOOR = 1e-4  # least probability in a logarithm


@dataclass(frozen=True)
class Found:
    """What a map holds, by label."""

    regions: np.ndarray  # (label,) how many
    borders: np.ndarray  # (label, label) pairs of them that touch, symmetric

    @classmethod
    def of(cls, regions: Iterable[Region], labels: list[str], least_places: int) -> "Found":
        """Of regions with at least so many places; their neighbours count alike."""
        numbers = {label: number for number, label in enumerate(labels)}
        large = {one.id: one for one in regions if one.place_count >= least_places and one.label in numbers}
        counts, borders = np.zeros(len(labels)), np.zeros((len(labels), len(labels)))
        for one in large.values():
            counts[numbers[one.label]] += 1
            for other in one.neighbour_ids:
                if other > one.id and other in large:
                    borders[numbers[one.label], numbers[large[other].label]] += 1
        return cls(counts, borders + np.triu(borders, 1).T + np.tril(borders, -1).T)


@dataclass(frozen=True)
class Expectation:
    """What comes after each label, and what is told of the labels themselves."""

    next: np.ndarray  # (label, label) rows sum to one: another region, the one before given
    spread: np.ndarray  # (label,) mean number of other labels' regions that touch one, by the prior
    adjacency: np.ndarray  # (label, label) of the prior
    existence: np.ndarray  # (label,) of the prior
    found: np.ndarray  # (label,) regions of it that the map holds


def features(prior: Prior, found: Found) -> np.ndarray:
    """What the log-odds of T(i, r) are made of, (label, label, feature), in the order of `weights`."""
    existence = np.array([region.existence for region in prior.regions])
    count = len(existence)
    same = np.eye(count, dtype=bool)
    adjacency = np.log(np.maximum(prior.adjacency.astype(np.float64), FLOOR))
    number = found.regions
    columns = (
        np.where(same, 0.0, adjacency),
        np.broadcast_to(np.log(np.maximum(existence, FLOOR)), (count, count)),
        same.astype(float),
        np.broadcast_to(number == 1, (count, count)).astype(float),
        np.broadcast_to(number >= 2, (count, count)).astype(float),
        np.broadcast_to(np.log(np.maximum(number, 2) / 2), (count, count)),
        np.log1p(found.borders),
    )
    return np.stack(columns, axis=2)


def weights(cfg: ForesightConfig) -> np.ndarray:
    """Weight (feature,) of each of `features`."""
    return np.array(
        [cfg.adjacency, cfg.existence, cfg.again, cfg.found_once, cfg.found_often, cfg.found_count, cfg.met]
    )


def expected(prior: Prior, found: Found, cfg: ForesightConfig) -> Expectation:
    """The chain of a prior and what was found."""
    score = features(prior, found) @ weights(cfg)
    odds = np.exp(score - score.max(axis=1, keepdims=True))
    existence = np.array([region.existence for region in prior.regions])
    beside = prior.adjacency.astype(np.float64) * existence
    np.fill_diagonal(beside, 0.0)
    return Expectation(
        next=odds / odds.sum(axis=1, keepdims=True),
        spread=len(existence) * beside.sum(axis=1),
        adjacency=prior.adjacency.astype(np.float64),
        existence=existence,
        found=found.regions,
    )

"""Weights of foresight, fitted to what openings of worlds revealed; run as a module, it prints them.

Both parts of the model are logistic, so that each has one best fit: whether the same region goes on, and which other
one comes, where a region is taken for what it most likely is. Every world counts alike.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import msgspec
import numpy as np
from scipy.optimize import minimize
from scipy.special import expit, log_softmax

from prior_sg.deploy.evaluation.foresight.trials import SAME, Moment, moments, trial
from prior_sg.deploy.evaluation.worlds import KINDS
from prior_sg.schemas.priors import Prior
from prior_sg.services.segmenter.core.foresight.beyond import same_features
from prior_sg.services.segmenter.core.foresight.config import ForesightConfig
from prior_sg.services.segmenter.core.foresight.expectation import expected, features

TUNED = range(0, 30)  # seeds that constants are chosen on
RIDGE = 1e-2  # of the mean log-likelihood, around what is thought without worlds:
THOUGHT = (1.0, 1.0, -1.0, -1.0, 0.0, 0.5, 0.5)  # weights of another region's label
Walk = tuple[Sequence[Moment], Prior]


class Rows(NamedTuple):
    """What openings of one world revealed, and what the model reads of them."""

    same: np.ndarray  # (event, feature)
    goes_on: np.ndarray  # (event,) bool
    other: np.ndarray  # (event of another region, label, feature)
    came: np.ndarray  # (event of another region,) label


def fitted(walks: Sequence[Walk], cfg: ForesightConfig = ForesightConfig()) -> ForesightConfig:
    """The settings that make what was revealed likeliest."""
    rows = [_rows(*walk, cfg) for walk in walks if any(len(moment.outcomes) for moment in walk[0])]
    same = _least(_same_loss, rows, np.zeros(rows[0].same.shape[1]))
    other = _least(_other_loss, [one for one in rows if len(one.came)], np.array(THOUGHT))
    adjacency, existence, again, once, often, count, met = np.round(other, 2).tolist()
    *by_width, by_area, by_spread = np.round(same, 2).tolist()
    return msgspec.structs.replace(
        cfg,
        same_by_width=tuple(by_width),
        same_by_area=by_area,
        same_by_spread=by_spread,
        adjacency=adjacency,
        existence=existence,
        again=again,
        found_once=once,
        found_often=often,
        found_count=count,
        met=met,
    )


def _rows(walk: Sequence[Moment], prior: Prior, cfg: ForesightConfig) -> Rows:
    kept = [moment for moment in walk if len(moment.outcomes)]
    came = np.concatenate([moment.outcomes for moment in kept])
    same = [same_features(moment.views, expected(prior, moment.found, cfg).spread, cfg) for moment in kept]
    other = [features(prior, moment.found)[moment.views.beliefs.argmax(axis=1)] for moment in kept]
    changes = came != SAME
    return Rows(np.concatenate(same), ~changes, np.concatenate(other)[changes], came[changes])


def _same_loss(weights: np.ndarray, one: Rows) -> tuple[float, np.ndarray]:
    """Mean negative log-likelihood of one world, and its gradient."""
    sign = np.where(one.goes_on, 1.0, -1.0)
    logit = sign * (one.same @ weights)
    return float(np.logaddexp(0, -logit).mean()), -((sign * expit(-logit)) @ one.same) / len(logit)


def _other_loss(weights: np.ndarray, one: Rows) -> tuple[float, np.ndarray]:
    """Mean negative log-likelihood of one world, and its gradient."""
    logs, at = log_softmax(one.other @ weights, axis=1), np.arange(len(one.came))
    mean = np.einsum("er,erf->ef", np.exp(logs), one.other)
    return -float(logs[at, one.came].mean()), (mean - one.other[at, one.came]).mean(axis=0)


def _least(
    loss: Callable[[np.ndarray, Rows], tuple[float, np.ndarray]], rows: Sequence[Rows], around: np.ndarray
) -> np.ndarray:
    def whole(weights: np.ndarray) -> tuple[float, np.ndarray]:
        values, slopes = zip(*(loss(weights, one) for one in rows), strict=True)
        off = weights - around
        return float(np.mean(values)) + RIDGE * float(off @ off), np.mean(slopes, axis=0) + 2 * RIDGE * off

    found: np.ndarray = minimize(whole, around, jac=True, method="L-BFGS-B").x
    return found


def main() -> None:
    """Fit over all kinds, and print."""
    walks = []
    for kind in KINDS:
        for seed in TUNED:
            one = trial(kind, seed)
            walks.append((list(moments(one)), one.prior))
    print(fitted(walks))


if __name__ == "__main__":
    main()

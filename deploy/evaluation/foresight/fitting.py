"""Weights of foresight, fitted to what openings of worlds revealed; run as a module, it prints them.

All parts of the model are logistic, so that each has one best fit. Explorers, whose openings all lead somewhere, tell
whether the same region goes on, which other one comes, where a region is taken for what it most likely is, and what
begins within some metres; maps tell which openings lead anywhere; both, given all that, what is missing. Every world
and every map counts alike.
"""

import argparse
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar

import msgspec
import numpy as np
from scipy.optimize import minimize
from scipy.special import expit, log_softmax

from prior_sg.deploy.evaluation.datasets import named_worlds
from prior_sg.deploy.evaluation.foresight.mapped import ENCODER, mapped
from prior_sg.deploy.evaluation.foresight.searches import searched
from prior_sg.deploy.evaluation.foresight.trials import SAME, Moment, moments, trial
from prior_sg.deploy.evaluation.perception import CACHE, Cache, Perceiver
from prior_sg.deploy.evaluation.worlds import KINDS
from prior_sg.schemas.priors import Prior
from prior_sg.services.segmenter.core.foresight.beyond import (
    beyond,
    leads,
    missing_features,
    missing_weights,
    same_features,
    same_weights,
    toward_features,
    toward_weights,
    within_features,
    within_weights,
)
from prior_sg.services.segmenter.core.foresight.config import ForesightConfig
from prior_sg.services.segmenter.core.foresight.expectation import expected, features

TUNED = range(0, 30)  # seeds that constants are chosen on
RIDGE = 1e-2  # of the mean log-likelihood, around what is thought without worlds:
SEARCHES = 4  # of each world
TOWARD_RIDGE = 3e-3
LOOSE = 1e-4  # the same of chances by opening and label, which are thousands of events a world
THOUGHT = (1.0, 1.0, -1.0, -1.0, 0.0, 0.5, 0.5)  # weights of another region's label
WITHIN = [name for name in ForesightConfig.__struct_fields__ if name.startswith("within_")]
TOWARD = [name for name in ForesightConfig.__struct_fields__ if name.startswith("toward_")]
FADING_M = 8.0  # unseen way over which what is come to counts less by e: searches seldom get that far
LEADS = [name for name in ForesightConfig.__struct_fields__ if name.startswith("leads_")]
MISSING = [name for name in ForesightConfig.__struct_fields__ if name.startswith("missing_")]
Walk = tuple[Sequence[Moment], Prior]
Read = TypeVar("Read")  # what the model reads of one world


class Rows(NamedTuple):
    """What openings of one world revealed, and what the model reads of them."""

    same: np.ndarray  # (event, feature)
    goes_on: np.ndarray  # (event,) bool
    other: np.ndarray  # (event of another region, label, feature)
    came: np.ndarray  # (event of another region,) label


class Way(NamedTuple):
    """The openings of one moment, for labels that are left."""

    rows: np.ndarray  # (opening, label, feature)
    came: np.ndarray  # (label,) the opening that one comes to it through
    counts: np.ndarray  # (label,) how much it counts


def fitted(walks: Sequence[Walk], cfg: ForesightConfig = ForesightConfig()) -> ForesightConfig:
    """The settings that make what was revealed likeliest."""
    rows = [_rows(*walk, cfg) for walk in walks if any(len(moment.outcomes) for moment in walk[0])]
    same = _least(lambda weights, one: _loss(weights, one.same, one.goes_on), rows, np.zeros(rows[0].same.shape[1]))
    other = _least(_other_loss, [one for one in rows if len(one.came)], np.array(THOUGHT))
    adjacency, existence, again, once, often, count, met = np.round(other, 2).tolist()
    *by_width, by_area, by_spread = np.round(same, 2).tolist()
    return msgspec.structs.replace(
        _with_missing(walks, fitted_within(walks, cfg)),
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


def fitted_within(walks: Sequence[Walk], cfg: ForesightConfig) -> ForesightConfig:
    """The settings with the best weights of what begins behind an opening."""
    rows = [_within(*walk, cfg) for walk in walks if any(len(moment.outcomes) for moment in walk[0])]
    within = _least(lambda weights, one: _loss(weights, *one), rows, within_weights(cfg), LOOSE)
    return msgspec.structs.replace(cfg, **dict(zip(WITHIN, np.round(within, 2).tolist(), strict=True)))


def fitted_toward(walks: Sequence[Walk], cfg: ForesightConfig) -> ForesightConfig:
    """The settings with the best weights of which opening leads to a region that is left, given what begins behind;
    `walks` are searches, for exploring comes to other openings."""
    rows = [_ways(*walk, cfg) for walk in walks]
    toward = _least(_toward_loss, [one for one in rows if one], toward_weights(cfg), TOWARD_RIDGE)
    return msgspec.structs.replace(cfg, **dict(zip(TOWARD, np.round(toward, 2).tolist(), strict=True)))


def fitted_to_maps(maps: Sequence[Walk], walks: Sequence[Walk], cfg: ForesightConfig) -> ForesightConfig:
    """The settings with the best weights of whether openings lead anywhere, by maps, and of what is missing, by both;
    what explorers alone tell stays as it is."""
    signs = [_signs(walk) for walk, _ in maps]
    leads = _least(lambda weights, one: _loss(weights, *one), signs, np.zeros(len(LEADS)), LOOSE)
    cfg = msgspec.structs.replace(cfg, **dict(zip(LEADS, np.round(leads, 2).tolist(), strict=True)))
    return _with_missing([*walks, *maps], cfg)


def _with_missing(walks: Sequence[Walk], cfg: ForesightConfig) -> ForesightConfig:
    left = [_left(*walk, cfg) for walk in walks]
    missing = _least(lambda weights, one: _loss(weights, *one), left, missing_weights(cfg), LOOSE)
    return msgspec.structs.replace(cfg, **dict(zip(MISSING, np.round(missing, 2).tolist(), strict=True)))


def _rows(walk: Sequence[Moment], prior: Prior, cfg: ForesightConfig) -> Rows:
    kept = [moment for moment in walk if len(moment.outcomes)]
    came = np.concatenate([moment.outcomes for moment in kept])
    chains = [expected(prior, moment.found, cfg) for moment in kept]
    same = [same_features(moment.views, chain.spread, cfg) for moment, chain in zip(kept, chains, strict=True)]
    other = [features(prior, moment.found)[moment.views.beliefs.argmax(axis=1)] for moment in kept]
    changes = came != SAME
    return Rows(
        np.concatenate(same),
        ~changes,
        np.concatenate(other)[changes],
        came[changes],
    )


def _within(walk: Sequence[Moment], prior: Prior, cfg: ForesightConfig) -> tuple[np.ndarray, np.ndarray]:
    """What the model reads of each label at each opening (event and label, feature), and whether it begins there."""
    kept = [moment for moment in walk if len(moment.outcomes)]
    rows = [within_features(moment.views, expected(prior, moment.found, cfg), len(moment.outcomes)) for moment in kept]
    return (
        np.concatenate([one.reshape(-1, one.shape[2]) for one in rows]),
        np.concatenate([moment.met.reshape(-1) for moment in kept]),
    )


def _ways(walk: Sequence[Moment], prior: Prior, cfg: ForesightConfig) -> list[Way]:
    """What the model reads of the openings of each moment, for labels that are left."""
    found = []
    for moment in walk:
        if moment.ways is None or len(moment.outcomes) < 2:
            continue
        through, deep_m = moment.ways
        labels = np.flatnonzero(through >= 0)
        if len(labels):
            chain, views = expected(prior, moment.found, cfg), moment.views
            within = expit(within_features(views, chain, leads(views, cfg).sum()) @ within_weights(cfg))
            goes_on = same_features(views, chain.spread, cfg) @ same_weights(cfg)
            rows = toward_features(views, chain, within, goes_on)[:, labels]
            found.append(Way(rows, through[labels], np.exp(-deep_m[labels] / FADING_M)))
    return found


def _signs(walk: Sequence[Moment]) -> tuple[np.ndarray, np.ndarray]:
    """What a map's openings look like (event, feature), and whether they led anywhere (event,)."""
    told = [(one.views.signs, one.led) for one in walk if one.views.signs is not None and one.led is not None]
    signs, led = zip(*told, strict=True)
    return np.concatenate(signs), np.concatenate(led)


def _left(walk: Sequence[Moment], prior: Prior, cfg: ForesightConfig) -> tuple[np.ndarray, np.ndarray]:
    """What the model reads of each label at each moment (moment and label, feature), and whether one is missing."""
    kept = [moment for moment in walk if len(moment.outcomes)]
    rows = []
    for moment in kept:
        chain = expected(prior, moment.found, cfg)
        rows.append(missing_features(beyond(moment.views, chain, cfg).within, chain))
    return np.concatenate(rows), np.concatenate([moment.left for moment in kept])


def _loss(weights: np.ndarray, rows: np.ndarray, true: np.ndarray) -> tuple[float, np.ndarray]:
    """Mean negative log-likelihood of what is true (event,) or not, and its gradient."""
    sign = np.where(true, 1.0, -1.0)
    logit = sign * (rows @ weights)
    return float(np.logaddexp(0, -logit).mean()), -((sign * expit(-logit)) @ rows) / len(logit)


def _toward_loss(weights: np.ndarray, ways: Sequence[Way]) -> tuple[float, np.ndarray]:
    """Mean negative log-likelihood of the openings of one world that led to what was left, and its gradient."""
    total, slope, whole = 0.0, np.zeros(len(weights)), 0.0
    for way in ways:
        logs, at = log_softmax(way.rows @ weights, axis=0), np.arange(len(way.came))
        off = np.einsum("ol,olf->lf", np.exp(logs), way.rows) - way.rows[way.came, at]
        total -= float(way.counts @ logs[way.came, at])
        slope += way.counts @ off
        whole += float(way.counts.sum())
    return total / whole, slope / whole


def _other_loss(weights: np.ndarray, one: Rows) -> tuple[float, np.ndarray]:
    """Mean negative log-likelihood of one world, and its gradient."""
    logs, at = log_softmax(one.other @ weights, axis=1), np.arange(len(one.came))
    mean = np.einsum("er,erf->ef", np.exp(logs), one.other)
    return -float(logs[at, one.came].mean()), (mean - one.other[at, one.came]).mean(axis=0)


def _least(
    loss: Callable[[np.ndarray, Read], tuple[float, np.ndarray]],
    rows: Sequence[Read],
    around: np.ndarray,
    ridge: float = RIDGE,
) -> np.ndarray:
    def whole(weights: np.ndarray) -> tuple[float, np.ndarray]:
        values, slopes = zip(*(loss(weights, one) for one in rows), strict=True)
        off = weights - around
        return float(np.mean(values)) + ridge * float(off @ off), np.mean(slopes, axis=0) + 2 * ridge * off

    found: np.ndarray = minimize(whole, around, jac=True, method="L-BFGS-B").x
    return found


def main() -> None:
    """Fit over all kinds, and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--seeds", type=int, default=len(TUNED), help="the first so many of those that are for tuning")
    parser.add_argument(
        "--maps", nargs="*", default=[], metavar="world:KIND:SEEDS", help="maps that are fitted to, too"
    )
    kept = parser.add_mutually_exclusive_group()
    kept.add_argument("--keep", action="store_true", help="what explorers alone tell stays as it is set")
    kept.add_argument("--within", action="store_true", help="only what begins behind openings is fitted")
    kept.add_argument("--toward", action="store_true", help="only which opening leads to what is left, by searches")
    given = parser.parse_args()
    walks, cfg = [], ForesightConfig()
    for kind in given.kinds.split(","):
        for seed in TUNED[: given.seeds]:
            one = trial(kind, seed)
            walked = searched(one, SEARCHES, cfg) if given.toward else moments(one)
            walks.append((list(walked), one.prior))
    if not given.keep:
        fit = fitted_within if given.within else fitted_toward if given.toward else fitted
        cfg = fit(walks, cfg)
    names = [name for text in given.maps for name in named_worlds(text)]
    perceiver = Perceiver({}, Cache(CACHE), lambda *_: None, ENCODER)
    maps = [mapped(name.kind, name.seed, perceiver) for name in names]
    print(fitted_to_maps(maps, walks, cfg) if maps else cfg)


if __name__ == "__main__":
    main()

"""What lies beyond an opening (pure).

    P(the same region goes on) = sigmoid(by the opening's width + by what was seen of the region + by its label)
    P(another region r)        = (1 - P(same)) sum_i P(i) T(i, r)
    P(r within some metres)    = sigmoid(by the opening, by the label of the region it opens from, by r)

with P(i) the belief of the region it opens from and T from `expectation`. The first two are of what is seen first, the
third of all that begins within REACH_M: a corridor that goes on shows none of the rooms along it and leads to them.
"""

from dataclasses import dataclass

import numpy as np

from prior_sg.services.segmenter.core.foresight.config import ForesightConfig
from prior_sg.services.segmenter.core.foresight.expectation import FLOOR, Expectation


@dataclass(frozen=True)
class Views:
    """Openings as far as they tell what lies beyond."""

    beliefs: np.ndarray  # (opening, label) of the region it opens from, rows sum to one
    widths_m: np.ndarray  # (opening,)
    areas_m2: np.ndarray  # (opening,) seen of that region


@dataclass(frozen=True)
class Beyond:
    """What is expected beyond each opening."""

    same: np.ndarray  # (opening,) that the region it opens from goes on
    next: np.ndarray  # (opening, label) another region; with `same`, rows sum to one
    within: np.ndarray  # (opening, label) that such a region begins within REACH_M
    missing: np.ndarray  # (label,) that one more region of that label is behind any of the openings


def same_features(views: Views, spread: np.ndarray, cfg: ForesightConfig) -> np.ndarray:
    """What the logit of P(same) is made of (opening, feature): classes of width, then area and spread."""
    classes = np.searchsorted(cfg.widths_m, views.widths_m, side="right")
    area = np.log1p(views.areas_m2)
    beside = np.log(np.maximum(views.beliefs @ spread, FLOOR))
    return np.column_stack((np.eye(len(cfg.widths_m) + 1)[classes], area, beside))


def same_weights(cfg: ForesightConfig) -> np.ndarray:
    """Weight (feature,) of each of `same_features`."""
    return np.array([*cfg.same_by_width, cfg.same_by_area, cfg.same_by_spread])


def within_features(views: Views, expectation: Expectation) -> np.ndarray:
    """What the logit of P(r within some metres) is made of (opening, label, feature), in the order of
    `within_weights`."""
    count, labels = views.beliefs.shape
    beside = np.log(np.maximum(views.beliefs @ expectation.spread, FLOOR))
    of_openings = (np.ones(count), np.log(views.widths_m), np.log1p(views.areas_m2), beside)
    columns = (
        *(np.broadcast_to(column[:, None], (count, labels)) for column in of_openings),
        np.full((count, labels), np.log(max(count, 1))),
        np.log(np.maximum(views.beliefs @ expectation.adjacency, FLOOR)),
        np.broadcast_to(np.log(np.maximum(expectation.existence, FLOOR)), (count, labels)),
        views.beliefs,
        np.broadcast_to(expectation.found == 1, (count, labels)).astype(float),
        np.broadcast_to(expectation.found >= 2, (count, labels)).astype(float),
    )
    return np.stack(columns, axis=2)


def within_weights(cfg: ForesightConfig) -> np.ndarray:
    """Weight (feature,) of each of `within_features`."""
    return np.array(
        [
            *(cfg.within_bias, cfg.within_width, cfg.within_area, cfg.within_spread, cfg.within_openings),
            *(cfg.within_adjacency, cfg.within_existence, cfg.within_again, cfg.within_once, cfg.within_often),
        ]
    )


def missing_features(within: np.ndarray, expectation: Expectation) -> np.ndarray:
    """What the logit of P(missing) is made of (label, feature), in the order of `missing_weights`.

    Openings of one map lead to the same rooms, so that their chances do not multiply.
    """
    columns = (
        np.ones(within.shape[1]),
        np.log(np.maximum(within.sum(axis=0), FLOOR)),
        np.log(np.maximum(expectation.existence, FLOOR)),
        expectation.found == 1,
        expectation.found >= 2,
    )
    return np.column_stack(columns)


def missing_weights(cfg: ForesightConfig) -> np.ndarray:
    """Weight (feature,) of each of `missing_features`."""
    return np.array([cfg.missing_bias, cfg.missing_sum, cfg.missing_existence, cfg.missing_once, cfg.missing_often])


def beyond(views: Views, expectation: Expectation, cfg: ForesightConfig) -> Beyond:
    """What is expected beyond each opening; behind none, nothing is missing."""
    same = _sigmoid(same_features(views, expectation.spread, cfg) @ same_weights(cfg))
    another = (1.0 - same)[:, None] * (views.beliefs @ expectation.next)
    within = _sigmoid(within_features(views, expectation) @ within_weights(cfg))
    missing = _sigmoid(missing_features(within, expectation) @ missing_weights(cfg))
    return Beyond(same, another, within, missing if len(same) else np.zeros(len(missing)))


def _sigmoid(logits: np.ndarray) -> np.ndarray:
    return np.asarray(1.0 / (1.0 + np.exp(-logits)))

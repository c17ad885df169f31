"""What lies beyond an opening (pure).

    P(it leads anywhere)       = sigmoid(by its width, its direction and what is covered behind it)
    P(the same region goes on) = sigmoid(by the opening's width + by what was seen of the region + by its label)
    P(another region r)        = P(leads) (1 - P(goes on)) sum_i P(i) T(i, r)
    P(r within some metres)    = P(leads) sigmoid(by the opening and what is around it, by the label of the region it
                                 opens from, by r)
    P(toward an opening | r)   ~ P(leads) exp(by P(r within some metres) and, again, by the opening, the label of the
                                 region it opens from and what is around it)

with P(i) the belief of the region it opens from and T from `expectation`. Of a map's openings most lead nowhere: they
are shadows of furniture, gaps in depth, ceilings. P(goes on) and P(r) are of what is seen first, the last of all that
begins within REACH_M: a corridor that goes on shows none of the rooms along it and leads to them. What is looked for
often lies deeper, up a stair or along a corridor; P(toward) is of where one comes to it, however far behind.
"""

from dataclasses import dataclass

import numpy as np

from prior_sg.services.segmenter.core.foresight.around import Around
from prior_sg.services.segmenter.core.foresight.config import ForesightConfig
from prior_sg.services.segmenter.core.foresight.expectation import FLOOR, Expectation


@dataclass(frozen=True)
class Views:
    """Openings as far as they tell what lies beyond."""

    beliefs: np.ndarray  # (opening, label) of the region it opens from, rows sum to one
    widths_m: np.ndarray  # (opening,)
    areas_m2: np.ndarray  # (opening,) seen of that region
    around: Around
    signs: np.ndarray | None = None  # (opening, feature) of `leads_features`; None = all are known to lead somewhere


@dataclass(frozen=True)
class Beyond:
    """What is expected beyond each opening."""

    same: np.ndarray  # (opening,) that the region it opens from goes on, or nothing is behind
    next: np.ndarray  # (opening, label) another region; with `same`, rows sum to one
    within: np.ndarray  # (opening, label) that such a region begins within REACH_M
    toward: np.ndarray  # (opening, label) that the nearest such region, if one is left, is come to through this opening
    missing: np.ndarray  # (label,) that one more region of that label is behind any of the openings


def leads_features(widths_m: np.ndarray, rises: np.ndarray, unseen: np.ndarray) -> np.ndarray:
    """What the logit of P(leads) is made of (opening, feature), in the order of `leads_weights`; the arguments
    (opening,) are those of `Openings`."""
    return np.column_stack((np.ones(len(widths_m)), np.log(widths_m), rises, unseen))


def leads_weights(cfg: ForesightConfig) -> np.ndarray:
    """Weight (feature,) of each of `leads_features`."""
    return np.array([cfg.leads_bias, cfg.leads_width, cfg.leads_rise, cfg.leads_unseen])


def leads(views: Views, cfg: ForesightConfig) -> np.ndarray:
    """Chance (opening,) that there is unobserved floor behind each."""
    return np.ones(len(views.widths_m)) if views.signs is None else _sigmoid(views.signs @ leads_weights(cfg))


def same_features(views: Views, spread: np.ndarray, cfg: ForesightConfig) -> np.ndarray:
    """What the logit of P(same) is made of (opening, feature): classes of width, then area and spread."""
    classes = np.searchsorted(cfg.widths_m, views.widths_m, side="right")
    area = np.log1p(views.areas_m2)
    beside = np.log(np.maximum(views.beliefs @ spread, FLOOR))
    return np.column_stack((np.eye(len(cfg.widths_m) + 1)[classes], area, beside))


def same_weights(cfg: ForesightConfig) -> np.ndarray:
    """Weight (feature,) of each of `same_features`."""
    return np.array([*cfg.same_by_width, cfg.same_by_area, cfg.same_by_spread])


def within_features(views: Views, expectation: Expectation, leading: float) -> np.ndarray:
    """What the logit of P(r within some metres) is made of (opening, label, feature), in the order of
    `within_weights`, for openings that lead somewhere; so many of the map's do."""
    count, labels = views.beliefs.shape
    beside = np.log(np.maximum(views.beliefs @ expectation.spread, FLOOR))
    around = views.around
    of_openings = (np.ones(count), np.log(views.widths_m), np.log1p(views.areas_m2), beside)
    of_around = (np.log1p(around.touching), np.log1p(around.nearby), np.log1p(around.storey_m2))
    adjacency = np.log(np.maximum(views.beliefs @ expectation.adjacency, FLOOR))
    columns = (
        *(np.broadcast_to(column[:, None], (count, labels)) for column in of_openings),
        np.full((count, labels), np.log(max(leading, 1.0))),
        adjacency,
        np.broadcast_to(np.log(np.maximum(expectation.existence, FLOOR)), (count, labels)),
        views.beliefs,
        np.broadcast_to(expectation.found == 1, (count, labels)).astype(float),
        np.broadcast_to(expectation.found >= 2, (count, labels)).astype(float),
        *(np.broadcast_to(column[:, None], (count, labels)) for column in of_around),
        around.at_border[:, None] * adjacency,
    )
    return np.stack(columns, axis=2)


def within_weights(cfg: ForesightConfig) -> np.ndarray:
    """Weight (feature,) of each of `within_features`."""
    return np.array(
        [
            *(cfg.within_bias, cfg.within_width, cfg.within_area, cfg.within_spread, cfg.within_openings),
            *(cfg.within_adjacency, cfg.within_existence, cfg.within_again, cfg.within_once, cfg.within_often),
            *(cfg.within_touching, cfg.within_nearby, cfg.within_storey, cfg.within_at_border),
        ]
    )


def toward_features(views: Views, expectation: Expectation, within: np.ndarray, goes_on: np.ndarray) -> np.ndarray:
    """What the log-odds of P(toward an opening | r) are made of (opening, label, feature), in the order of
    `toward_weights`; `within` (opening, label) are chances behind openings that lead somewhere, `goes_on` (opening,)
    the logit that the same region goes on there."""
    count, labels = within.shape
    beside = np.log(np.maximum(views.beliefs @ expectation.spread, FLOOR))
    adjacency = np.log(np.maximum(views.beliefs @ expectation.adjacency, FLOOR))
    around = views.around
    of_openings = (beside, np.log1p(around.touching), goes_on, np.log(views.widths_m), np.log1p(views.areas_m2))
    of_around = (np.log1p(around.nearby), np.log1p(around.storey_m2), around.at_border)
    columns = (
        np.log(np.maximum(within, FLOOR)),
        adjacency,
        views.beliefs,
        around.at_border[:, None] * adjacency,
        *(np.broadcast_to(column[:, None], (count, labels)) for column in (*of_openings, *of_around)),
    )
    return np.stack(columns, axis=2)


def toward_weights(cfg: ForesightConfig) -> np.ndarray:
    """Weight (feature,) of each of `toward_features`."""
    return np.array(
        [
            *(cfg.toward_within, cfg.toward_adjacency, cfg.toward_again, cfg.toward_border_adjacency),
            *(cfg.toward_spread, cfg.toward_touching, cfg.toward_same, cfg.toward_width, cfg.toward_area),
            *(cfg.toward_nearby, cfg.toward_storey, cfg.toward_at_border),
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
    chance = leads(views, cfg)
    goes_on = same_features(views, expectation.spread, cfg) @ same_weights(cfg)
    same = 1.0 - chance * (1.0 - _sigmoid(goes_on))
    another = (1.0 - same)[:, None] * (views.beliefs @ expectation.next)
    behind = _sigmoid(within_features(views, expectation, chance.sum()) @ within_weights(cfg))
    odds = chance[:, None] * _odds(toward_features(views, expectation, behind, goes_on) @ toward_weights(cfg))
    within = chance[:, None] * behind
    missing = _sigmoid(missing_features(within, expectation) @ missing_weights(cfg))
    toward = odds / odds.sum(axis=0)
    return Beyond(same, another, within, toward, missing if len(same) else np.zeros(len(missing)))


def _odds(scores: np.ndarray) -> np.ndarray:
    """Odds (opening, label) among the openings, the largest of each label 1."""
    return np.asarray(np.exp(scores - scores.max(axis=0, initial=-np.inf)))


def _sigmoid(logits: np.ndarray) -> np.ndarray:
    return np.asarray(1.0 / (1.0 + np.exp(-logits)))

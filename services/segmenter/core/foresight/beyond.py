"""What lies beyond an opening (pure).

    P(the same region goes on) = sigmoid(by the opening's width + by what was seen of the region + by its label)
    P(another region r)        = (1 - P(same)) sum_i P(i) T(i, r)

with P(i) the belief of the region it opens from and T from `expectation`. Where the same region goes on, its other
doors come next, so that what is met within some steps counts both.
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
    within: np.ndarray  # (opening, label) that such a region is met within some steps

    def missing(self) -> np.ndarray:
        """Chance (label,) that one more region of that label is behind any of the openings."""
        return 1.0 - np.prod(1.0 - np.minimum(self.within, 1.0), axis=0)


def same_features(views: Views, spread: np.ndarray, cfg: ForesightConfig) -> np.ndarray:
    """What the logit of P(same) is made of (opening, feature): classes of width, then area and spread."""
    classes = np.searchsorted(cfg.widths_m, views.widths_m, side="right")
    area = np.log1p(views.areas_m2)
    beside = np.log(np.maximum(views.beliefs @ spread, FLOOR))
    return np.column_stack((np.eye(len(cfg.widths_m) + 1)[classes], area, beside))


def same_weights(cfg: ForesightConfig) -> np.ndarray:
    """Weight (feature,) of each of `same_features`."""
    return np.array([*cfg.same_by_width, cfg.same_by_area, cfg.same_by_spread])


def beyond(views: Views, expectation: Expectation, cfg: ForesightConfig) -> Beyond:
    """What is expected beyond each opening."""
    same = 1.0 / (1.0 + np.exp(-same_features(views, expectation.spread, cfg) @ same_weights(cfg)))
    another = views.beliefs @ expectation.next
    ahead = views.beliefs @ expectation.ahead(cfg.steps, cfg.onward)
    later = views.beliefs @ expectation.ahead(max(cfg.steps - 1, 1), cfg.onward)
    leads = views.beliefs @ expectation.leads(cfg.onward)
    within = (1.0 - same)[:, None] * ahead + (leads * same)[:, None] * later
    return Beyond(same, (1.0 - same)[:, None] * another, np.minimum(within, 1.0))

"""Correction of what an encoder favours in a whole scene (beyond the paper; pure).

A weak encoder finds one label everywhere: all rooms of a flat look a little like a dining area, by about the same
amount. Seen from one place that cannot be told from evidence; seen from the whole map it can, for it is most unlikely
that everything is a dining area. So each label gets one bias for the whole map, which brings the mean visual belief
towards the proportions that the prior expects (class priors after Saerens et al., 2002; scaling after Sinkhorn, 1967).
"""

import msgspec
import numpy as np

SCALINGS = 20  # of Sinkhorn's; the bias is bounded anyway, so the rest does not matter


class BalanceConfig(msgspec.Struct, frozen=True, kw_only=True):
    """How far the beliefs of a map are drawn towards the expected proportions."""

    limit: float = 1.2  # greatest bias, in natural logarithms: odds at most tripled. 0 = no correction (paper)
    half_places: float = 20.0  # observed places at which half of the correction is in force: first rooms are no sample
    existence_share: float = 0.0  # of P(r | E0) in the expected proportions; the rest is uniform
    patience: float = 0.2  # share of the map to be seen anew before the bias is computed again, unless idle
    tolerance: float = 0.01  # smaller changes of the bias are not worth asking the experts again

    def __post_init__(self) -> None:
        if not (self.limit >= 0 and self.half_places > 0 and 0 <= self.existence_share <= 1):
            raise ValueError("limit, half_places or existence_share is out of range")


def label_bias(scores: np.ndarray, existence: np.ndarray, cfg: BalanceConfig) -> np.ndarray:
    """What to add to each label's score (label,), zero on average over the labels before it is bounded.

    `scores` (place, label) of the observed places, before the softmax; `existence` (label,) is P(r | E0).
    """
    count, labels = scores.shape
    if not (count and cfg.limit):
        return np.zeros(labels)
    expected = cfg.existence_share * existence / existence.sum() + (1 - cfg.existence_share) / labels
    relative = np.exp(scores - scores.max(axis=1, keepdims=True))
    relative = np.maximum(relative, np.finfo(float).tiny)
    factors = np.ones(labels)
    for _ in range(SCALINGS):
        beliefs = relative * factors
        beliefs /= beliefs.sum(axis=1, keepdims=True)
        factors *= expected / np.maximum(beliefs.mean(axis=0), np.finfo(float).tiny)
        factors /= factors.max()
        factors = np.maximum(factors, np.finfo(float).tiny)
    bias = np.log(factors)
    bias -= bias.mean()
    return np.clip(bias * count / (count + cfg.half_places), -cfg.limit, cfg.limit)

"""The contents expert: what a region as a whole holds (beyond the paper)."""

import numpy as np

from prior_sg.schemas.priors import Prior
from prior_sg.services.segmenter.core.experts.context import Context

LEAST = 0.02  # P(o | r) below which a prior's number says no more: something else may have been mistaken for it
TESTED_HALF = 2.0  # observed regions of a name after which its row counts half


def contents(context: Context) -> tuple[np.ndarray, np.ndarray]:
    """Naive Bayes over the kinds of objects in the region of a place, as of the last look over the map.

    Where the object expert hears the objects near a place, this one lets every place of a region hear all that are in
    it. That asks more of P(o | r): it must be how often such a region is seen to hold the object, by this detector
    under these mistakes. So confidence is how far the prior rests on such counts, 0 for a prior that none has tested;
    and 0 where no object is known.
    """
    scores = context.contents - context.contents.max(axis=1, keepdims=True)
    log_shares = scores - np.log(np.exp(scores).sum(axis=1, keepdims=True))
    return log_shares, np.where(context.contents.any(axis=1), tested(context.prior), 0.0)


def tested(prior: Prior) -> float:
    """How far a prior's containment rests on counts, in [0, 1)."""
    if prior.tested is None:
        return 0.0
    counted = prior.tested.regions.astype(np.float64)
    return float(np.array([region.existence for region in prior.regions]) @ (counted / (counted + TESTED_HALF)))


def words_of_contents(prior: Prior, held: np.ndarray) -> np.ndarray:
    """Sum (region, label) over the objects of log P(o | r) against its mean over the labels; `held` (region, object)
    says how surely each is there. That one is missing says nothing: it may not have been seen."""
    likely = np.maximum(prior.containment.astype(np.float64), LEAST)
    return held @ np.log(likely / likely.mean(axis=0)).T

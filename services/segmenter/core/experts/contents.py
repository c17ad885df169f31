"""The contents expert: what a region as a whole holds (beyond the paper)."""

import numpy as np

from prior_sg.schemas.priors import Prior
from prior_sg.services.segmenter.core.experts.context import Context

LEAST = 0.02  # P(o | r) below which a prior's number says no more: something else may have been mistaken for it
TESTED_HALF = 2.0  # observed regions of a name after which its row counts half


def contents(context: Context) -> tuple[np.ndarray, np.ndarray]:
    """Naive Bayes over the kinds of objects in the region of a place, as of the last look over the map.

    The object expert takes the one thing near a place that says most; here all say something, and far off, as long as
    it is in the same region. That asks more of P(o | r): it must be how often such a region is seen to hold the object,
    by this detector under these mistakes. So only what robots have counted has a say. A prior that none has tested
    says nothing, confidence 0, as where no object is known.
    """
    said = context.contents if context.contents.size else np.zeros((len(context.frames), len(context.prior.regions)))
    scores = said - said.max(axis=1, keepdims=True)
    return scores - np.log(np.exp(scores).sum(axis=1, keepdims=True)), said.any(axis=1).astype(float)


def has_say(prior: Prior) -> bool:
    """Whether robots have counted what regions of a prior hold."""
    return prior.tested is not None and bool(prior.tested.regions.any())


def words_of_contents(prior: Prior, held: np.ndarray) -> np.ndarray:
    """Sum (place, label) over the objects of log P(o | r) against its mean over the labels, as far as the row was
    counted; `held` (place, object) says how surely each is there. One that is missing says nothing: it may not have
    been seen."""
    counted = np.zeros(len(prior.regions)) if prior.tested is None else prior.tested.regions.astype(np.float64)
    likely = np.maximum(prior.containment.astype(np.float64), LEAST)
    words = np.log(likely / likely.mean(axis=0)) * (counted / (counted + TESTED_HALF))[:, None]
    return np.asarray(held @ words.T)

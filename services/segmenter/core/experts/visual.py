"""The visual expert: how much a place looks like each region."""

import numpy as np

from prior_sg.services.segmenter.core.experts.context import Context


def visual(context: Context) -> tuple[np.ndarray, np.ndarray]:
    """Softmax with a null class over standardised cosine similarities (paper, The Visual Expert).

    The scores are temperature times similarity plus the map's bias of each label; the null class has no bias.
    Confidence is the mass that the null class leaves, and 0 for a place that no frame has observed.
    """
    text = context.text
    scores = text.temperature * context.similarity + context.bias
    null = np.full(len(scores), text.temperature * text.null_score)
    scores = np.column_stack((scores, null))
    log_mass = scores - _log_sum_exp(scores)
    log_confidence = _log_sum_exp(log_mass[:, :-1])
    confidence = np.where(context.frames > 0, np.exp(log_confidence[:, 0]), 0.0)
    return log_mass[:, :-1] - log_confidence, confidence


def _log_sum_exp(scores: np.ndarray) -> np.ndarray:
    highest = scores.max(axis=1, keepdims=True)
    return highest + np.log(np.exp(scores - highest).sum(axis=1, keepdims=True))

"""What experts may look at."""

from dataclasses import dataclass

import numpy as np

from schemas.features import TextEmbeddings
from schemas.priors import Prior


@dataclass(frozen=True)
class Context:
    """Observations of some places beside the prior they are aligned with."""

    prior: Prior
    text: TextEmbeddings  # one concept per region of the prior
    similarity: np.ndarray  # (place, label) standardised, from `standardised`; any number where never observed
    frames: np.ndarray  # (place,) keyframes that observed the place
    bias: np.ndarray  # (label,) added to the visual scores, see services.segmenter.balance


def standardised(descriptors: np.ndarray, text: TextEmbeddings) -> np.ndarray:
    """Cosine similarities (place, concept) in spreads from the mean over the space's background set.

    z = (s - mean) / std removes each concept's bias in this space; the text's `temperature` and `null_score` refer to
    z. `descriptors` (place, dim) have unit length.
    """
    similarity = descriptors @ text.embeddings.astype(np.float64).T
    return (similarity - text.background_mean) / text.background_std

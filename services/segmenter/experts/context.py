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
    descriptors: np.ndarray  # (place, dim) d_vis, unit length; zero where never observed
    frames: np.ndarray  # (place,) keyframes that observed the place

"""The experts of the product (paper, Unary Potentials): each is one module and one line of REGISTRY.

An expert looks at a context and returns `log_probabilities` (place, label), normalised over the labels, and
`confidence` (place,) in [0, 1]: 0 where it has nothing to say.
"""

from collections.abc import Callable

import numpy as np

from services.segmenter.experts.context import Context
from services.segmenter.experts.environment import environment
from services.segmenter.experts.geometric import geometric
from services.segmenter.experts.object import objects
from services.segmenter.experts.visual import visual

Vote = tuple[np.ndarray, np.ndarray]
Expert = Callable[[Context], Vote]

REGISTRY: dict[str, Expert] = {
    "visual": visual,
    "geometric": geometric,
    "object": objects,
    "environment": environment,
}

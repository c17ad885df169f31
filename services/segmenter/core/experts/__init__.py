"""The experts of the product (paper, Unary Potentials): each is one module and one line of REGISTRY.

An expert looks at a context and returns `log_probabilities` (place, label), normalised over the labels, and
`confidence` (place,) in [0, 1]: 0 where it has nothing to say.
"""

from collections.abc import Callable

import numpy as np

from prior_sg.services.segmenter.core.experts.contents import contents
from prior_sg.services.segmenter.core.experts.context import Context
from prior_sg.services.segmenter.core.experts.environment import environment
from prior_sg.services.segmenter.core.experts.geometric import geometric
from prior_sg.services.segmenter.core.experts.object import objects
from prior_sg.services.segmenter.core.experts.visual import visual

Vote = tuple[np.ndarray, np.ndarray]
Expert = Callable[[Context], Vote]

REGISTRY: dict[str, Expert] = {
    "visual": visual,
    "geometric": geometric,
    "object": objects,
    "environment": environment,
    "contents": contents,
}

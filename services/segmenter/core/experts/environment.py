"""The environment expert: how common each region is in such an environment."""

import numpy as np

from prior_sg.services.segmenter.core.experts.context import Context


def environment(context: Context) -> tuple[np.ndarray, np.ndarray]:
    """P_env(r | p) = P(r | E0) with confidence 1 (paper, The Environment Prior Expert)."""
    existence = np.array([region.existence for region in context.prior.regions])
    count = len(context.frames)
    return np.tile(np.log(existence / existence.sum()), (count, 1)), np.ones(count)

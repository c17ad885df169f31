"""What places look like each for itself, told apart from crops that show several (beyond the paper; pure).

A crop shows surfaces of several places, and its embedding is about the mean of what each looks like. The kernel spreads
that mean over all of them, as an unfiltered back-projection does in tomography: borders blur and what is seen through a
door takes the colour of the wall beside it. Crops from many views determine the parts: similarities of the places are
sought whose means, crop by crop, are the similarities of the crops (simultaneous iterative reconstruction after
Gilbert, 1972). A few rounds from the shared evidence, each smoothed along the place graph, keep what the crops do not
determine.

Reconstruction sharpens errors as it sharpens looks, so it counts by what the looks are worth, see `information`.
"""

import msgspec
import numpy as np
import scipy

from prior_sg.services.segmenter.core.appearance import smoothing
from prior_sg.services.segmenter.core.appearance.smoothing import SharingConfig
from prior_sg.services.segmenter.core.map.arcs import Arcs
from prior_sg.services.segmenter.core.slices import Parts

ROUND_VISITS = 6  # what a round takes for a place, as `slices` counts
LEAST_SHOWN = 0.3  # share of a crop that must show places


class UnmixingConfig(msgspec.Struct, frozen=True, kw_only=True):
    """How far crops are told apart into places."""

    rounds: int = 10  # 0 = the kernel's means as they are (paper)
    steps: int = 4  # along the graph over which each round is smoothed
    mass: float = 5.0  # crops' worth of a place above which it counts no more in the smoothing
    ridge: float = 1.0  # crops' worth that each place is taken to have been seen as it is

    def __post_init__(self) -> None:
        if not (self.rounds >= 0 and self.steps >= 0 and self.mass > 0 and self.ridge > 0):
            raise ValueError("rounds, steps, mass or ridge is out of range")


def unmixed(
    similarity: np.ndarray, looks: np.ndarray, shares: "scipy.sparse.csr_matrix", ties: Arcs, cfg: UnmixingConfig
) -> Parts[np.ndarray]:
    """Similarities (place, label) that explain those of the crops, `looks` (crop, label), starting from `similarity`.

    `shares` (crop, place) as of `Shown`; `ties` are the place graph.
    """
    covered = np.asarray(shares.sum(axis=1)).reshape(-1)
    kept = np.flatnonzero(covered > LEAST_SHOWN)
    shares, looks, covered = shares[kept], looks[kept], covered[kept, None]
    back = shares.T.tocsr()
    seen = np.asarray(back.sum(axis=1)).reshape(-1)
    masses, everywhere = np.minimum(seen, cfg.mass), np.arange(len(seen))
    smooth = SharingConfig(steps=cfg.steps, gain=1.0)
    found = similarity
    for _ in range(cfg.rounds):
        yield ROUND_VISITS * len(found)
        missing = looks - shares @ found / covered
        correction = back @ missing / (seen + cfg.ridge)[:, None]
        found = found + smoothing.shared(correction, masses, ties, rows=everywhere, cfg=smooth)
    return found

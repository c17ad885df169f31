"""How much the looks of a map tell of its labels, and what they are worth (beyond the paper; pure).

What corrects a weak encoder spoils a good one: where crops say by themselves which region they show, the map as a whole
knows nothing better (`label_bias`, `adaptation`), but crops can be told apart into places (`unmixing`); where they
hardly say it, the other way round. How much they say needs no truth: it is the information that a crop's belief over
the labels gives beyond that of all crops, as a share of all there is to know.
"""

import msgspec
import numpy as np

FEW_CROPS = 20  # crops at which half of what each tells counts as told of the map


class InformationConfig(msgspec.Struct, frozen=True, kw_only=True):
    """From where on looks are believed as they are. Chosen on development worlds and sequences."""

    least: float = 0.15  # below which looks are worth nothing: the map corrects them in full
    full: float = 0.4  # from which they are worth all: nothing but their mixture in crops is corrected

    def __post_init__(self) -> None:
        if not 0 <= self.least < self.full:
            raise ValueError("least must be below full")


def told(scores: np.ndarray) -> float:
    """What a crop tells of the labels on average, in [0, 1], from `scores` (crop, label) before the softmax.

    It is the mutual information of crop and label over the logarithm of the labels: an encoder that sees one label
    everywhere tells nothing. Few crops may well show one region only; they count by how sure each is.
    """
    count, labels = scores.shape
    if not count or labels < 2:
        return 0.0
    beliefs = np.exp(scores - scores.max(axis=1, keepdims=True))
    beliefs /= beliefs.sum(axis=1, keepdims=True)
    doubt = _entropy(beliefs).mean() / np.log(labels)
    known = _entropy(beliefs.mean(axis=0)) / np.log(labels)
    few = FEW_CROPS / (count + FEW_CROPS)
    return float((1 - few) * known + few - doubt)


def worth(told_share: float, cfg: InformationConfig) -> float:
    """What looks are worth, in [0, 1], when crops tell so much."""
    return float(np.clip((told_share - cfg.least) / (cfg.full - cfg.least), 0.0, 1.0))


def _entropy(beliefs: np.ndarray) -> np.ndarray:
    return -(beliefs * np.log(np.maximum(beliefs, np.finfo(float).tiny))).sum(axis=-1)

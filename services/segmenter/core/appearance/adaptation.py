"""What the regions of this very map look like (beyond the paper; pure).

Text says what kitchens look like in general; the places that look most like a kitchen say what this kitchen looks like.
So each label gets a direction in the embedding space, from the map's mean to that of the places that resemble the label
most, and a place's similarity is the text's plus its own along that direction, both scaled alike. That is done a few
times, with the labels that follow from it: self-training of a nearest-mean classifier.

It is a function of the evidence and the text, not of the labels in force: a restarted segmenter finds the same. While
news comes, one that would change less than `tolerance` is left as it is; when the map rests, it is found anew.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import msgspec
import numpy as np

from prior_sg.services.segmenter.core.slices import Parts

SAMPLE = 4096  # places that stand for all when directions are computed
TINY = 1e-9


class AdaptationConfig(msgspec.Struct, frozen=True, kw_only=True):
    """How far regions are recognised by what they look like in this map. Chosen on the development sequences."""

    weight: float = 1.0  # of the map's own directions against the text; 0 = the text alone (paper)
    rounds: int = 3  # of labels and directions
    half_places: float = 20.0  # observed places at which half of that weight is in force: a first room is no sample
    patience: float = 0.2  # share of the map to be seen anew before directions are computed again, unless it rests
    tolerance: float = 0.05  # mean change of similarities, in their spreads, that is not worth comparing all again

    def __post_init__(self) -> None:
        if not (self.weight >= 0 and self.rounds >= 1 and self.half_places >= 0):
            raise ValueError("weight, rounds or half_places is out of range")


@dataclass(frozen=True)
class Adaptation:
    """What to add to the similarities with the text."""

    center: np.ndarray = field(default_factory=lambda: np.zeros(0))  # (dim,) mean descriptor of the map
    directions: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))  # (label, dim)

    def similarity(self, descriptors: np.ndarray) -> np.ndarray | float:
        """To be added for descriptors (place, dim): (place, label), or 0 before the map was looked at."""
        return (descriptors - self.center) @ self.directions.T if len(self.directions) else 0.0


def adapted(
    descriptors: np.ndarray,
    similarity: np.ndarray,
    masses: np.ndarray,
    labels_of: Callable[[np.ndarray], np.ndarray],
    cfg: AdaptationConfig,
    *,
    visits: int,
) -> Parts[Adaptation]:
    """The adaptation to a map, from places that were observed, round by round.

    `descriptors` (place, dim) have unit length, `similarity` (place, label) is that with the text, `masses` (place,)
    weigh places, and `labels_of` gives the label (place,) that similarities speak for, in about so many
    `visits`. A label that no place resembles most gets no direction.
    """
    count, labels = similarity.shape
    scale = cfg.weight * count / (count + cfg.half_places) * _spread(similarity, masses)
    center = (masses @ descriptors / masses.sum()).astype(descriptors.dtype)
    offsets = descriptors - center
    some = slice(None, None, max(count // SAMPLE, 1))
    weights = (masses[some] / masses[some].sum()).astype(offsets.dtype)
    directions = np.zeros((labels, len(center)), offsets.dtype)
    for _ in range(cfg.rounds):
        yield visits
        best = labels_of(similarity + offsets @ directions.T)
        members = weights[:, None] * (best[some, None] == np.arange(labels))
        means = members.T @ offsets[some] / np.maximum(members.sum(axis=0), TINY)[:, None]
        spreads = np.sqrt(weights @ (offsets[some] @ means.T) ** 2)
        directions = (scale * means / np.maximum(spreads, TINY)[:, None]).astype(offsets.dtype)
    return Adaptation(center, directions)


def differs(
    now: Adaptation, before: Adaptation, descriptors: np.ndarray, similarity: np.ndarray, tolerance: float
) -> bool:
    """Whether one adaptation instead of another changes the places' similarities by more than the tolerance."""
    change = np.abs(now.similarity(descriptors) - before.similarity(descriptors))
    return bool(np.mean(change) > tolerance * np.sqrt(np.mean(np.var(similarity, axis=1))))


def _spread(similarity: np.ndarray, masses: np.ndarray) -> float:
    """Root of the mean variance over the labels of a place."""
    return float(np.sqrt(np.average(np.var(similarity, axis=1), weights=masses)))

"""What experts may look at."""

from dataclasses import dataclass, field

import msgspec
import numpy as np

from prior_sg.schemas.features import TextEmbeddings
from prior_sg.schemas.priors import Prior


@dataclass(frozen=True)
class ObjectView:
    """The objects of the map, each as a belief over the prior's objects."""

    ids: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))  # (object,) that last
    positions_m: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))  # (object, 3) world
    concepts: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))  # (object, concept) P(c | o), rows sum to 1
    weights: np.ndarray | None = None  # (object,) of its word, in [0, 1]; None = 1 each
    sought: np.ndarray | None = None  # (object,) how far it was found by looking for the prior's objects; None = 1 each

    @property
    def words(self) -> np.ndarray:
        """Weight (object,) of each object's word."""
        return np.ones(len(self.ids)) if self.weights is None else self.weights

    @property
    def answers(self) -> np.ndarray:
        """Weight (object,) of each object's word as an answer to whether the map holds what the prior names."""
        return self.words if self.sought is None else self.words * self.sought

    def changed_m(self, before: "ObjectView") -> np.ndarray:
        """Where objects (n, 3) are new, gone or different against `before`; of moved ones both positions."""
        _, here, there = np.intersect1d(self.ids, before.ids, assume_unique=True, return_indices=True)
        same_columns = self.concepts.shape[1] == before.concepts.shape[1]
        same = (self.positions_m[here] == before.positions_m[there]).all(axis=1) & same_columns
        same &= self.words[here] == before.words[there]
        if same_columns:
            same &= (self.concepts[here] == before.concepts[there]).all(axis=1)
        kept, was = np.zeros(len(self.ids), dtype=bool), np.zeros(len(before.ids), dtype=bool)
        kept[here[same]], was[there[same]] = True, True
        return np.concatenate((self.positions_m[~kept], before.positions_m[~was]))


class ObjectSettings(msgspec.Struct, frozen=True, kw_only=True):
    """How far an object speaks for the places around it; the paper leaves these values open."""

    decay_m: float = 1.0  # gamma_obj: distance at which its word counts 1 / e
    reach_m: float = 3.0  # d_max: distance beyond which it counts nothing

    def __post_init__(self) -> None:
        if not (self.decay_m > 0 and self.reach_m > 0):
            raise ValueError("decay_m and reach_m must be positive")


@dataclass(frozen=True)
class Context:
    """Observations of some places beside the prior they are aligned with."""

    prior: Prior
    text: TextEmbeddings  # one concept per region of the prior
    similarity: np.ndarray  # (place, label) standardised, from `standardised`; any number where never observed
    frames: np.ndarray  # (place,) keyframes that observed the place
    bias: np.ndarray  # (label,) added to the visual scores, see prior_sg.services.segmenter.core.appearance.label_bias
    positions_m: np.ndarray  # (place, 3) world
    radii_m: np.ndarray  # (place,) distance to the nearest obstacle
    inclination_rad: (
        np.ndarray
    )  # (place,) of the local surface against the horizontal, see prior_sg.services.segmenter.core.map.inclination
    support: np.ndarray  # (place,) in [0, 1): how many places form that surface
    anisotropy: np.ndarray  # (place,) in [0, 1]: how flat or straight it is
    objects: ObjectView = field(default_factory=ObjectView)  # of the whole map
    contents: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))  # (place, label), see experts/contents.py
    object_settings: ObjectSettings = field(default_factory=ObjectSettings)


def standardised(descriptors: np.ndarray, text: TextEmbeddings) -> np.ndarray:
    """Cosine similarities (place, concept) in spreads from the mean over the space's background set.

    z = (s - mean) / std removes each concept's bias in this space; the text's `temperature` and `null_score` refer to
    z. `descriptors` (place, dim) have unit length.
    """
    similarity = descriptors @ text.embeddings.astype(np.float64).T
    return (similarity - text.background_mean) / text.background_std

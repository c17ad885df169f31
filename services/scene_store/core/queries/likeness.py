"""How probably what carries a label answers a text, by embeddings of the text and of what the prior says (pure).

Two witnesses speak for a region's label, and each gets half of the say. One compares the text with the label's own
phrases and takes the most similar. The other asks which of the prior's objects the text is about, and where the prior
expects those: "put the milk back into the fridge" names no room, but a refrigerator, which stands in kitchens. Labels
share one probability, as of the labels one fits best.

Chosen on the questions with odd numbers in deploy/evaluation/search_questions.py; spreads from 0.03 to 0.1
with a share of the say from 0.3 to 0.7 differ there by at most two questions of twenty, and with 0.5 by one.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from prior_sg.schemas.answers import Words
from prior_sg.schemas.priors import Prior

SPREAD = 0.05  # by so much cosine similarity less, a label or object is e times less probable
OBJECTS_SAY = 0.5  # of the objects that the text is about, in what is believed of a region's label


@dataclass(frozen=True)
class Vocabulary:
    """What labels mean: phrases of regions, names of objects, and where the prior expects each object."""

    regions: dict[str, tuple[str, ...]]
    objects: tuple[str, ...]
    expected: np.ndarray | None  # (object, region) P(region | object), rows sum to one; None = no prior says

    @property
    def phrases(self) -> list[str]:
        """All that has to be embedded, each once."""
        return list(dict.fromkeys((*(one for said in self.regions.values() for one in said), *self.objects)))


def vocabulary(words: Words, prior: Prior | None = None) -> Vocabulary:
    """The prior's, where it is at hand and its regions are the scene's labels; else those labels by themselves."""
    if prior is None or [region.name for region in prior.regions] != words.labels:
        return Vocabulary({label: (label,) for label in words.labels}, tuple(words.objects), None)
    containment = np.maximum(prior.containment.astype(np.float64).T, 1e-9)
    return Vocabulary(
        {region.name: (region.name, *region.phrases) for region in prior.regions},
        tuple(item.name for item in prior.objects),
        containment / containment.sum(axis=1, keepdims=True),
    )


def likeness(
    text: np.ndarray, embedded: Mapping[str, np.ndarray], meant: Vocabulary
) -> tuple[dict[str, float], dict[str, float]]:
    """Probabilities by label of regions, and by label of objects, from unit vectors (dim,) of the text and of every
    phrase."""
    if not meant.regions:
        return {}, {}
    alike = {phrase: float(text @ embedded[phrase]) for phrase in meant.phrases}
    regions = _shares(np.array([max(alike[phrase] for phrase in said) for said in meant.regions.values()]))
    objects = _shares(np.array([alike[name] for name in meant.objects]))
    if meant.objects and meant.expected is not None:
        regions = (1.0 - OBJECTS_SAY) * regions + OBJECTS_SAY * objects @ meant.expected
    return (
        dict(zip(meant.regions, np.minimum(regions, 1.0).tolist(), strict=True)),
        dict(zip(meant.objects, objects.tolist(), strict=True)),
    )


def _shares(similarities: np.ndarray) -> np.ndarray:
    """Probabilities (label,) that sum to one."""
    odds = np.exp((similarities - similarities.max(initial=-1.0)) / SPREAD)
    return odds / max(odds.sum(), 1e-12)

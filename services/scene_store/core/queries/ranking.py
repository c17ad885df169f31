"""What answers a text: regions, places and objects on one scale (pure).

A thing that carries a label for sure answers the text as probably as its label does; of one whose label is uncertain it
is the mean over what it may be. Beliefs and likenesses are too cautious to be multiplied as they are, so the product is
read through a monotone curve, which makes it the share of things that were right where it was fitted: every thing
listed for the questions with odd numbers in deploy/evaluation/search_questions.py. At 0.5 a thing is as likely right as
not.
"""

import heapq
import re
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from prior_sg.schemas.answers import Ranking, What
from prior_sg.schemas.names import same
from prior_sg.schemas.queries import AnswersTo
from prior_sg.services.scene_store.core.queries.index import Index
from prior_sg.services.scene_store.core.queries.labels import nothing_called
from prior_sg.services.scene_store.core.queries.things import thing

LETTERS = re.compile(r"\w+")
STOP_WORDS = {"a", "an", "and", "are", "at", "be", "can", "for", "i", "in", "is", "it", "my", "of", "on", "or", "some"}
STOP_WORDS |= {"somewhere", "the", "there", "to", "we", "where", "with"}
SAME_WORD = 0.9  # likeness of a label whose words are all in the text
NOTE = "labels were compared with the text word by word, for no embedding of the text was given"
ORDER: tuple[What, ...] = ("region", "place", "object")  # of equal scores
SLOPE, MIDDLE = 2.5, 0.3  # log odds of a score grow so fast with the logarithm of the product, from 0 at the middle
HELD = 0.8  # of an object's score for the region that holds it


class Scored(NamedTuple):
    """A row with its product of belief and likeness."""

    what: What
    row: int
    score: float


def ranking(index: Index, question: AnswersTo) -> Ranking:
    """The best first; of places, the best of each region."""
    regions, objects, note = question.regions, question.objects, ""
    if not regions and not objects:
        regions = by_words(question.text, index.scene.labels)
        objects = by_words(question.text, index.labels("object"))
        note = NOTE
    found = [one for one in _scored(index, regions, objects) if question.what in (None, one.what) and one.score > 0]
    best = heapq.nsmallest(question.limit, found, key=lambda one: (-one.score, ORDER.index(one.what), one.row))
    reason = "" if best else _no_answer(index, question)
    listed = [thing(index, one.what, one.row, score=calibrated(one.score)) for one in best]
    return Ranking(things=listed, note=note, reason=reason, total=len(found))


def _no_answer(index: Index, question: AnswersTo) -> str:
    """Why nothing answers, in one sentence."""
    unnamed = not index.scene.regions and not index.labels("object")
    unknown = nothing_called(index, question.what, question.text) if unnamed else None
    return unknown.reason if unknown else f"nothing in the scene answers {question.text!r}"


def calibrated(product: float) -> float:
    """Probability that a thing is right, of a product above 0."""
    return 1.0 / (1.0 + (MIDDLE / product) ** SLOPE)


def _scored(index: Index, regions: dict[str, float], objects: dict[str, float]) -> Iterator[Scored]:
    """Every region, the best place of each, and every object."""
    of_places, of_objects = place_scores(index, regions), object_scores(index, objects)
    for row, score in enumerate(region_scores(index, of_places, of_objects).tolist()):
        yield Scored("region", row, score)
        if len(members := index.members(row)):
            best = int(members[of_places[members].argmax()])
            yield Scored("place", best, float(of_places[best]))
    for row, score in enumerate(of_objects.tolist()):
        yield Scored("object", row, score)


def place_scores(index: Index, regions: dict[str, float]) -> np.ndarray:
    """Of each place (place,): the mean over what it may be; what is unknown answers nothing."""
    return index.beliefs @ np.array([regions.get(label, 0.0) for label in index.scene.labels], np.float32)


def object_scores(index: Index, objects: dict[str, float]) -> np.ndarray:
    """Of each object (object,)."""
    scores = np.zeros(len(index.objects))
    for label, score in objects.items():
        rows = index.labelled("object", label)
        scores[rows] = score * index.object_beliefs[rows]
    return scores


def region_scores(index: Index, of_places: np.ndarray, of_objects: np.ndarray) -> np.ndarray:
    """Of each region (region,): it answers by what it is, or by the best of what it holds."""
    own = index.means_of_regions(of_places)
    held = np.zeros(len(own))
    rows = np.flatnonzero(index.object_regions >= 0)
    np.maximum.at(held, index.object_regions[rows], of_objects[rows])
    return 1.0 - (1.0 - own) * (1.0 - HELD * held)


def by_words(text: str, labels: list[str]) -> dict[str, float]:
    """Score by label: the share of its words that are in the text, to a stem; labels that share none are left out."""
    said = _stems(text)
    shares = {label: len(_stems(label) & said) / len(_stems(label)) for label in labels if _stems(label)}
    return {label: SAME_WORD * share for label, share in shares.items() if share}


def _stems(text: str) -> set[str]:
    words = LETTERS.findall(same(text))
    return {word.removesuffix("s") for word in words if word not in STOP_WORDS}

"""Whether what a text search finds answers the text: hits, ranks, and whether its scores are probabilities.

A simulated encoder has no sentences: there the map is made by it, and texts are embedded in the default space.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from prior_sg.deploy.api.scene import Scene as Api
from prior_sg.deploy.evaluation.kinds import OURS, SIMULATED
from prior_sg.deploy.evaluation.search_questions import TextQuestion
from prior_sg.deploy.truth import GroundTruth, TrueObject
from prior_sg.schemas.answers import Thing
from prior_sg.schemas.features import DEFAULT_SPACE
from prior_sg.schemas.priors import Prior
from prior_sg.schemas.scene import Scene

PLAIN = "plain"
DEPTH = 5  # of hit@5
LISTED = 14  # things of each answer that are judged
PLACE_REACH_M, OBJECT_REACH_M = 1.5, 0.5  # as near to a true object's box is at it
BINS = 10


@dataclass(frozen=True)
class Judge:
    """The truth about one scene."""

    scene: Scene
    truth: GroundTruth
    objects: tuple[TrueObject, ...] = ()

    def right(self, thing: Thing, question: TextQuestion) -> bool:
        """Whether a thing answers a question.

        It does when it lies in a true region that answers, a region with most of its places; or when a true object that
        answers is near: to an object's middle within 0.5 m, to a place within 1.5 m; a region has to hold its nearest
        place.
        """
        return self._label_at(thing) in question.regions or any(
            item.label in question.objects and self._at(thing, item) for item in self.objects
        )

    def answered(self, question: TextQuestion) -> bool:
        """Whether the scene has places that answer a question, so that it can be found at all."""
        return bool(np.isin(self._true_labels(), question.regions).any()) or bool(
            {item.label for item in self.objects} & set(question.objects)
        )

    def _true_labels(self) -> np.ndarray:
        """Of each place (place,), the label of its true region."""
        return self._labels_at(self.scene.positions_m)

    def _labels_at(self, points_m: np.ndarray) -> np.ndarray:
        names = {region.id: region.label for region in self.truth.regions}
        return np.array([names.get(number, "") for number in self.truth.region_of(points_m).tolist()], np.str_)

    def _label_at(self, thing: Thing) -> str:
        if thing.what != "region":
            return str(self._labels_at(np.array([thing.position_m]))[0])
        labels, counts = np.unique(self._true_labels()[self.scene.place_regions == thing.id], return_counts=True)
        return str(labels[counts.argmax()]) if len(labels) else ""

    def _at(self, thing: Thing, item: TrueObject) -> bool:
        if thing.what == "region":
            row = gaps_m(self.scene.positions_m, item).argmin()
            return int(self.scene.place_regions[row]) == thing.id
        reach_m = PLACE_REACH_M if thing.what == "place" else OBJECT_REACH_M
        return bool(gaps_m(np.array([thing.position_m]), item)[0] <= reach_m)


def simulates(space: str) -> bool:
    """Whether an embedding space is that of a simulated encoder."""
    return space.partition("/")[0] in SIMULATED


def gaps_m(points_m: np.ndarray, item: TrueObject) -> np.ndarray:
    """From points (n, 3) to an object's box (n,), 0 inside."""
    return np.linalg.norm(np.maximum(np.maximum(item.min_m - points_m, points_m - item.max_m), 0.0), axis=1)


@dataclass(frozen=True)
class Found:
    """What a search said to one question: of each thing, its score and whether it is right."""

    question: TextQuestion
    scores: tuple[float, ...]
    right: tuple[bool, ...]

    @property
    def rank(self) -> int:
        """Of the first right thing, from 1; 0 = none is."""
        return self.right.index(True) + 1 if any(self.right) else 0


def found(question: TextQuestion, things: Sequence[Thing], judge: Judge) -> Found:
    """One ranking, judged."""
    scores = tuple(float(thing.score or 0.0) for thing in things)
    return Found(question, scores, tuple(judge.right(thing, question) for thing in things))


def figures(results: Sequence[Found]) -> dict[str, float]:
    """hit@1, hit@5 and MRR over the questions that have an answer; mean of the best score where there is none; and the
    expected calibration error of all scores."""
    asked = [one for one in results if one.question.regions or one.question.objects]
    hopeless = [one for one in results if one not in asked]
    ranks = np.array([one.rank for one in asked], np.float64)
    scores = np.array([score for one in results for score in one.scores])
    right = np.array([hit for one in results for hit in one.right], np.float64)
    return {
        "questions": len(asked),
        "hit_1": float((ranks == 1).mean()),
        "hit_5": float(((ranks >= 1) & (ranks <= DEPTH)).mean()),
        "mrr": float(np.divide(1.0, ranks, out=np.zeros(len(ranks)), where=ranks > 0).mean()),
        "best_where_right": _mean([one.scores[0] for one in asked if one.rank == 1]),
        "best_where_wrong": _mean([one.scores[0] for one in asked if one.scores and one.rank != 1]),
        "best_without_answer": _mean([one.scores[0] for one in hopeless if one.scores]),
        "ece": calibration_error(scores, right),
    }


def judged(scene: Scene, prior: Prior, judge: Judge, questions: Sequence[TextQuestion]) -> dict[str, list[Found]]:
    """What our search and the plain one say to each question, by method."""
    asked = Api(msgspec.structs.replace(scene, space=DEFAULT_SPACE) if simulates(scene.space) else scene, prior)
    return {
        OURS: [found(one, asked.find(one.text, limit=LISTED), judge) for one in questions],
        PLAIN: [found(one, plain(asked, one.text), judge) for one in questions],
    }


def plain(scene: Api, text: str) -> list[Thing]:
    """The plain alternative: whatever carries a label scores the cosine of its name with the text; of equal ones, as
    many as `find` lists, regions come first, then a place of each, then objects."""
    regions, objects = scene.message.regions, [item for item in scene.message.objects if item.label]
    names = sorted({region.label for region in regions} | {item.label for item in objects})
    said, *vectors = scene.embed(scene.message.space, [text, *names])
    alike = {name: max(float(said @ vector), 0.0) for name, vector in zip(names, vectors, strict=True)}
    things = [scene.describe("region", region.id).thing for region in regions]
    firsts = [int(scene.message.place_ids[(scene.message.place_regions == region.id).argmax()]) for region in regions]
    things += [scene.describe("place", number).thing for number in firsts]
    things += [scene.describe("object", item.id).thing for item in objects]
    scored = [msgspec.structs.replace(one, score=alike[one.label]) for one in things if one is not None]
    return sorted(scored, key=lambda one: -(one.score or 0.0))[:LISTED]


def calibration_error(scores: np.ndarray, right: np.ndarray) -> float:
    """Mean over bins of scores, by their share, of the distance between mean score and share of right ones."""
    bins = np.minimum((scores * BINS).astype(int), BINS - 1)
    gaps = [abs(scores[bins == b].mean() - right[bins == b].mean()) * (bins == b).sum() for b in np.unique(bins)]
    return float(np.sum(gaps) / max(len(scores), 1))


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if values else float("nan")

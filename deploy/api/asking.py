"""What can be asked of a scene, the same of one in memory, of a saved one and of a running system."""

import warnings
from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np

from prior_sg.deploy.api.errors import NotInSceneError
from prior_sg.deploy.api.listed import Listed
from prior_sg.deploy.api.spots import FARTHEST_M, spot_in
from prior_sg.deploy.api.vectors import RecentVectors
from prior_sg.schemas.answers import (
    Answer,
    Details,
    MarkerInRegion,
    Neighbour,
    NodeWithRegions,
    Outlook,
    Point,
    RegionBeliefs,
    Route,
    Thing,
    What,
    listed_of,
)
from prior_sg.schemas.foresight import MissingLabel
from prior_sg.schemas.levels import LevelName
from prior_sg.schemas.markers import SceneMarker
from prior_sg.schemas.objects import SceneObject
from prior_sg.schemas.priors import Prior
from prior_sg.schemas.queries import (
    MOST_LISTED,
    MOST_RANKED,
    AnswersTo,
    BeliefsOf,
    ById,
    ByLabel,
    InBox,
    InRadius,
    MarkersOf,
    Nearest,
    NeighboursOf,
    NodesOf,
    ObjectsInRegions,
    Question,
    RouteBetween,
    Spot,
    WhatIsMissing,
    WhereToLook,
    WordsInUse,
)
from prior_sg.schemas.regions import Region
from prior_sg.services.errors import PriorSgError

NO_PRIOR = "the prior of this scene is not at hand, so labels were compared with the text by their names alone"
PointLike = Sequence[float] | np.ndarray[Any, Any]
SpotLike = str | Spot | Thing | Region | SceneObject | SceneMarker | PointLike


class Asking(ABC):
    """Questions as methods. What cannot be understood in this scene, such as a label that nothing carries, raises
    NotInSceneError, whose message names what is nearest; what has no answer, such as an empty box, gives an empty list.
    `label` narrows to what carries it, whatever its case; `what` is "place", "region" or "object". Of a list that
    `limit` or `k` cuts, `total` says how much there is.
    """

    @abstractmethod
    def ask(self, *questions: Question) -> list[Answer]:
        """Answers to questions of `prior_sg.schemas.queries`, in their order, over one revision. Raises ValueError
        where one holds what none may hold.
        """

    @abstractmethod
    def prior_of(self, digest: str) -> Prior | None:
        """The prior of a digest, where it is at hand."""

    @abstractmethod
    def embed(self, space: str, phrases: Sequence[str]) -> np.ndarray[Any, Any]:
        """Unit vectors (phrase, dim) of phrases in an embedding space. Raises PriorSgError when nothing here can."""

    def near(
        self, point_m: PointLike, k: int = 1, what: What = "object", label: str = "", radius_m: float | None = None
    ) -> Listed[Thing]:
        """The nearest `k` of a kind, the nearest first; with `radius_m`, none that is farther."""
        if radius_m is not None:
            return self.within(point_m, min(radius_m, FARTHEST_M), what, label, k)
        return self._listed(Nearest(point_m=_point(point_m), what=what, label=label, limit=k), k)

    def within(
        self,
        point_m: PointLike,
        radius_m: float,
        what: What | None = None,
        label: str = "",
        limit: int = MOST_LISTED,
    ) -> Listed[Thing]:
        """What is no farther than `radius_m`, the nearest first; without `what`, regions and objects."""
        point = _point(point_m)
        question = InRadius(point_m=point, radius_m=radius_m, what=what, label=label, limit=limit)
        return self._listed(question, limit)

    def in_box(
        self,
        min_m: PointLike,
        max_m: PointLike,
        what: What | None = None,
        label: str = "",
        limit: int = MOST_LISTED,
    ) -> Listed[Thing]:
        """What lies in an axis-aligned box; without `what`, regions and objects."""
        low, high = _point(min_m), _point(max_m)
        return self._listed(InBox(min_m=low, max_m=high, what=what, label=label, limit=limit), limit)

    def labelled(self, label: str, what: What | None = None, limit: int = MOST_LISTED) -> Listed[Thing]:
        """What carries a label, the most probable first; without `what`, regions and objects."""
        return self._listed(ByLabel(label=label, what=what, limit=limit), limit)

    def objects_in(self, region: str = "", label: str = "", limit: int = MOST_LISTED) -> Listed[Thing]:
        """Objects of a label that stand in regions of a label, the most probable first."""
        return self._listed(ObjectsInRegions(object_label=label, region_label=region, limit=limit), limit)

    def describe(self, what: What, number: int) -> Details:
        """Everything about one place, region or object."""
        details: Details = self._understood(ById(what=what, id=number))
        return details

    def neighbours(self, what: What, number: int) -> list[Neighbour]:
        """Where one can go from a place or a region, or which region holds an object."""
        neighbours: list[Neighbour] = self._understood(NeighboursOf(what=what, id=number)).neighbours
        return neighbours

    def route(self, start: SpotLike, goal: SpotLike, clearance_m: float = 0.0) -> Route:
        """The shortest way on which nothing is closer than `clearance_m`. Both ends are a point, a Thing, a Region, a
        SceneObject, a SceneMarker, a Spot, or text: a label, "here" (where the camera was last), "region:7",
        "marker:7", "1.0,2.0,0.5". `found` says whether there is one, and `reason` why not. Raises ValueError where an
        end is none of these.
        """
        route: Route
        (route,) = self.ask(RouteBetween(start=_spot(start), goal=_spot(goal), clearance_m=clearance_m))  # type: ignore[assignment]
        return route

    def levels(
        self,
        level: LevelName | None = None,
        label: str = "",
        *,
        number: int | None = None,
        region: int | None = None,
        limit: int = MOST_LISTED,
    ) -> Listed[NodeWithRegions]:
        """Zones, floors, buildings and districts with their regions, from below: of one level, of a label, of a number
        within its level, or those that hold a region."""
        question = NodesOf(level=level, label=label, id=number, region=region, limit=limit)
        return self._listed(question, limit)

    def markers(
        self, number: int | None = None, dictionary: str = "", limit: int = MOST_LISTED
    ) -> Listed[MarkerInRegion]:
        """Where printed markers are, each with the region that it hangs in, by dictionary and number: all, or those of
        a number. Of one with a `doubt` nothing may be concluded."""
        question = MarkersOf(id=number, dictionary=dictionary, limit=limit)
        return self._listed(question, limit)

    def where_to_look(
        self, label: str, start: SpotLike = "here", clearance_m: float = 0.0, limit: int = MOST_RANKED
    ) -> Outlook:
        """Where a region of a label that nobody has seen is likely found first: openings to unobserved space, the best
        to begin with first, and the way to the first. All of it is predicted.
        """
        question = WhereToLook(label=label, start=_spot(start), clearance_m=clearance_m, limit=limit)
        outlook: Outlook = self._understood(question)
        return outlook

    def missing(self, limit: int = MOST_RANKED) -> Listed[MissingLabel]:
        """Labels that are probably still to be found behind the map's openings, the most probable first."""
        return self._listed(WhatIsMissing(limit=limit), limit)

    def candidates(self, region: int, limit: int = MOST_RANKED) -> RegionBeliefs:
        """What a region may be: labels with their probabilities, what is unknown, and how much is a prediction."""
        beliefs: RegionBeliefs = self._understood(BeliefsOf(region=region, limit=limit))
        return beliefs

    def find(self, text: str, what: What | None = None, limit: int = MOST_RANKED) -> Listed[Thing]:
        """What answers a text such as "somewhere to sit and eat", the best first; at a score of 0.5 it is as likely
        right as not. Without `what`, regions, objects, and the best place of each region.

        Where no embedding of the text can be had, labels are compared with it word by word; where the scene's prior is
        not at hand, by their names alone. A warning says so, and why nothing answers.
        """
        regions, objects, missing = self.likeness(text)
        question = AnswersTo(text=text, regions=regions, objects=objects, what=what, limit=limit)
        ranking: Any
        (ranking,) = self.ask(question)
        if ranking.reason:
            warnings.warn(ranking.reason, stacklevel=2)
        if missing:
            warnings.warn(f"{ranking.note}: {missing}" if ranking.note else missing, stacklevel=2)
        return Listed[Any](*listed_of(ranking)).told(limit, callers=2)

    def likeness(self, text: str) -> tuple[dict[str, float], dict[str, float], str]:
        """How probably regions and objects of each label answer a text, by label, both empty where nothing embeds it;
        and in one sentence what is missing."""
        from prior_sg.services.scene_store.core.queries import likeness as core

        words: Any
        (words,) = self.ask(WordsInUse())
        if not words.space:
            return {}, {}, "nothing has been seen in an embedding space yet"
        try:
            prior = self.prior_of(words.prior_digest)
            meant = core.vocabulary(words, prior)
            embedded = self.vectors.of(words.space, [text, *meant.phrases], self.embed)
        except PriorSgError as error:
            return {}, {}, str(error)
        return *core.likeness(embedded[text], embedded, meant), "" if prior is not None else NO_PRIOR

    @cached_property
    def vectors(self) -> RecentVectors:
        """What was embedded for searches so far."""
        return RecentVectors()

    def _listed(self, question: Question, limit: int) -> Listed[Any]:
        found, total = listed_of(self._understood(question))
        return Listed(found, total).told(limit, callers=3)

    def _understood(self, question: Question) -> Any:
        answer: Any
        (answer,) = self.ask(question)
        if answer.reason:
            raise NotInSceneError(answer.reason)
        return answer


def _spot(value: SpotLike) -> Spot:
    match value:
        case Spot():
            return value
        case str():
            return spot_in(value)
        case Thing():
            return Spot(what=value.what, id=value.id)
        case Region():
            return Spot(what="region", id=value.id)
        case SceneObject():
            return Spot(what="object", id=value.id)
        case SceneMarker():
            return Spot(what="marker", id=value.id, dictionary=value.dictionary)
        case _:
            return Spot(point_m=_point(value))


def _point(value: PointLike) -> Point:
    x, y, z = (float(number) for number in value)
    return x, y, z

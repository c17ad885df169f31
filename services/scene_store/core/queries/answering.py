"""Each question to what answers it (pure)."""

from collections.abc import Callable

from prior_sg.schemas.answers import Answer, Difference
from prior_sg.schemas.queries import (
    AnswersTo,
    BeliefsOf,
    ById,
    ByLabel,
    ChangedSince,
    InBox,
    InRadius,
    MarkersOf,
    Nearest,
    NeighboursOf,
    NodesOf,
    ObjectsInRegions,
    Question,
    RouteBetween,
    SceneAnswer,
    SceneQuery,
    WhatIsMissing,
    WhereToLook,
    WordsInUse,
)
from prior_sg.schemas.scene import Scene
from prior_sg.services.scene_store.core.queries import (
    beliefs,
    changes,
    labels,
    levels,
    markers,
    ranking,
    routes,
    spatial,
    unseen,
)
from prior_sg.services.scene_store.core.queries.index import Index

Older = Callable[[int], Scene | None]  # the scene at a revision; None = it is not kept


def no_history(revision: int) -> Scene | None:
    """Where only one revision is at hand."""
    return None


def reply(index: Index, query: SceneQuery, older: Older = no_history) -> SceneAnswer:
    """All answers over one revision."""
    return SceneAnswer(
        robot=query.robot,
        revision=index.scene.revision,
        stamp_ns=index.scene.stamp_ns,
        answers=[answer(index, question, older) for question in query.questions],
    )


def answer(index: Index, question: Question, older: Older = no_history) -> Answer:
    """The answer to one question."""
    match question:
        case ById():
            return beliefs.details(index, question)
        case ByLabel():
            return labels.by_label(index, question)
        case InBox():
            return spatial.in_box(index, question)
        case InRadius():
            return spatial.in_radius(index, question)
        case Nearest():
            return spatial.nearest(index, question)
        case NeighboursOf():
            return beliefs.neighbourhood(index, question)
        case ObjectsInRegions():
            return labels.objects_in_regions(index, question)
        case RouteBetween():
            return routes.route(index, question)
        case ChangedSince():
            return _changed(index, question, older)
        case BeliefsOf():
            return beliefs.region_beliefs(index, question)
        case WordsInUse():
            return beliefs.words(index)
        case AnswersTo():
            return ranking.ranking(index, question)
        case NodesOf():
            return levels.nodes(index, question)
        case MarkersOf():
            return markers.markers(index, question)
        case WhereToLook():
            return unseen.outlook(index, question)
        case WhatIsMissing():
            return unseen.missing(index, question)


def _changed(index: Index, question: ChangedSince, older: Older) -> Difference:
    before = older(question.revision)
    if before is None:
        reason = f"revision {question.revision} is not kept; the scene is at revision {index.scene.revision}"
        return Difference(since_revision=question.revision, reason=reason)
    return changes.difference(Index(before), index)

"""Questions about a scene graph: one implementation answers them on the bus, over HTTP and in files. What answers hold
is declared in `schemas/answers.py`.

Several questions in one message are answered over one and the same revision, in their order. One that cannot be
understood in this scene, such as for a label that nothing carries, is answered all the same: its answer is empty, and
`reason` says why in one sentence. Positions are in the world, metres, z up.

How far something is: a place by its centre, a region by the nearest of its places, an object by its box (0 inside).
"""

from typing import Annotated

import msgspec

from prior_sg.schemas.answers import Answer, SpotKind, What
from prior_sg.schemas.codec import Message, NumberOrNone, Part, Stamp
from prior_sg.schemas.levels import LevelName
from prior_sg.schemas.names import LONGEST_TEXT

Coordinate = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]
AskedPoint = tuple[Coordinate, Coordinate, Coordinate]
Metres = Annotated[float, msgspec.Meta(ge=0.0, le=1e9)]
Text = Annotated[str, msgspec.Meta(max_length=LONGEST_TEXT)]
Probability = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]
MOST_LISTED, MOST_RANKED = 100, 10  # where nothing is said
MOST_ASKED = 100_000
Limit = Annotated[int, msgspec.Meta(ge=1, le=MOST_ASKED)]  # at most so many come back


class ById(Part, frozen=True, kw_only=True, tag="by_id"):
    """Everything about one place, region or object → Details."""

    what: What
    id: int


class ByLabel(Part, frozen=True, kw_only=True, tag="by_label"):
    """All that carries a label, whatever its case → Things, the most probable first. Without `what`, regions and
    objects."""

    label: Text
    what: What | None = None
    limit: Limit = MOST_LISTED


class InBox(Part, frozen=True, kw_only=True, tag="in_box"):
    """What lies in an axis-aligned box → Things, by id: places with their centre, objects with any part of theirs,
    regions with any place. Without `what`, regions and objects."""

    min_m: AskedPoint
    max_m: AskedPoint
    what: What | None = None
    label: Text = ""
    limit: Limit = MOST_LISTED


class InRadius(Part, frozen=True, kw_only=True, tag="in_radius"):
    """What is no farther from a point → Things, the nearest first. Without `what`, regions and objects."""

    point_m: AskedPoint
    radius_m: Metres
    what: What | None = None
    label: Text = ""
    limit: Limit = MOST_LISTED


class Nearest(Part, frozen=True, kw_only=True, tag="nearest"):
    """The nearest of a kind, of a label where one is given → Things, the nearest first."""

    point_m: AskedPoint
    what: What = "object"
    label: Text = ""
    limit: Limit = 1


class NeighboursOf(Part, frozen=True, kw_only=True, tag="neighbours_of"):
    """Where one can go from a region or a place, or what region holds an object → Neighbourhood."""

    what: What
    id: int


class ObjectsInRegions(Part, frozen=True, kw_only=True, tag="objects_in_regions"):
    """Objects of a label that stand in regions of a label → Things, the most probable first; an empty label = any."""

    object_label: Text = ""
    region_label: Text = ""
    limit: Limit = MOST_LISTED


class Spot(Part, frozen=True, kw_only=True):
    """An end of a route: a point; or `here`, where the camera was last; or a place, region, object or printed marker by
    its id; or whatever carries the label and is reached first, regions before objects where `what` is left out.

    A region stands for its place nearest to its middle, an object and a point for the place nearest to them; where that
    one leads nowhere, a place stands for a point that it has free space around, or for an object, up to 1 m farther. A
    marker is a point; of several dictionaries' with one number, where none is named, the one that is reached first
    counts, and one in doubt is no end.
    """

    point_m: AskedPoint | None = None
    what: SpotKind | None = None
    id: int | None = None
    dictionary: Text = ""  # of a marker
    label: Text = ""
    here: bool = False


class RouteBetween(Part, frozen=True, kw_only=True, tag="route_between"):
    """The shortest way over the place graph whose edges all have a least clearance → Route."""

    start: Spot
    goal: Spot
    clearance_m: Metres = 0.0


class ChangedSince(Part, frozen=True, kw_only=True, tag="changed_since"):
    """What is different from an older revision → Difference."""

    revision: int


class BeliefsOf(Part, frozen=True, kw_only=True, tag="beliefs_of"):
    """What a region may be → RegionBeliefs, the most probable labels first."""

    region: int
    limit: Limit = MOST_RANKED


class WordsInUse(Part, frozen=True, kw_only=True, tag="words_in_use"):
    """What the scene was made for and which labels are in it → Words."""


class AnswersTo(Part, frozen=True, kw_only=True, tag="answers_to"):
    """What answers a text such as "somewhere to sit and eat" → Ranking.

    `regions` and `objects` say, by label, how probably something with that label answers the text; whoever asks has
    found them out in an embedding space (`Client.find` does). With neither, words are compared, and the answer says so.
    """

    text: Text
    regions: dict[str, Probability] = {}
    objects: dict[str, Probability] = {}
    what: What | None = None  # without it, all of them; at most one place of each region
    limit: Limit = MOST_RANKED


class NodesOf(Part, frozen=True, kw_only=True, tag="nodes_of"):
    """Zones, floors, buildings and districts with their regions → Nodes, from below by id. Of one level, a label
    whatever its case, an id within its level, or those that hold a region; without any, all."""

    level: LevelName | None = None
    label: Text = ""
    id: int | None = None
    region: int | None = None
    limit: Limit = MOST_LISTED


class MarkersOf(Part, frozen=True, kw_only=True, tag="markers_of"):
    """Where printed markers are → Markers, by dictionary and number. Of one number, of one dictionary; without either,
    all."""

    id: int | None = None
    dictionary: Text = ""
    limit: Limit = MOST_LISTED


class WhereToLook(Part, frozen=True, kw_only=True, tag="where_to_look"):
    """Behind which opening a region of a label that nobody has seen is most likely found first → Outlook, the best
    to begin with first."""

    label: Text
    start: Spot = Spot(here=True)
    clearance_m: Metres = 0.0
    limit: Limit = MOST_RANKED


class WhatIsMissing(Part, frozen=True, kw_only=True, tag="what_is_missing"):
    """Which labels are probably still to be found behind the map's openings → Missing."""

    limit: Limit = MOST_RANKED


Question = (
    ById
    | ByLabel
    | InBox
    | InRadius
    | Nearest
    | NeighboursOf
    | ObjectsInRegions
    | RouteBetween
    | ChangedSince
    | BeliefsOf
    | WordsInUse
    | AnswersTo
    | NodesOf
    | MarkersOf
    | WhereToLook
    | WhatIsMissing
)


def checked(question: Question) -> Question:
    """A question as the bus would bring it, numbers of numpy as plain ones. Raises ValueError where it holds what none
    may hold."""
    plain = msgspec.to_builtins(question, enc_hook=lambda number: number.item())
    found: Question = msgspec.convert(plain, Question)
    return found


class SceneQuery(Message, frozen=True, kw_only=True):
    """Questions about one robot's scene."""

    robot: str
    questions: list[Question]


class SceneAnswer(Message, frozen=True, kw_only=True):
    """The answers, one for each question."""

    robot: str
    revision: NumberOrNone  # of the store, as in SceneRevision; -1 = nothing is stored yet
    stamp_ns: Stamp  # of the newest frame that the scene rests on
    answers: list[Answer]

"""Questions about a scene graph and their answers: one implementation answers them on the bus, over HTTP and in files.

Several questions in one message are answered over one and the same revision, in their order. One that cannot be
understood in this scene, such as for a label that nothing carries, is answered all the same: its answer is empty, and
`reason` says why in one sentence. Positions are in the world, metres, z up.

How far something is: a place by its centre, a region by the nearest of its places, an object by its box (0 inside).
"""

from typing import Annotated, Literal

import msgspec

from prior_sg.schemas.codec import Message, NumberOrNone, Part, Stamp
from prior_sg.schemas.foresight import MissingLabel, Opening
from prior_sg.schemas.levels import LevelName, LevelNode
from prior_sg.schemas.names import LONGEST_TEXT
from prior_sg.schemas.objects import SceneObject
from prior_sg.schemas.regions import NO_REGION, Region, Transition

What = Literal["place", "region", "object"]
Point = tuple[float, float, float]  # world, metres
Coordinate = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]
AskedPoint = tuple[Coordinate, Coordinate, Coordinate]
Metres = Annotated[float, msgspec.Meta(ge=0.0, le=1e9)]
Text = Annotated[str, msgspec.Meta(max_length=LONGEST_TEXT)]
Probability = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]
Limit = Annotated[int, msgspec.Meta(ge=1, le=100_000)]  # at most so many come back
MOST_LISTED, MOST_RANKED = 100, 10


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
    """An end of a route: a point; or `here`, where the camera was last; or a place, region or object by its id; or
    whatever carries the label and is reached first, regions before objects where `what` is left out.

    A region stands for its place nearest to its middle, an object and a point for the place nearest to them; where that
    one leads nowhere, a place stands for a point that it has free space around, or for an object, up to 1 m farther.
    """

    point_m: AskedPoint | None = None
    what: What | None = None
    id: int | None = None
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
    | WhereToLook
    | WhatIsMissing
)


def checked(question: Question) -> Question:
    """A question as the bus would bring it, numbers of numpy as plain ones. Raises ValueError where it holds what none
    may hold."""
    plain = msgspec.to_builtins(question, enc_hook=lambda number: number.item())
    found: Question = msgspec.convert(plain, Question)
    return found


class Thing(Part, frozen=True, kw_only=True):
    """A place, a region or an object, in short."""

    what: What
    id: int
    label: str  # of a place, that of its region; empty = none
    position_m: Point  # centre of the place, mean of the region's places, middle of the object's box
    probability: float  # that the label is right
    region: int = NO_REGION  # that it is in; of a region, its own id
    predicted: bool = False  # the label rests on the surroundings
    distance_m: float | None = None  # from the point that was asked about
    score: float | None = None  # probability that it answers the text that was asked about


class Things(Part, frozen=True, kw_only=True, tag="things"):
    """What was found; `total` may be more than what is listed."""

    things: list[Thing] = []
    total: int = 0
    nearest_labels: list[str] = []  # where nothing carries the label that was asked for: those spelled most alike
    reason: str = ""


class LabelBelief(Part, frozen=True, kw_only=True):
    """A label and how probable it is."""

    label: str
    probability: float


class PlaceDetails(Part, frozen=True, kw_only=True):
    """What is known about one place beside what Thing says."""

    radius_m: float  # to the nearest obstacle
    beliefs: list[LabelBelief]  # the most probable first; those of almost no probability left out
    unknown: float  # mass outside the prior's regions, or unobserved
    frontier_m2: float = 0.0  # area of its opening to unobserved space


class Details(Part, frozen=True, kw_only=True, tag="details"):
    """One thing, and one of the three others, as it is stored."""

    thing: Thing | None = None
    place: PlaceDetails | None = None
    region: Region | None = None
    object: SceneObject | None = None
    reason: str = ""


class Neighbour(Part, frozen=True, kw_only=True):
    """What lies on the other side of an edge, or of a border between regions."""

    thing: Thing
    clearance_m: float  # of the edge, or of the widest way across the border
    length_m: float = 0.0  # of the edge
    ways: list[Transition] = []  # across the border


class Neighbourhood(Part, frozen=True, kw_only=True, tag="neighbourhood"):
    """Neighbours by id."""

    neighbours: list[Neighbour] = []
    reason: str = ""


class Route(Part, frozen=True, kw_only=True, tag="route"):
    """A way through free space, or why there is none."""

    found: bool = False
    reason: str = ""
    start: Thing | None = None  # what it begins at; None = a point
    goal: Thing | None = None
    place_ids: list[int] = []
    waypoints_m: list[Point] = []  # centres of those places
    length_m: float = 0.0
    clearance_m: float = 0.0  # the smallest along it
    regions: list[Thing] = []  # that it passes, in order; one that it comes back to stands there again
    start_gap_m: float = 0.0  # from the start that was asked for to the first place: nobody has checked that it is free
    goal_gap_m: float = 0.0


class Renamed(Part, frozen=True, kw_only=True):
    """A region or object whose label is another one now."""

    thing: Thing
    former_label: str


class Difference(Part, frozen=True, kw_only=True, tag="difference"):
    """What is new, gone and renamed between two revisions, by id; `gone` as it was."""

    since_revision: int = -1
    appeared: list[Thing] = []
    gone: list[Thing] = []
    renamed: list[Renamed] = []
    places_appeared: int = 0
    places_gone: int = 0
    places_relabelled: int = 0  # that are in both, in regions of other labels
    task_before: str = ""  # where it is another one now
    reason: str = ""


class RegionBeliefs(Part, frozen=True, kw_only=True, tag="region_beliefs"):
    """The mean belief of a region's places."""

    thing: Thing | None = None
    beliefs: list[LabelBelief] = []
    unknown: float = 0.0
    predicted_share: float = 0.0  # of its places, whose labels rest on their surroundings
    places: int = 0
    reason: str = ""


class Words(Part, frozen=True, kw_only=True, tag="words"):
    """The vocabulary of a scene; labels with the number of regions or objects that carry them."""

    environment: str
    task: str
    space: str  # embedding space of the evidence, empty before the first
    prior_digest: str
    labels: list[str]  # that regions can have
    regions: dict[str, int]
    objects: dict[str, int]


class Ranking(Part, frozen=True, kw_only=True, tag="ranking"):
    """What answers a text, the best first; every thing has a score."""

    things: list[Thing] = []
    note: str = ""  # what stands in for the embedding space, where something does
    reason: str = ""


class NodeWithRegions(Part, frozen=True, kw_only=True):
    """A node of a level above regions, and all regions in it, by id."""

    node: LevelNode
    regions: list[Thing] = []


class Nodes(Part, frozen=True, kw_only=True, tag="nodes"):
    """What was found; `total` may be more than what is listed."""

    nodes: list[NodeWithRegions] = []
    total: int = 0
    reason: str = ""


class Prospect(Part, frozen=True, kw_only=True):
    """One opening as a place to look behind."""

    opening: Opening
    probability: float  # that such a region begins behind it, within REACH_M of schemas/foresight.py
    expected_m: float  # metres until one is found if this opening comes first; a score, as sure as the probabilities
    way_m: float  # to the opening


class Outlook(Part, frozen=True, kw_only=True, tag="outlook"):
    """Where a region may be that has not been seen: predictions."""

    label: str = ""
    prospects: list[Prospect] = []
    probability: float = 0.0  # that one is behind any opening
    route: Route | None = None  # to the first of them
    found: list[Thing] = []  # regions of the label that have been seen already
    reason: str = ""


class Missing(Part, frozen=True, kw_only=True, tag="missing"):
    """What is probably still to be found: predictions, the most probable first."""

    labels: list[MissingLabel] = []
    openings: int = 0  # that it may be behind
    reason: str = ""


Answer = (
    Things | Details | Neighbourhood | Route | Difference | RegionBeliefs | Words | Ranking | Nodes | Outlook | Missing
)


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

"""Answers to questions about a scene graph (`schemas/queries.py`). Positions are in the world, metres, z up."""

from collections.abc import Sequence
from typing import Literal

from prior_sg.schemas.codec import Part
from prior_sg.schemas.foresight import MissingLabel, Opening
from prior_sg.schemas.levels import LevelNode
from prior_sg.schemas.markers import SceneMarker
from prior_sg.schemas.objects import SceneObject
from prior_sg.schemas.regions import NO_REGION, Region, Transition

What = Literal["place", "region", "object"]
SpotKind = What | Literal["marker"]  # what an end of a route can be
Point = tuple[float, float, float]  # world, metres


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
    start: Thing | None = None  # what it begins at; None = a point or a marker
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
    total: int = 0  # labels that it may have; may be more than what is listed


class Words(Part, frozen=True, kw_only=True, tag="words"):
    """The vocabulary of a scene; labels with the number of regions or objects that carry them."""

    environment: str
    task: str
    space: str  # embedding space of the evidence, empty before the first
    prior_digest: str
    labels: list[str]  # that regions can have
    regions: dict[str, int]
    objects: dict[str, int]
    merged_of: list[str] = []  # as in Scene


class Ranking(Part, frozen=True, kw_only=True, tag="ranking"):
    """What answers a text, the best first; every thing has a score. `total` may be more than what is listed."""

    things: list[Thing] = []
    note: str = ""  # what stands in for the embedding space, where something does
    reason: str = ""
    total: int = 0


class NodeWithRegions(Part, frozen=True, kw_only=True):
    """A node of a level above regions, and all regions in it, by id."""

    node: LevelNode
    regions: list[Thing] = []


class Nodes(Part, frozen=True, kw_only=True, tag="nodes"):
    """What was found; `total` may be more than what is listed."""

    nodes: list[NodeWithRegions] = []
    total: int = 0
    reason: str = ""


class MarkerInRegion(Part, frozen=True, kw_only=True):
    """A printed marker, and the region that it hangs in: that of the nearest place."""

    marker: SceneMarker
    region: Thing | None = None  # None = the nearest place is in none


class Markers(Part, frozen=True, kw_only=True, tag="markers"):
    """What was found; `total` may be more than what is listed. Of one with a `doubt` nothing may be concluded."""

    markers: list[MarkerInRegion] = []
    total: int = 0
    reason: str = ""


class Prospect(Part, frozen=True, kw_only=True):
    """One opening as a place to look behind."""

    opening: Opening
    probability: float  # that such a region begins behind it, within REACH_M of schemas/foresight.py
    expected_m: float  # metres until one is found if this opening comes first; a score, as sure as the probabilities
    way_m: float  # to the opening
    toward: float = 0.0  # that the nearest such region is come to through it; 0 throughout = not told
    per_metre: float = 0.0  # what prospects come in order of: `toward`, or `probability`, over way_m and a look behind


class Outlook(Part, frozen=True, kw_only=True, tag="outlook"):
    """Where a region may be that has not been seen: predictions. `total` may be more than the prospects listed."""

    label: str = ""
    prospects: list[Prospect] = []
    probability: float = 0.0  # that one is behind any opening
    route: Route | None = None  # to the first of them
    found: list[Thing] = []  # regions of the label that have been seen already
    reason: str = ""
    total: int = 0
    look_m: float = 0.0  # what is walked behind an opening to see what is there


class Missing(Part, frozen=True, kw_only=True, tag="missing"):
    """What is probably still to be found: predictions, the most probable first. `total` may be more than is listed."""

    labels: list[MissingLabel] = []
    openings: int = 0  # that it may be behind
    reason: str = ""
    total: int = 0


Answer = (
    Things
    | Details
    | Neighbourhood
    | Route
    | Difference
    | RegionBeliefs
    | Words
    | Ranking
    | Nodes
    | Markers
    | Outlook
    | Missing
)


def listed_of(answer: Answer) -> tuple[Sequence[Part], int]:
    """What an answer lists, and how much there is; of one that lists nothing, nothing."""
    listed: Sequence[Part]
    match answer:
        case Things() | Ranking():
            listed = answer.things
        case Nodes():
            listed = answer.nodes
        case Markers():
            listed = answer.markers
        case RegionBeliefs():
            listed = answer.beliefs
        case Outlook():
            listed = answer.prospects
        case Missing():
            listed = answer.labels
        case _:
            return [], 0
    return listed, max(len(listed), answer.total)  # stores of before told no total

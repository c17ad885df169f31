"""Regions and the label belief of each place, as deltas."""

from typing import Annotated, Literal

import msgspec
import numpy as np

from prior_sg.schemas.codec import Message, Number, NumberOrNone, Part, Shape, Stamp
from prior_sg.schemas.foresight import Foresight
from prior_sg.schemas.levels import LevelName, LevelNode
from prior_sg.schemas.members import MapMember

NO_REGION = -1  # in place of a region id: not labelled yet
_NO_IDS = msgspec.field(default_factory=lambda: np.zeros(0, np.int64))


class Transition(Part, frozen=True, kw_only=True):
    """One way from a region into another: edges of the place graph that cross the border side by side."""

    region: int  # on the other side
    edge: tuple[int, int]  # place ids of the widest of these edges, inside and outside
    position_m: tuple[float, float, float]  # middle of that edge, world
    clearance_m: float  # smallest obstacle distance along it: half the width of the way
    door: bool  # narrow, as doorways are


class Region(Part, frozen=True, kw_only=True):
    """One connected set of places with one label."""

    id: int
    label: str
    place_count: int
    probability: float  # mean posterior of the label over its places
    position_m: tuple[float, float, float]  # mean of its places
    area_m2: float  # footprint of its places' spheres, seen from above
    unknown: float = 0.0  # mean over its places
    predicted: bool = False  # more than half of its places are predicted, see RegionDelta.predicted_ids
    hull_m: list[tuple[float, float]] = []  # convex outline of that footprint, x and y, counter-clockwise
    neighbour_ids: list[int] = []  # regions that an edge of the place graph leads to
    transitions: list[Transition] = []  # the ways there
    object_ids: list[int] = []  # objects that stand in it
    parent: str = ""  # label of the zone that it is in, where there are zones
    members: list[MapMember] = []  # of a merged map: the robots' regions that it is made of


EventKind = Literal["appeared", "split", "merged", "relabelled", "removed"]


class RegionEvent(Part, frozen=True, kw_only=True):
    """What became of one region in one update."""

    kind: EventKind
    region: int
    label: str  # the former one of regions that are gone
    other: int = -1  # split: the region it was part of; merged: the region that took most of its places
    former_label: str = ""  # relabelled: what it was


class RegionDelta(Message, frozen=True, kw_only=True):
    """Change of regions and beliefs since the previous revision; with `snapshot`, all of them.

    Apply in this order: remove places, remove regions, upsert regions, upsert beliefs.
    """

    robot: str
    epoch: Number
    revision: NumberOrNone
    stamp_ns: Stamp
    prior_digest: str
    environment: str
    task: str
    space: str  # embedding space of the evidence, empty before the first
    snapshot: bool = False
    labels: list[str]  # the prior's regions; columns of `posteriors`
    regions: list[Region]
    removed_ids: Annotated[np.ndarray, Shape("int64", "removed")]
    place_ids: Annotated[np.ndarray, Shape("int64", "place")]
    place_regions: Annotated[np.ndarray, Shape("int64", "place")]  # region id of each place, NO_REGION = none yet
    posteriors: Annotated[np.ndarray, Shape("float16", "place", "label")]
    unknown: Annotated[np.ndarray, Shape("float16", "place")]  # mass outside the prior's regions, or unobserved
    removed_place_ids: Annotated[np.ndarray, Shape("int64", "removed_place")]
    energy: float
    predicted_ids: Annotated[np.ndarray, Shape("int64", "predicted")] = _NO_IDS  # those of `place_ids` whose label
    # rests on their surroundings: seen from afar, barely or never
    events: list[RegionEvent] = []  # since the previous revision
    removed_nodes: list[tuple[LevelName, int]] = []  # of the levels above, to be removed before `nodes` are put
    nodes: list[LevelNode] = []
    foresight: Foresight | None = None  # all of it, where it is news; None = as before

    def check(self) -> None:
        if self.posteriors.shape[1] != len(self.labels):
            raise ValueError("posteriors do not fit the labels")


class PosteriorRequest(Message, frozen=True, kw_only=True):
    """Why does a place carry its label?"""

    robot: str
    place_id: int


class ExpertVote(msgspec.Struct, frozen=True, kw_only=True):
    """One expert's opinion of one place."""

    expert: str
    confidence: float
    weight: float  # confidence times the expert's reliability
    log_probabilities: list[float]  # one per label


class NeighbourPull(msgspec.Struct, frozen=True, kw_only=True):
    """What one neighbour of a place does for its own label: any other costs the place `weight` times the prior's cost
    of that pair."""

    place_id: int
    label: str
    weight: float  # w_dist of the edge


class PosteriorReply(Message, frozen=True, kw_only=True):
    """Each expert's vote on a place; `found` is false when there is no such place.

    The energy of a label at this place, its neighbours' given, is unary + pull.
    """

    robot: str
    place_id: int
    found: bool
    label: str = ""
    labels: list[str] = []
    posterior: list[float] = []
    unary: list[float] = []
    votes: list[ExpertVote] = []
    frames: Number = 0  # keyframes that saw the place
    trust: float = 0.0  # sum of their trust
    position_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    region: int = NO_REGION
    pull: list[float] = []  # one per label: pairwise cost against the neighbours
    neighbours: list[NeighbourPull] = []
    unknown: float = 1.0
    predicted: bool = False
    temperature: float = 1.0  # posterior = softmax(-(unary + pull) / temperature)
    inclination_rad: float = 0.0  # of the local surface

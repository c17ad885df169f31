"""Regions and the label belief of each place, as deltas."""

from typing import Annotated

import msgspec
import numpy as np

from schemas.codec import Message, Shape


class Region(msgspec.Struct, frozen=True, kw_only=True):
    """One connected set of places with one label."""

    id: int
    label: str
    place_count: int
    probability: float  # mean posterior of the label over its places
    position_m: tuple[float, float, float]  # mean of its places
    area_m2: float  # footprint of its places' spheres, seen from above


class RegionDelta(Message, frozen=True, kw_only=True):
    """Change of regions and beliefs since the previous revision; with `snapshot`, all of them.

    Apply in this order: remove places, remove regions, upsert regions, upsert beliefs.
    """

    robot: str
    epoch: int
    revision: int
    stamp_ns: int
    prior_digest: str
    environment: str
    task: str
    space: str  # embedding space of the evidence, empty before the first
    snapshot: bool = False
    labels: list[str]  # the prior's regions; columns of `posteriors`
    regions: list[Region]
    removed_ids: Annotated[np.ndarray, Shape("int64", "removed")]
    place_ids: Annotated[np.ndarray, Shape("int64", "place")]
    place_regions: Annotated[np.ndarray, Shape("int64", "place")]  # region id of each place
    posteriors: Annotated[np.ndarray, Shape("float16", "place", "label")]
    unknown: Annotated[np.ndarray, Shape("float16", "place")]  # mass outside the prior's regions, or unobserved
    removed_place_ids: Annotated[np.ndarray, Shape("int64", "removed_place")]
    energy: float

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


class PosteriorReply(Message, frozen=True, kw_only=True):
    """Each expert's vote on a place; `found` is false when there is no such place."""

    robot: str
    place_id: int
    found: bool
    label: str = ""
    labels: list[str] = []
    posterior: list[float] = []
    unary: list[float] = []
    votes: list[ExpertVote] = []
    frames: int = 0  # keyframes that saw the place
    trust: float = 0.0  # sum of their trust

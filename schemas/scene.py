"""The stored scene graph: revisions and queries."""

from typing import Annotated

import msgspec
import numpy as np

from prior_sg.schemas.codec import Message, Number, NumberOrNone, Part, Shape, Stamp
from prior_sg.schemas.foresight import Foresight
from prior_sg.schemas.levels import LevelNode
from prior_sg.schemas.markers import SceneMarker
from prior_sg.schemas.objects import SceneObject
from prior_sg.schemas.regions import Region

MOST_REVISIONS = 10_000  # in one answer
_NO_IDS = msgspec.field(default_factory=lambda: np.zeros(0, np.int64))
_NO_LENGTHS = msgspec.field(default_factory=lambda: np.zeros(0, np.float32))
_NO_CORNERS = msgspec.field(default_factory=lambda: np.zeros((0, 2), np.float32))
_NO_POINTS = msgspec.field(default_factory=lambda: np.zeros((0, 3), np.float32))


class SceneRevision(Message, frozen=True, kw_only=True):
    """The store has made one more delta durable."""

    robot: str
    epoch: Number
    revision: NumberOrNone
    stamp_ns: Stamp
    places: Number
    edges: Number
    regions: Number


class SceneRequest(Message, frozen=True, kw_only=True):
    """The scene graph of one robot as stored: now, or as it was at the newest revision that is kept and not beyond the
    given one, nor later than the given time."""

    robot: str
    revision: int | None = None
    stamp_ns: int | None = None


class HistoryRequest(Message, frozen=True, kw_only=True):
    """Which revisions of one robot's scene are kept: the newest `limit`, of those below `before` where it is given."""

    robot: str
    limit: int = 1000
    before: int | None = None

    def check(self) -> None:
        if not 0 < self.limit <= MOST_REVISIONS:
            raise ValueError(f"limit: not between 1 and {MOST_REVISIONS}")


class StoredRevision(Part, frozen=True, kw_only=True):
    """One revision that can be asked for, and what it held."""

    revision: int
    session: int  # the life of the store that wrote it
    kind: str  # the delta that made it: place, region or object; snapshot where older history has been thinned out
    stamp_ns: int  # of the newest delta in it
    places: int
    edges: int
    regions: int
    objects: int


class RevisionList(Message, frozen=True, kw_only=True):
    """Revisions of one robot's scene, oldest first."""

    robot: str
    revisions: list[StoredRevision]


class Scene(Message, frozen=True, kw_only=True):
    """Everything the store holds about one robot; sorted by id, so equal scenes of one revision have equal bytes."""

    robot: str
    stamp_ns: Stamp
    environment: str
    task: str
    prior_digest: str
    space: str
    labels: list[str]
    regions: list[Region]
    place_ids: Annotated[np.ndarray, Shape("int64", "place")]
    positions_m: Annotated[np.ndarray, Shape("float32", "place", 3)]
    radii_m: Annotated[np.ndarray, Shape("float32", "place")]
    basis_points: Annotated[np.ndarray, Shape("int16", "place")]
    place_regions: Annotated[np.ndarray, Shape("int64", "place")]  # NO_REGION = not labelled yet
    posteriors: Annotated[np.ndarray, Shape("float16", "place", "label")]
    unknown: Annotated[np.ndarray, Shape("float16", "place")]
    edges: Annotated[np.ndarray, Shape("int64", "edge", 2)]
    clearances_m: Annotated[np.ndarray, Shape("float32", "edge")]
    trajectory: Annotated[np.ndarray, Shape("float32", "frame", 3)]  # camera centres of the keyframes, world
    predicted_ids: Annotated[np.ndarray, Shape("int64", "predicted")] = _NO_IDS  # places whose label is a prediction
    objects: list[SceneObject] = []
    # Frontiers and 2D places, as in PlaceDelta.
    frontier_ids: Annotated[np.ndarray, Shape("int64", "frontier")] = _NO_IDS
    frontier_directions: Annotated[np.ndarray, Shape("float32", "frontier", 3)] = _NO_POINTS
    frontier_areas_m2: Annotated[np.ndarray, Shape("float32", "frontier")] = _NO_LENGTHS
    surface_ids: Annotated[np.ndarray, Shape("int64", "surface")] = _NO_IDS
    ellipses: Annotated[np.ndarray, Shape("float32", "surface", 3)] = _NO_POINTS
    hull_counts: Annotated[np.ndarray, Shape("int64", "surface")] = _NO_IDS
    hulls_m: Annotated[np.ndarray, Shape("float32", "hull", 2)] = _NO_CORNERS
    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of the world, as in Keyframe; add it to any position
    revision: NumberOrNone = -1  # of the store, as in SceneRevision; -1 = nothing stored
    nodes: list[LevelNode] = []  # of the levels above regions, from below, by id
    foresight: Foresight = Foresight()  # what is expected beyond: predictions, none of which has been seen
    markers: list[SceneMarker] = []  # by dictionary and id
    merged_of: list[str] = []  # robots whose maps it is merged of, as in PlaceDelta; empty = it is a robot's own

    @property
    def plain(self) -> str:
        """The environment whose regions these are where no task has said which; empty where there are none."""
        return self.environment if self.regions else ""

    def unnumbered(self) -> "Scene":
        """The same without its revision, which counts what a store has applied: of one and the same scene it is another
        where a writer's snapshot stood for several deltas, or for none yet."""
        return msgspec.structs.replace(self, revision=-1)

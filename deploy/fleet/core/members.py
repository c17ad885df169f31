"""The maps of a fleet's robots, as followed, and how each lies in the fleet's frame (pure)."""

from dataclasses import dataclass, field

import numpy as np

from prior_sg.deploy.fleet.core.finding.matching import Map, map_of
from prior_sg.deploy.fleet.core.ids import Name, Sessions
from prior_sg.schemas.markers import MarkerKey
from prior_sg.schemas.objects import ObjectDelta
from prior_sg.schemas.places import PlaceDelta
from prior_sg.schemas.regions import RegionDelta
from prior_sg.schemas.scene import Scene
from prior_sg.services.deltas import Follower
from prior_sg.services.scene_store.core import graph as scenes
from prior_sg.services.scene_store.core import telling

Delta = PlaceDelta | RegionDelta | ObjectDelta
KEPT_SHARE, KEPT_M = 0.5, 1.0  # of the places that a new writer still knows under the same ids and nearby: it goes on


@dataclass
class Relation:
    """How a map lies in the fleet's frame."""

    fleet_from_own: np.ndarray  # (4, 4)
    given: bool  # by whoever started the bridge, not found
    places: int = 0  # of the map when this was last looked at
    tick: int = 0  # then


@dataclass
class Member:
    """One robot's map of one session. `graph` is as the robot tells it; of a former session, as it told it last."""

    name: Name
    graph: scenes.Graph
    former: bool = False
    relation: Relation | None = None
    why: str = "it has not been looked at yet"  # there is no relation
    tried_places: int = 0  # of the map when a relation was last sought
    tried_markers: frozenset[MarkerKey] = frozenset()  # that it shared then
    changed: bool = True  # since the merged scene was last made
    unfitted: bool = True  # changed since the relation was last looked at
    _map: Map | None = None

    def map(self) -> Map:
        """The map as it stands."""
        if self._map is None:
            self._map = map_of(telling.scene(self.graph))
        return self._map

    @property
    def written(self) -> tuple[Name, int]:
        """Whose map it is, and the epoch of who writes its places."""
        return self.name, self.graph.place_cursor.epoch

    def frame_ids(self) -> list[int]:
        """Of the map's trajectory."""
        graph = self.graph
        return [frame for frame, seen in sorted(graph.sightings.items()) if seen.epoch == graph.place_cursor.epoch]

    def sure_markers(self) -> set[MarkerKey]:
        """The markers that stand at one spot."""
        return {key for key, marker in self.graph.markers.items() if not marker.doubt}

    def touch(self) -> None:
        """Something of the map has changed."""
        self.changed = self.unfitted = True
        self._map = None

    @property
    def to_fit(self) -> bool:
        """Whether there is a relation that was found, and that has not seen the map as it is."""
        return self.relation is not None and not self.relation.given and self.unfitted


@dataclass
class Followed:
    """The streams of one robot."""

    member: Member
    places: Follower[PlaceDelta] = field(default_factory=Follower)
    regions: Follower[RegionDelta] = field(default_factory=Follower)
    objects: Follower[ObjectDelta] = field(default_factory=Follower)
    sessions: Sessions = field(default_factory=Sessions)

    def take(self, delta: Delta) -> Member | None:
        """Apply what is due of a delta. Returns the member of the session before, where a new one has begun.

        Raises InputRefused.
        """
        graph = self.member.graph
        match delta:
            case PlaceDelta():
                ended = None
                for ready in self.places.take(delta):
                    ended = self._begun(ready) or ended
                    scenes.apply_places(self.member.graph, ready)
                    self.member.touch()
                scenes.note_cameras(self.member.graph, delta)
                return ended
            case RegionDelta():
                for ready_regions in self.regions.take(delta):
                    scenes.apply_regions(graph, ready_regions)
                    self.member.touch()
            case ObjectDelta():
                for ready_objects in self.objects.take(delta):
                    scenes.apply_objects(graph, ready_objects)
                    self.member.touch()
        return None

    def lacking(self, delta: Delta) -> bool:
        """Whether the stream of this delta has a gap."""
        match delta:
            case PlaceDelta():
                return self.places.needs_snapshot
            case RegionDelta():
                return self.regions.needs_snapshot
            case ObjectDelta():
                return self.objects.needs_snapshot

    def _begun(self, delta: PlaceDelta) -> Member | None:
        """A new writer that knows nothing of the former places begins a session: the former map stays as it is."""
        former, graph = self.member, self.member.graph
        if graph.place_cursor.epoch == delta.epoch:
            return None
        if graph.place_cursor.epoch == -1:
            spots_m = dict(zip(delta.place_ids.tolist(), delta.positions_m.tolist(), strict=True))
            former.name = self.sessions.name_of(former.name.robot, spots_m, delta.epoch)
            return None
        if not graph.places or _goes_on(graph, delta):
            self.sessions.note(former.name, delta.epoch)
            return None
        name = self.sessions.begin(former.name.robot, delta.epoch)
        fresh = scenes.Graph(former.name.robot, place_cursor=graph.place_cursor)
        self.member = Member(name, fresh)
        former.former = True
        return former


def _goes_on(graph: scenes.Graph, delta: PlaceDelta) -> bool:
    """Whether the places of a new writer are the former ones: most ids are where they were."""
    known = [
        float(np.linalg.norm(np.subtract(graph.places[place].position_m, position_m))) < KEPT_M
        for place, position_m in zip(delta.place_ids.tolist(), delta.positions_m, strict=True)
        if place in graph.places
    ]
    return sum(known) >= KEPT_SHARE * len(graph.places)


def member_of_scene(scene: Scene, session: int = 0) -> Member:
    """The map of a stored scene, which nobody tells any more."""
    graph = scenes.Graph(scene.robot)
    columns = zip(
        scene.place_ids.tolist(),
        scene.positions_m.tolist(),
        scene.radii_m.tolist(),
        scene.basis_points.tolist(),
        strict=True,
    )
    for place, position_m, radius_m, basis in columns:
        graph.places[place] = scenes.Place(tuple(position_m), radius_m, basis)
    for (one, other), clearance_m in zip(scene.edges.tolist(), scene.clearances_m.tolist(), strict=True):
        scenes.link(graph, (one, other), clearance_m)
    openings = np.concatenate((scene.frontier_directions, scene.frontier_areas_m2[:, None]), axis=1)
    graph.frontiers = dict(zip(scene.frontier_ids.tolist(), openings, strict=True))
    predicted = set(scene.predicted_ids.tolist())
    beliefs = zip(
        scene.place_ids.tolist(), scene.place_regions.tolist(), scene.posteriors, scene.unknown.tolist(), strict=True
    )
    graph.beliefs = {
        place: scenes.Belief(region, posterior, unknown, place in predicted)
        for place, region, posterior, unknown in beliefs
    }
    graph.regions = {region.id: region for region in scene.regions}
    graph.nodes = {(node.level, node.id): node for node in scene.nodes}
    graph.objects = {item.id: item for item in scene.objects}
    graph.markers = {marker.key: marker for marker in scene.markers}
    graph.alignment = scenes.Alignment(
        scene.prior_digest, scene.environment, scene.task, scene.space, tuple(scene.labels)
    )
    graph.origin_m = scene.origin_m
    graph.place_cursor = scenes.Cursor(0, 0, scene.stamp_ns)
    graph.region_cursor = scenes.Cursor(0, 0, scene.stamp_ns)
    return Member(Name(scene.robot, session), graph, former=True)

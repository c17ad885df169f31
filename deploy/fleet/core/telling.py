"""The merged scene as the deltas of a robot: what has changed since they were told (pure)."""

from collections.abc import Iterator
from dataclasses import dataclass, field

import msgspec
import numpy as np

from prior_sg.deploy.fleet.core.foreseeing import news
from prior_sg.deploy.fleet.core.marks import GONE
from prior_sg.deploy.fleet.core.merging import Merged
from prior_sg.deploy.told import ToldGraph, ToldObjects
from prior_sg.schemas.codec import Message
from prior_sg.schemas.markers import MarkerKey, SceneMarker
from prior_sg.schemas.objects import ObjectDelta
from prior_sg.schemas.places import PlaceDelta
from prior_sg.schemas.regions import RegionDelta
from prior_sg.schemas.scene import Scene
from prior_sg.services.place_graph.core.columns import CameraColumns, Heading, place_delta
from prior_sg.services.segmenter.core.regions.ledger import Beliefs, Ledger, nothing

NO_FRAME = -1
CAMERA_M = 0.05  # by which a camera must have moved to be told again


@dataclass
class Teller:
    """What readers of the merged scene know."""

    robot: str
    epoch: int
    merged_of: tuple[str, ...] = ()  # robots that the command names
    graph: ToldGraph = field(default_factory=ToldGraph)
    objects: ToldObjects = field(default_factory=ToldObjects)
    regions: Ledger = field(default_factory=Ledger)
    markers: dict[MarkerKey, SceneMarker] = field(default_factory=dict)
    cameras_m: dict[int, np.ndarray] = field(default_factory=dict)  # (3,) by frame id
    place_revision: int = -1
    object_revision: int = -1
    scene: Scene | None = None  # as last told

    def tell(self, merged: Merged, event: str, min_change_m: float, posterior_change: float) -> Iterator[Message]:
        """The deltas from what was told to this scene."""
        scene = merged.scene
        before, self.scene = self.scene, scene
        told = self.graph.follow(scene, min_change_m)
        fresh = self._cameras(merged.frame_ids, scene.trajectory)
        if told is not None or len(fresh.past_frame_ids) or event:
            self.place_revision += 1
            columns = told if told is not None else ToldGraph().snapshot()
            yield place_delta(self._heading(event), *columns, fresh)
        delta = self._regions(scene, before, posterior_change)
        if delta is not None:
            yield delta
        news, gone = self.objects.follow(scene.objects, min_change_m)
        marks = self._marks(scene)
        if news or gone or marks:
            self.object_revision += 1
            self.markers |= {marker.key: marker for marker in marks}
            removed_ids = np.array(gone, np.int64)
            yield msgspec.structs.replace(self._objects(), objects=news, removed_ids=removed_ids, markers=marks)

    def greeting(self) -> PlaceDelta:
        """Whose the merged map is, before anything is in it."""
        self.place_revision += 1
        return self.places_snapshot()

    def places_snapshot(self) -> PlaceDelta:
        """Everything that was told of places."""
        cameras = _columns(dict(sorted(self.cameras_m.items())))
        return place_delta(self._heading("")._replace(snapshot=True), *self.graph.snapshot(), cameras)

    def regions_snapshot(self) -> RegionDelta:
        """Everything that was told of regions."""
        return self.regions.snapshot(self.robot, self.epoch)

    def objects_snapshot(self) -> ObjectDelta:
        """Everything that was told of objects."""
        markers = [marker for _, marker in sorted(self.markers.items())]
        return msgspec.structs.replace(self._objects(), snapshot=True, objects=self.objects.all(), markers=markers)

    def _marks(self, scene: Scene) -> list[SceneMarker]:
        """Markers that are new, stand otherwise or are gone."""
        now = {marker.key: marker for marker in scene.markers}
        gone = {key: msgspec.structs.replace(self.markers[key], doubt=GONE) for key in self.markers.keys() - now.keys()}
        return [marker for key, marker in sorted((now | gone).items()) if self.markers.get(key) != marker]

    def _heading(self, event: str) -> Heading:
        stamp_ns, origin_m = (0, (0.0, 0.0, 0.0)) if self.scene is None else (self.scene.stamp_ns, self.scene.origin_m)
        heading = Heading(self.robot, self.epoch, self.place_revision, stamp_ns, NO_FRAME, event=event)
        return heading._replace(origin_m=origin_m, merged_of=self.merged_of)

    def _cameras(self, frame_ids: np.ndarray, cameras_m: np.ndarray) -> CameraColumns:
        """Cameras that are new or have moved."""
        far = np.full(3, np.inf)
        news = {
            frame: camera_m
            for frame, camera_m in zip(frame_ids.tolist(), cameras_m, strict=True)
            if not np.linalg.norm(camera_m - self.cameras_m.get(frame, far)) <= CAMERA_M
        }
        self.cameras_m |= news
        return _columns(news)

    def _regions(self, scene: Scene, before: Scene | None, posterior_change: float) -> RegionDelta | None:
        everything = before is None or _aim(before) != _aim(scene)
        if before is not None and not everything:
            self.regions.forget(np.setdiff1d(before.place_ids, scene.place_ids))
        head = msgspec.structs.replace(
            nothing(self.robot, self.epoch, scene.labels),
            stamp_ns=scene.stamp_ns,
            prior_digest=scene.prior_digest,
            environment=scene.environment,
            task=scene.task,
            space=scene.space,
        )
        now = Beliefs(
            scene.place_ids,
            scene.place_regions,
            scene.posteriors,
            scene.unknown,
            np.isin(scene.place_ids, scene.predicted_ids),
        )
        return self.regions.tell(
            head,
            scene.place_ids,
            now,
            {region.id: region for region in scene.regions},
            [],
            nodes={(node.level, node.id): node for node in scene.nodes},
            foresight=news(self.regions.foresight, scene.foresight),
            everything=everything,
            tolerance=posterior_change,
        )

    def _objects(self) -> ObjectDelta:
        return ObjectDelta(
            robot=self.robot,
            epoch=self.epoch,
            revision=self.object_revision,
            stamp_ns=0 if self.scene is None else self.scene.stamp_ns,
            prior_digest="" if self.scene is None else self.scene.prior_digest,
            objects=[],
            removed_ids=np.zeros(0, np.int64),
        )


def _aim(scene: Scene) -> tuple[list[str], str, str, str]:
    return scene.labels, scene.task, scene.environment, scene.prior_digest


def _columns(cameras_m: dict[int, np.ndarray]) -> CameraColumns:
    frames = np.array(list(cameras_m), np.int64)
    return CameraColumns(frames, np.array(list(cameras_m.values()), np.float32).reshape(-1, 3))

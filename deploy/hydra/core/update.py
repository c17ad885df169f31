"""What each input of the bridge changes, and what follows from it (pure).

A graph that came before the first keyframe waits for it: only a keyframe says where our world has its origin.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import msgspec
import numpy as np

from prior_sg.deploy.hydra.core.graph import GraphLost, HydraGraph, Origin, in_our_world
from prior_sg.deploy.hydra.core.poses import Poses
from prior_sg.deploy.hydra.core.rooms import room_names
from prior_sg.deploy.told import ToldGraph, ToldObjects
from prior_sg.schemas.codec import Message
from prior_sg.schemas.frames import Keyframe, PoseUpdate
from prior_sg.schemas.objects import ObjectDelta
from prior_sg.schemas.places import PlaceDelta, SnapshotRequest
from prior_sg.schemas.regions import RegionDelta
from prior_sg.schemas.status import Tick
from prior_sg.services.deltas import Follower
from prior_sg.services.losses import Losses
from prior_sg.services.place_graph.core.columns import (
    CameraColumns,
    GraphColumns,
    GroundColumns,
    Heading,
    OpeningColumns,
    place_delta,
)
from prior_sg.services.scene_store.core import graph as scenes

TURN_RAD = math.radians(1.0)  # by which Hydra must have turned a keyframe before that is told
Columns = tuple[GraphColumns, OpeningColumns, GroundColumns]


class Config(msgspec.Struct, frozen=True, kw_only=True):
    """Where Hydra is, and how its graph is to be read."""

    graph_from: str = "tcp://127.0.0.1:8001"  # where Hydra's ZmqSink sends
    labels_to: str = "tcp://127.0.0.1:8002"  # where Hydra's ZmqRoomLabelUpdater listens; empty = no names go back
    scale: float = 1.0  # metres per unit of Hydra's world
    min_change_m: float = 0.01  # smaller changes of places, edges and objects are not told
    objects: bool = True  # whether Hydra's objects become those of the scene
    correct_poses: bool = True  # whether keyframes follow Hydra's agent nodes when a loop closure moves them
    pose_change_m: float = 0.05  # by which a keyframe must have moved
    apart_m: float = 3.0  # camera and robot farther from each other than this do not stand in one world
    silent_after_s: float = 5.0  # without a graph, that is said

    def __post_init__(self) -> None:
        if not 0 < self.scale < math.inf:
            raise ValueError("scale must be a positive number of metres")
        if not (self.min_change_m >= 0 and self.pose_change_m > 0):
            raise ValueError("min_change_m must not be negative, pose_change_m must be positive")


class RoomNames(Message, frozen=True, kw_only=True):
    """Names that Hydra's rooms are to bear."""

    robot: str
    names: dict[int, str]  # by the whole value of the room's symbol


class RoomNamesSent(Message, frozen=True, kw_only=True):
    """They are out; who listens is not known."""

    robot: str


@dataclass
class State:
    """What the bridge of one robot knows."""

    robot: str
    epoch: int
    graph: ToldGraph = field(default_factory=ToldGraph)
    objects: ToldObjects = field(default_factory=ToldObjects)
    poses: Poses = field(default_factory=Poses)
    regions: Follower[RegionDelta] = field(default_factory=Follower)
    scene: scenes.Graph = field(default_factory=lambda: scenes.Graph(""))  # regions and beliefs of the segmenter
    losses: Losses = field(default_factory=Losses)
    room_of: dict[int, int] = field(default_factory=dict)  # by place
    cameras_m: dict[int, Origin] = field(default_factory=dict)  # by frame id
    unsaid: set[int] = field(default_factory=set)  # frames whose camera readers have yet to hear of
    early: HydraGraph | None = None  # that waits for the first keyframe
    origin_m: Origin | None = None
    frame_id: int = -1
    stamp_ns: int = 0
    revision: int = -1
    object_epoch: int = 0
    object_revision: int = -1
    pose_revision: int = -1
    apart_told: bool = False


def update(state: State, message: Message, cfg: Config) -> Iterator[Message]:
    """Take one input; yields deltas and questions."""
    match message:
        case HydraGraph():
            yield from _follow(state, message, cfg)
        case Keyframe():
            _hear(state, message)
            if state.early is not None:
                graph, state.early = state.early, None
                yield from _follow(state, graph, cfg)
            return
        case RegionDelta():
            yield from _regions(state, message, cfg)
        case Tick():
            if state.unsaid and state.revision >= 0:
                yield _places(state, None, "")
        case GraphLost():
            state.losses.add("graphs of Hydra left out", message.why)
            return
        case _:
            return
    if cfg.labels_to and (names := names_of(state)):  # again and again: whoever listens late hears them, too
        yield RoomNames(robot=state.robot, names=names)


def _hear(state: State, keyframe: Keyframe) -> None:
    """Where the cameras are is part of the place graph's stream."""
    x, y, z = keyframe.world_from_camera[:3, 3].tolist()
    state.origin_m = keyframe.origin_m
    state.frame_id = max(state.frame_id, keyframe.frame_id)
    state.stamp_ns = max(state.stamp_ns, keyframe.stamp_ns)
    if state.cameras_m.get(keyframe.frame_id) is None:
        state.cameras_m[keyframe.frame_id] = x, y, z
        state.unsaid.add(keyframe.frame_id)
        state.poses.heard(keyframe.frame_id, keyframe.stamp_ns, keyframe.world_from_camera)


def _follow(state: State, graph: HydraGraph, cfg: Config) -> Iterator[Message]:
    if state.origin_m is None:
        state.early = graph
        return
    for _ in range(graph.left_out):
        state.losses.add("nodes of Hydra left out", "their numbers are not finite, or absurd")
    graph = in_our_world(graph, cfg.scale, state.origin_m)
    state.room_of = dict(zip(graph.place_ids.tolist(), graph.place_rooms.tolist(), strict=True))
    state.stamp_ns = max(state.stamp_ns, graph.stamp_ns)
    moved = state.poses.follow(graph, cfg.pose_change_m, TURN_RAD)
    if moved and cfg.correct_poses:
        yield _corrected(state, moved)
    told = state.graph.follow(graph, cfg.min_change_m)
    event = _apart(state, cfg)
    if told is not None or state.unsaid or event:
        yield _places(state, told, event)
    if cfg.objects:
        yield from _objects(state, graph, cfg)


def _corrected(state: State, moved: dict[int, np.ndarray]) -> PoseUpdate:
    state.pose_revision += 1
    for frame_id, pose in moved.items():
        x, y, z = pose[:3, 3].tolist()
        state.cameras_m[frame_id] = x, y, z
    state.unsaid |= moved.keys()
    return PoseUpdate(
        robot=state.robot,
        epoch=state.epoch,
        revision=state.pose_revision,
        stamp_ns=state.stamp_ns,
        frame_ids=np.array(list(moved), np.int64),
        world_from_camera=np.array(list(moved.values())),
    )


def _apart(state: State, cfg: Config) -> str:
    """Said once, when camera and robot stand in different worlds."""
    apart_m = state.poses.apart_m()
    if state.apart_told or apart_m <= cfg.apart_m:
        return ""
    state.apart_told = True
    return (
        f"the camera is {apart_m:.1f} m from Hydra's robot at the same times: they stand in different worlds; give "
        "ingest poses in Hydra's world, or set scale"
    )


def _places(state: State, told: Columns | None, event: str) -> PlaceDelta:
    state.revision += 1
    columns = told if told is not None else ToldGraph().snapshot()
    frames, state.unsaid = sorted(state.unsaid), set()
    return place_delta(_heading(state)._replace(event=event), *columns, _cameras(state, frames))


def _heading(state: State) -> Heading:
    origin_m = state.origin_m or (0.0, 0.0, 0.0)
    return Heading(state.robot, state.epoch, state.revision, state.stamp_ns, state.frame_id, origin_m=origin_m)


def _cameras(state: State, frame_ids: list[int]) -> CameraColumns:
    return CameraColumns(
        past_frame_ids=np.array(frame_ids, np.int64),
        past_cameras_m=np.array([state.cameras_m[i] for i in frame_ids], np.float32).reshape(-1, 3),
    )


def _objects(state: State, graph: HydraGraph, cfg: Config) -> Iterator[ObjectDelta]:
    news, gone = state.objects.follow(graph.objects, cfg.min_change_m)
    if news or gone:
        state.object_revision += 1
        removed = np.array(gone, np.int64)
        yield msgspec.structs.replace(_object_delta(state), objects=news, removed_ids=removed)


def _object_delta(state: State, snapshot: bool = False) -> ObjectDelta:
    return ObjectDelta(
        robot=state.robot,
        epoch=state.object_epoch,
        revision=state.object_revision,
        stamp_ns=state.stamp_ns,
        prior_digest="",  # their labels are Hydra's words, of no prior
        snapshot=snapshot,
        objects=[],
        removed_ids=np.zeros(0, np.int64),
    )


def _regions(state: State, delta: RegionDelta, cfg: Config) -> Iterator[Message]:
    """Follow the segmenter. It answers for objects too, as the writer of a younger epoch when it has started later than
    the bridge: then ours begin anew, in a younger one still."""
    for ready in state.regions.take(delta):
        scenes.apply_regions(state.scene, ready)
    if state.regions.needs_snapshot:
        yield SnapshotRequest(robot=state.robot)
    if cfg.objects and delta.epoch >= state.object_epoch:
        state.object_epoch, state.object_revision = delta.epoch + 1, 0
        yield msgspec.structs.replace(_object_delta(state, snapshot=True), objects=state.objects.all())


def names_of(state: State) -> dict[int, str]:
    """What Hydra's rooms are called by our regions."""
    region_of = {place: belief.region for place, belief in state.scene.beliefs.items()}
    labels = {region.id: region.label for region in state.scene.regions.values()}
    return room_names(state.room_of, region_of, labels)


def places_snapshot(state: State) -> PlaceDelta:
    """Everything that was told of places."""
    heading = _heading(state)._replace(snapshot=True)
    return place_delta(heading, *state.graph.snapshot(), _cameras(state, sorted(state.cameras_m.keys() - state.unsaid)))


def objects_snapshot(state: State) -> ObjectDelta:
    """Everything that was told of objects."""
    return msgspec.structs.replace(_object_delta(state, snapshot=True), objects=state.objects.all())

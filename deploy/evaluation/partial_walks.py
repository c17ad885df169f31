"""Two robots in one generated home: scenes of parts of its walk, each in a frame of its own.

Each part is mapped anew, from keyframes whose poses are moved by a rigid transform (any heading, up to a degree of
tilt, tens of metres) and drift by centimetres, so that nothing of one map's grid lies as in the other's. Regions are
those of the real segmenter with a simulated encoder. Objects are the true ones that were seen, less those that a
detector misses; some are mistaken for another, and all lie and measure a little wrong.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

from prior_sg.deploy.evaluation.datasets import Dataset, WorldName, of_world
from prior_sg.deploy.evaluation.methods import Case, Variant
from prior_sg.deploy.evaluation.perception import Cache, Perceiver, Perception, seen_by
from prior_sg.deploy.evaluation.robots import WalkingRobot
from prior_sg.deploy.evaluation.simulated import SimulatedEncoder
from prior_sg.deploy.evaluation.worlds import world_of
from prior_sg.deploy.truth import GroundTruth, TrueObject
from prior_sg.schemas.codec import decode, encode
from prior_sg.schemas.features import Pyramid
from prior_sg.schemas.frames import Keyframe
from prior_sg.schemas.objects import SceneObject
from prior_sg.schemas.places import MapRequest, SnapshotRequest, VoxelMap
from prior_sg.schemas.priors import Prior
from prior_sg.schemas.scene import Scene
from prior_sg.schemas.topics import KEYFRAME, PLACE_SNAPSHOT, VOXEL_MAP
from prior_sg.services.geometry import inverse, transform
from prior_sg.services.registry import BY_NAME
from prior_sg.services.runtime.runner import Runner
from prior_sg.services.runtime.service import Identity
from prior_sg.services.segmenter.core.config import Config

ROBOT = "eval"
ENCODER = "simlike", 0.4
FARTHEST_M, TILT_RAD = 30.0, np.radians(1.0)
DRIFT_M, DRIFT_RAD = 0.02, np.radians(0.2)  # of each keyframe against the one before: a random walk pulled back
HOLDING = 0.9  # what is left of the drift from one keyframe to the next
MISSED, MISTAKEN = 0.15, 0.15  # shares of the objects
OFF_M, MISMEASURED = 0.1, 0.15  # standard deviations of an object's place, and of its size against the true one
LEAST_VOXELS = 4  # occupied ones in an object's box that was seen
CODE = "1"  # changes with what is kept on disk


class Part(NamedTuple):
    """A share of a walk: from and to, as shares of its keyframes, and which random numbers move it; 0 = none do."""

    start: float
    stop: float
    seed: int


@dataclass(frozen=True)
class PartialMap:
    """What one robot made of a part of a walk."""

    scene: Scene
    own_from_world: np.ndarray  # (4, 4): the world's frame to the robot's, less its drift
    voxels: VoxelMap


class Kept(msgspec.Struct):
    """A partial map as it is kept on disk."""

    scene: bytes
    voxels: bytes
    own_from_world: list[float]


class Walks:
    """Makes partial maps of generated homes and keeps them in a folder; the robots' prior is one for the task."""

    def __init__(self, folder: Path, config: Config | None = None, kind: str = "home", task: str = "") -> None:
        self.cache, self.config, self.kind, self.task = Cache(folder), config or Config(), kind, task
        self._home: tuple[int, Dataset, Perception, list[Keyframe]] | None = None

    def part(self, seed: int, part: Part) -> PartialMap:
        """A part of the walk through a home."""
        key = {"world": [self.kind, seed], "part": list(part), "encoder": ENCODER, "code": CODE}
        key |= {"task": self.task} if self.task else {}
        found = self.cache.get("partial", key)
        if found is None:
            made = self._make(seed, part)
            kept = Kept(encode(made.scene), encode(made.voxels), made.own_from_world.ravel().tolist())
            found = [msgspec.msgpack.encode(kept)]
            self.cache.put("partial", key, found)
        kept = msgspec.msgpack.decode(found[0], type=Kept)
        pose = np.array(kept.own_from_world).reshape(4, 4)
        return PartialMap(decode(Scene, kept.scene), pose, decode(VoxelMap, kept.voxels))

    def truth(self, seed: int) -> GroundTruth:
        """The true regions of a home."""
        return world_of(self.kind, seed).truth

    def prior(self, seed: int) -> Prior:
        """The robots' prior there."""
        return of_world(WorldName(self.kind, seed), self.task).prior

    def home(self, seed: int) -> tuple[Dataset, Perception, list[Keyframe]]:
        """A home as a simulated encoder sees the whole walk, and its keyframes."""
        if self._home is None or self._home[0] != seed:
            dataset = of_world(WorldName(self.kind, seed), self.task)
            perceiver = Perceiver({}, self.cache, lambda *_: None)
            encoder = SimulatedEncoder(*ENCODER, seed)
            perception = seen_by(encoder, perceiver.layout(dataset), dataset)
            self._home = seed, dataset, perception, keyframes(dataset)
        return self._home[1:]

    def robot(self, seed: int, part: Part, name: str) -> WalkingRobot:
        """A robot that walks a part, with what it sees at each keyframe."""
        dataset, perception, frames = self.home(seed)
        rng = np.random.default_rng([seed, part.seed])
        chosen, own_from_world, pyramids = self._chosen(part, perception, frames, rng)

        def detect(voxels: VoxelMap) -> list[SceneObject]:
            return detected(dataset.objects, voxels, own_from_world, np.random.default_rng([seed, part.seed, 1]))

        return WalkingRobot(name, chosen, pyramids, prior=dataset.prior, text=perception.text, detect=detect)

    def _chosen(
        self, part: Part, perception: Perception, frames: list[Keyframe], rng: np.random.Generator
    ) -> tuple[list[Keyframe], np.ndarray, tuple[Pyramid, ...]]:
        """The keyframes of a part as they are told, how they lie, and what is seen in them."""
        chosen, poses, own_from_world = told_poses(part, frames, rng)
        told = [
            msgspec.structs.replace(frame, robot=ROBOT, frame_id=number, world_from_camera=pose)
            for number, (frame, pose) in enumerate(zip(chosen, poses, strict=True))
        ]
        as_told = {frame.frame_id: one for frame, one in zip(chosen, told, strict=True)}
        pyramids = tuple(
            msgspec.structs.replace(
                one,
                robot=ROBOT,
                frame_id=as_told[one.frame_id].frame_id,
                world_from_camera=as_told[one.frame_id].world_from_camera,
            )
            for one in perception.pyramids
            if one.frame_id in as_told
        )
        return told, own_from_world, pyramids

    def _make(self, seed: int, part: Part) -> PartialMap:
        dataset, perception, frames = self.home(seed)
        rng = np.random.default_rng([seed, part.seed])
        chosen, own_from_world, pyramids = self._chosen(part, perception, frames, rng)
        places = BY_NAME["place_graph"]
        runner = Runner(places, places.config(), Identity(ROBOT, "place_graph", 1))
        for frame in chosen:
            runner.feed(frame)
        voxels: VoxelMap = runner.answer(VOXEL_MAP, MapRequest(robot=ROBOT))
        snapshot = runner.answer(PLACE_SNAPSHOT, SnapshotRequest(robot=ROBOT))
        seen = replace(perception, places=snapshot, voxels=voxels, pyramids=pyramids)
        scene = Variant(self.config).run(Case(seen, dataset.prior, dataset.truth))
        objects = detected(dataset.objects, voxels, own_from_world, np.random.default_rng([seed, part.seed, 1]))
        return PartialMap(msgspec.structs.replace(scene, objects=objects), own_from_world, voxels)


def told_poses(
    part: Part, frames: list[Keyframe], rng: np.random.Generator
) -> tuple[list[Keyframe], list[np.ndarray], np.ndarray]:
    """The keyframes of a part, the poses (4, 4) that its robot tells of them, and how its frame lies to the world's."""
    chosen = frames[round(part.start * len(frames)) : max(round(part.stop * len(frames)), 1)]
    poses, own_from_world = [np.array(frame.world_from_camera) for frame in chosen], np.eye(4)
    if part.seed:
        own_from_world = moved(rng)
        poses = drifting([own_from_world @ pose for pose in poses], rng)
    return chosen, poses, own_from_world


def keyframes(dataset: Dataset) -> list[Keyframe]:
    """The keyframes of a dataset."""
    ingest = BY_NAME["ingest"]
    runner = Runner(ingest, ingest.config(), Identity(ROBOT, "ingest", 1))
    return [
        message
        for frame in dataset.source()
        for topic, message in runner.feed(frame)
        if topic is KEYFRAME and isinstance(message, Keyframe)
    ]


def moved(rng: np.random.Generator) -> np.ndarray:
    """A rigid motion (4, 4): any heading, a little tilt."""
    yaw, roll, pitch = rng.uniform(-np.pi, np.pi), *rng.uniform(-TILT_RAD, TILT_RAD, 2)
    pose = np.eye(4)
    pose[:3, :3] = _turn(2, yaw) @ _turn(1, pitch) @ _turn(0, roll)
    pose[:3, 3] = rng.uniform(-FARTHEST_M, FARTHEST_M, 3) * (1, 1, 0.1)
    return pose


def drifting(poses: Sequence[np.ndarray], rng: np.random.Generator) -> list[np.ndarray]:
    """The same poses as odometry tells them."""
    off_m, off_rad, drifted = np.zeros(3), 0.0, []
    for pose in poses:
        off_m = HOLDING * off_m + rng.normal(0, DRIFT_M, 3) * (1, 1, 0.5)
        off_rad = HOLDING * off_rad + rng.normal(0, DRIFT_RAD)
        told = pose.copy()
        told[:3, :3] = _turn(2, off_rad) @ pose[:3, :3]
        told[:3, 3] += off_m
        drifted.append(told)
    return drifted


def detected(
    objects: Sequence[TrueObject], voxels: VoxelMap, own_from_world: np.ndarray, rng: np.random.Generator
) -> list[SceneObject]:
    """The objects that were seen, as a detector tells them."""
    points_m = transform(inverse(own_from_world), (voxels.occupied + 0.5) * voxels.voxel_m)
    labels = sorted({item.label for item in objects})
    found = []
    for number, item in enumerate(objects):
        inside = ((points_m >= item.min_m - 0.05) & (points_m <= item.max_m + 0.05)).all(axis=1).sum()
        missed, mistaken, other = rng.random() < MISSED, rng.random() < MISTAKEN, labels[rng.integers(len(labels))]
        stray_m, grown = rng.normal(0, OFF_M, 3), 1 + rng.normal(0, MISMEASURED, 3)
        if inside < LEAST_VOXELS or missed:
            continue
        corners = np.array([(item.min_m, item.max_m)[i][a] for i in (0, 1) for a in (0, 1, 2)]).reshape(2, 3)
        box = np.array([[corners[i, 0], corners[j, 1], corners[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
        box = transform(own_from_world, box)
        middle_m = box.mean(axis=0) + stray_m
        half_m = (box.max(axis=0) - box.min(axis=0)) / 2 * np.clip(grown, 0.5, 1.5)
        low, high = (middle_m - half_m).tolist(), (middle_m + half_m).tolist()
        found.append(
            SceneObject(
                id=number,
                label=other if mistaken else item.label,
                probability=0.8,
                known=0.9,
                position_m=tuple(middle_m.tolist()),
                min_m=tuple(low),
                max_m=tuple(high),
                frames=3,
            )
        )
    return found


def _turn(axis: int, angle: float) -> np.ndarray:
    one, other = [k for k in range(3) if k != axis]
    turn = np.eye(3)
    turn[one, one] = turn[other, other] = np.cos(angle)
    turn[other, one] = np.sin(angle)
    turn[one, other] = -np.sin(angle)
    return turn

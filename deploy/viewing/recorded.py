"""A run that is over: its log with every revision and image, or the store's file with the last scene."""

import bisect
import contextlib
import copy
import dataclasses
import logging
import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from prior_sg.deploy.api.client import Health
from prior_sg.deploy.errors import UserError
from prior_sg.deploy.inspecting import replay
from prior_sg.deploy.viewing.cloud import Cloud, small_image
from prior_sg.deploy.viewing.sources import Camera, Say
from prior_sg.schemas.codec import Message, decode
from prior_sg.schemas.frames import Keyframe, PoseUpdate
from prior_sg.schemas.objects import ObjectDelta
from prior_sg.schemas.places import PlaceDelta
from prior_sg.schemas.priors import Prior, Task
from prior_sg.schemas.regions import PosteriorReply, PosteriorRequest, RegionDelta
from prior_sg.schemas.scene import Scene
from prior_sg.schemas.topics import (
    KEYFRAME,
    OBJECT_DELTA,
    PLACE_DELTA,
    POSE_UPDATE,
    POSTERIOR,
    PRIOR,
    REGION_DELTA,
    TASK,
)
from prior_sg.services.deltas import Delta, Follower, PoseCorrections
from prior_sg.services.images import ImageFault
from prior_sg.services.runtime.record import LogError, Logged, read_log
from prior_sg.services.runtime.runner import Runner
from prior_sg.services.scene_store.core import graph as core

logger = logging.getLogger(__name__)
KEPT_EVERY = 24  # steps between graphs that are kept, from which others are made
IMAGE_PX = 320
LIVE_ONLY = "this is a recording; a task can be given to a running system (`prior-sg up`, then `prior-sg view`)"


class LogHistory:
    """The scene after each delta of a log. Raises LogError."""

    def __init__(self, path: Path, robot: str) -> None:
        self.robot = robot
        self.priors: dict[str, Prior] = {}
        self._steps: list[Callable[[core.Graph], Any]] = []
        self.stamps: list[int] = []
        self._kept: dict[int, core.Graph] = {}
        self._lock = threading.Lock()
        followers: dict[str, Follower[Any]] = {}
        robots = set()
        for logged in read_log(path, (PLACE_DELTA, REGION_DELTA, OBJECT_DELTA, TASK, PRIOR)):
            message = decode(logged.topic.type, logged.payload)
            if isinstance(message, Prior):
                self.priors[message.digest()] = message
                continue
            named = robot_of(message)
            robots.add(named)
            if named == robot:
                self._take(message, followers.setdefault(logged.topic.name, Follower()))
        if not self._steps:
            others = f"; name one of {', '.join(sorted(robots))} with --robot" if robots else ""
            raise LogError(f"{path} holds no scene of {robot}{others}")
        self._remember()

    def _take(self, message: Any, follower: Follower[Any]) -> None:
        if isinstance(message, Task):
            self._steps.append(partial(core.set_task, task=message))
            self.stamps.append(self.stamps[-1] if self.stamps else 0)
            return
        for due in follower.take(message):
            self._steps.append(partial(_apply, delta=due))
            self.stamps.append(max(due.stamp_ns, self.stamps[-1] if self.stamps else 0))

    def _remember(self) -> None:
        graph = core.Graph(self.robot)
        for number, step in enumerate(self._steps):
            if number % KEPT_EVERY == 0:
                self._kept[number] = _copied(graph)
            step(graph)

    def scene(self, moment: int) -> Scene:
        """The scene after step number `moment`."""
        with self._lock:
            first = moment // KEPT_EVERY * KEPT_EVERY
            graph = _copied(self._kept[first])
            for step in self._steps[first : moment + 1]:
                step(graph)
            return core.scene(graph)


def _apply(graph: core.Graph, delta: Delta) -> None:
    match delta:
        case PlaceDelta():
            core.note_cameras(graph, delta)
            core.apply_places(graph, delta)
        case RegionDelta():
            core.apply_regions(graph, delta)
        case ObjectDelta():
            core.apply_objects(graph, delta)


def _copied(graph: core.Graph) -> core.Graph:
    """A graph that changes on its own; what its tables hold never changes in place."""
    copied = copy.copy(graph)
    for item in dataclasses.fields(graph):
        if isinstance(value := getattr(graph, item.name), dict):
            setattr(copied, item.name, dict(value))
    copied.neighbours = {place: set(others) for place, others in graph.neighbours.items()}
    return copied


class Recorded:
    """A log; images and points are read on a thread of their own."""

    live = False

    def __init__(self, path: Path, robot: str) -> None:
        self.robot, self.title, self.cloud = robot, f"recording {path.name}", Cloud()
        self._path = path
        self._history = LogHistory(path, robot)
        self._cameras: list[Camera] = []
        self._segmenter: Runner | None = None
        self._open = contextlib.ExitStack()
        self._asking = threading.Lock()
        self._closed = threading.Event()
        self._reader = threading.Thread(target=self._read_images, name="images", daemon=True)
        self._reader.start()

    def _read_images(self) -> None:
        poses = PoseCorrections()
        try:
            for logged in read_log(self._path, (KEYFRAME, POSE_UPDATE)):
                if self._closed.is_set():
                    return
                self._take_image(logged, poses)
        except LogError as error:
            logger.warning("the rest of the images is not shown: %s", error)

    def _take_image(self, logged: Logged, poses: PoseCorrections) -> None:
        message = decode(logged.topic.type, logged.payload)
        if robot_of(message) != self.robot:
            return
        if isinstance(message, PoseUpdate):
            self.cloud.move(poses.take(message) or {})
        elif isinstance(message, Keyframe):
            with contextlib.suppress(ImageFault):  # the map has refused such a keyframe, too
                pose = poses.pose(message.frame_id, message.world_from_camera)
                frame = msgspec.structs.replace(message, world_from_camera=pose)
                self.cloud.add(frame)
                self._cameras.append(camera_of(frame))

    def stamps(self) -> list[int]:
        return self._history.stamps

    def scene(self, moment: int | None = None) -> Scene:
        return self._history.scene(len(self._history.stamps) - 1 if moment is None else moment)

    def wait(self, timeout_s: float) -> bool:
        self._closed.wait(timeout_s)
        return False

    def camera(self, until_ns: float = np.inf) -> Camera | None:
        cameras = list(self._cameras)
        at = bisect.bisect_right([camera.stamp_ns for camera in cameras], until_ns)
        return cameras[at - 1] if at else None

    def explain(self, place_id: int, say: Say) -> PosteriorReply:
        with self._asking:
            if self._segmenter is None:
                say("feeding the recording to its segmenter once more")
                log = replay.open_log(self._path, "segmenter")
                lives = [life for life in log.lives if life.started.robot == self.robot]
                if not lives:
                    raise LogError(f"{self._path} holds no segmenter of {self.robot}")
                self._segmenter = self._open.enter_context(replay.final(log, lives[-1]))
            reply: PosteriorReply = self._segmenter.answer(
                POSTERIOR, PosteriorRequest(robot=self.robot, place_id=place_id)
            )
            return reply

    def prior(self, digest: str) -> Prior | None:
        return self._history.priors.get(digest)

    def health(self) -> Health | None:
        return None

    def switch(self, task: str, environment: str, say: Say) -> str:
        raise UserError(LIVE_ONLY)

    def close(self) -> None:
        self._closed.set()
        self._reader.join()
        with self._asking:
            self._open.close()


class Stored:
    """The last scene of a database; no images, no votes."""

    live = False

    def __init__(self, scene: Scene, title: str) -> None:
        self.robot, self.title, self.cloud = scene.robot, title, Cloud()
        self._scene, self._closed = scene, threading.Event()

    def stamps(self) -> list[int]:
        return [self._scene.stamp_ns]

    def scene(self, moment: int | None = None) -> Scene:
        return self._scene

    def wait(self, timeout_s: float) -> bool:
        self._closed.wait(timeout_s)
        return False

    def camera(self, until_ns: float = np.inf) -> Camera | None:
        return None

    def explain(self, place_id: int, say: Say) -> PosteriorReply:
        raise UserError("this file holds beliefs but no votes; open the run's folder or log.mcap to see why")

    def prior(self, digest: str) -> Prior | None:
        return None

    def health(self) -> Health | None:
        return None

    def switch(self, task: str, environment: str, say: Say) -> str:
        raise UserError(LIVE_ONLY)

    def close(self) -> None:
        self._closed.set()


def robot_of(message: Message) -> str:
    """Whose message it is."""
    return str(getattr(message, "robot", ""))


def camera_of(frame: Keyframe) -> Camera:
    """What the page shows of a keyframe. Raises ImageFault."""
    image = small_image(frame, IMAGE_PX)
    return Camera(frame.frame_id, frame.stamp_ns, frame.intrinsics, frame.world_from_camera, image)


def open_recorded(path: Path, robot: str) -> Recorded | Stored:
    """A run's folder, a log or a database. Raises UserError, LogError, StoreError."""
    if path.is_dir():
        found = [path / name for name in ("log.mcap", "scene.sqlite") if (path / name).exists()]
        if not found:
            raise UserError(f"{path} holds neither log.mcap nor scene.sqlite; name the folder of a run")
        return open_recorded(found[0], robot)
    if not path.exists():
        raise UserError(f"{path} does not exist; make a run with `prior-sg demo`")
    if path.suffix == ".mcap":
        return Recorded(path, robot)
    from prior_sg.deploy.cli.report import scene_in

    scene = scene_in(path, robot)
    if not len(scene.place_ids) and not scene.regions:
        raise UserError(f"{path} holds no scene of {robot}; name another robot with --robot")
    return Stored(scene, f"file {path.name}")

"""The running system as servers want it: every robot through one connection, off the event loop, bounded."""

import asyncio
import contextlib
import itertools
import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeVar
from weakref import WeakValueDictionary

import msgspec
import numpy as np

from prior_sg.deploy.api.client import Client, Health
from prior_sg.deploy.api.errors import NotInSceneError, TaskError
from prior_sg.deploy.api.scene import Scene
from prior_sg.deploy.serving.errors import BusyError, FaultyRequestError
from prior_sg.deploy.showing.text import USUAL_TOKENS, scene_text
from prior_sg.schemas.answers import What
from prior_sg.schemas.codec import DecodeError
from prior_sg.schemas.frames import IngestState
from prior_sg.schemas.names import fault_of_robot, normal
from prior_sg.schemas.priors import Prior, fault_of_task
from prior_sg.schemas.queries import (
    MOST_RANKED,
    AnswersTo,
    ChangedSince,
    Question,
    RouteBetween,
    SceneAnswer,
    WhereToLook,
)
from prior_sg.schemas.scene import Scene as SceneMessage
from prior_sg.schemas.scene import SceneRevision
from prior_sg.schemas.topics import INGEST_STATE, SCENE_REVISION
from prior_sg.services.runtime.bus import Bus, Sample, message_in

MOST_ROBOTS = 64  # whose clients are kept
MOST_WRITTEN = 8  # forms of scenes that are kept
READERS, WRITERS, PORTERS = 16, 4, 2  # threads that ask, that change, and that write whole scenes
MOST_QUESTIONS, MOST_POSES, MOST_LIMIT = 64, 10_000, 10_000
MOST_LABOUR = 8  # routes, outlooks and comparisons of revisions at once: the store takes nothing else meanwhile
LABOUR = (RouteBetween, WhereToLook, ChangedSince)
LONGEST_SEARCH = 500  # characters
EVERYWHERE: dict[str, Any] = {"min_m": (-1e9,) * 3, "max_m": (1e9,) * 3}
T = TypeVar("T")


@dataclass(frozen=True)
class TaskGiven:
    """What came of a task: its prior, and its scene where the regions followed in time."""

    prior: Prior
    scene: Scene | None
    seconds: float
    note: str = ""  # why there is no scene, or why another one will follow


@dataclass(frozen=True)
class Written:
    """A scene in one form. `begun` is when it was asked for, in the count of all that ask."""

    tag: str
    begun: int
    body: bytes


class System:
    """Asks with one connection. What changes something gets one of its own, for as long as it takes: a publisher tells
    late readers what it has sent as long as it lives, also when others have corrected that since."""

    def __init__(self, open_bus: Callable[[], Bus], robot: str) -> None:
        self.robot = robot
        self._open_bus, self._bus = open_bus, open_bus()
        self._own = Client(robot=robot, bus=self._bus)
        self._clients: OrderedDict[str, Client] = OrderedDict()  # of other robots
        self._written: OrderedDict[tuple[str, str], Written] = OrderedDict()  # by robot and form
        self._writes: WeakValueDictionary[tuple[str, str], asyncio.Lock] = (
            WeakValueDictionary()
        )  # each lives while used
        self._asked = itertools.count(1)
        self._lock = threading.Lock()
        self._seen = {robot}
        self._changing: set[str] = set()
        self._reading = ThreadPoolExecutor(READERS, "reader")
        self._writing = ThreadPoolExecutor(WRITERS, "writer")
        self._carrying = ThreadPoolExecutor(PORTERS, "porter")
        self.on_revision: list[Callable[[SceneRevision], None]] = []  # each is called on a foreign thread
        self._sources: dict[str, IngestState] = {}  # by robot
        for topic, saw in ((SCENE_REVISION, self._saw), (INGEST_STATE, self._saw_source)):
            self._bus.subscribe(topic, topic.pattern("*"), saw, lambda topic, number: None)

    def close(self) -> None:
        """Leave the system; what waits for it ends."""
        self._reading.shutdown(wait=False, cancel_futures=True)
        self._writing.shutdown(wait=False, cancel_futures=True)
        self._carrying.shutdown(wait=False, cancel_futures=True)
        self._bus.close()

    def robots(self) -> list[str]:
        """The robot this was started for, and every other whose scene has changed since."""
        return sorted(self._seen)

    async def answers(self, robot: str, *questions: Question) -> SceneAnswer:
        """Answers of the store. Raises FaultyRequestError, NotInSceneError, BusError."""
        if len(questions) > MOST_QUESTIONS:
            raise FaultyRequestError(
                f"{len(questions)} questions are asked at once: at most {MOST_QUESTIONS} are taken"
            )
        if sum(getattr(question, "limit", 0) for question in questions) > MOST_LIMIT:
            raise FaultyRequestError(f"the limit is above {MOST_LIMIT}: ask for fewer")
        if sum(isinstance(question, LABOUR) for question in questions) > MOST_LABOUR:
            raise FaultyRequestError(
                f"more than {MOST_LABOUR} routes, outlooks and changes are asked for at once: ask for fewer"
            )
        found: SceneAnswer = await self._read(robot, lambda client: client.answers(*questions))
        if found.revision < 0:
            raise NotInSceneError(f"nothing is stored of a robot {robot!r}")
        return found

    async def find(self, robot: str, text: str, what: What | None = None, limit: int = MOST_RANKED) -> SceneAnswer:
        """What answers a text, as `Client.find`. Raises as `answers`."""
        if not text.strip() or len(text) > LONGEST_SEARCH:
            raise FaultyRequestError(f"a text to search for has 1 to {LONGEST_SEARCH} characters")
        regions, objects, missing = await self._read(robot, lambda client: client.likeness(text))
        question = AnswersTo(text=text, regions=regions, objects=objects, what=what, limit=limit)
        found = await self.answers(robot, question)
        ranking: Any = found.answers[0]
        if missing:
            told = msgspec.structs.replace(ranking, note=f"{ranking.note}: {missing}".removeprefix(": "))
            found = msgspec.structs.replace(found, answers=[told])
        return found

    async def scene(self, robot: str) -> Scene:
        """The scene as stored now. Raises as `answers`."""
        return await self._read(robot, lambda client: client.scene())

    async def told(self, robot: str, tag: str, budget_tokens: int = USUAL_TOKENS) -> bytes:
        """The scene in few words, within a budget. Raises as `answers`."""
        return await self.written(robot, tag, f"text {budget_tokens}", partial(_text, budget_tokens=budget_tokens))

    async def tag(self, robot: str) -> str:
        """Another one whenever the scene is another. Raises as `answers`."""
        now = await self.answers(robot)
        return f"{now.revision}-{now.stamp_ns}"

    async def written(self, robot: str, tag: str, form: str, write: Callable[[SceneMessage], bytes]) -> bytes:
        """The scene as `write` puts it, once for each tag and form; those who ask meanwhile share what was begun after
        they came. Raises as `answers`."""
        key, asked = (robot, form), next(self._asked)
        lock = self._writes.setdefault(key, asyncio.Lock())
        async with lock:
            kept = self._written.get(key)
            if kept is None or (kept.tag != tag and kept.begun < asked):
                kept = Written(tag, next(self._asked), await self._carry(robot, write))
                self._written[key] = kept
                while len(self._written) > MOST_WRITTEN:
                    self._written.popitem(last=False)
            return kept.body

    async def health(self) -> Health:
        """What every process says of itself. Raises BusError."""
        return await self._read(self.robot, lambda client: client.health())

    async def give_task(
        self, robot: str, task: str, environment: str, regions: Sequence[str], wait_s: float
    ) -> TaskGiven:
        """Switch the task and wait. Raises FaultyRequestError, BusyError, TaskError, NoPriorError, BusError."""
        task, environment = normal(task), normal(environment)
        if not task:
            raise FaultyRequestError("the task is empty: say what the robot is to do")
        if fault := fault_of_task(environment, task, list(regions)):
            raise FaultyRequestError(fault)
        given = await self._change(robot, lambda client: _switch(client, task, environment, regions, wait_s))
        read = self._sources.get(robot)
        if read is None or read.finished or given.scene is None:
            return given
        of = f" of {read.frames_total}" if read.frames_total else ""
        return replace(given, note=f"the map still grows: {read.frames_read}{of} frames are read; regions go with it")

    def source(self, robot: str) -> IngestState:
        """How far the robot's source is read. Raises FaultyRequestError, NotInSceneError."""
        _check_robot(robot)
        if robot not in self._sources:
            raise NotInSceneError(
                f"no ingest of {robot} has said how far its source is read: start one with a --source"
            )
        return self._sources[robot]

    async def correct_poses(self, robot: str, poses: dict[int, np.ndarray[Any, Any]], wait_s: float) -> float:
        """Give keyframes other poses; seconds until the map took them. Raises as `give_task`, and PosesError."""
        if len(poses) > MOST_POSES:
            raise FaultyRequestError(f"{len(poses)} poses are given at once: at most {MOST_POSES} are taken")
        return await self._change(robot, lambda client: client.correct_poses(poses, wait_s))

    async def _read(self, robot: str, ask: Callable[[Client], T]) -> T:
        client = self._client(robot)
        return await asyncio.get_running_loop().run_in_executor(self._reading, ask, client)

    async def _carry(self, robot: str, write: Callable[[SceneMessage], bytes]) -> bytes:
        """A whole scene, written on threads that those who ask small questions do not wait for."""
        client = self._client(robot)
        job = partial(_written_by, client, write)
        return await asyncio.get_running_loop().run_in_executor(self._carrying, job)

    async def _change(self, robot: str, change: Callable[[Client], T]) -> T:
        """One change of a robot at a time."""
        _check_robot(robot)
        if robot in self._changing:
            raise BusyError(f"{robot} is being given a task or poses: try again when that is done")
        self._changing.add(robot)
        try:
            job = partial(self._with_client, robot, change)
            return await asyncio.get_running_loop().run_in_executor(self._writing, job)
        finally:
            self._changing.discard(robot)

    def _with_client(self, robot: str, change: Callable[[Client], T]) -> T:
        with Client(robot=robot, bus=self._open_bus()) as client:
            return change(client)

    def _client(self, robot: str) -> Client:
        """The client that asks for a robot; those asked for least recently are forgotten."""
        _check_robot(robot)
        if robot == self.robot:
            return self._own
        with self._lock:
            client = self._clients.pop(robot, None) or Client(robot=robot, bus=self._bus)
            client.vectors = self._own.vectors
            self._clients[robot] = client
            while len(self._clients) > MOST_ROBOTS:
                self._clients.popitem(last=False)
        return client

    def _saw(self, sample: Sample) -> None:
        with contextlib.suppress(DecodeError):
            revision: SceneRevision = message_in(sample)
            if len(self._seen) < MOST_ROBOTS:
                self._seen.add(revision.robot)
            for told in self.on_revision:
                told(revision)

    def _saw_source(self, sample: Sample) -> None:
        with contextlib.suppress(DecodeError):
            state: IngestState = message_in(sample)
            if state.robot in self._sources or len(self._sources) < MOST_ROBOTS:
                self._sources[state.robot] = state


def _text(scene: SceneMessage, budget_tokens: int) -> bytes:
    return scene_text(scene, budget_tokens).encode()


def _written_by(client: Client, write: Callable[[SceneMessage], bytes]) -> bytes:
    return write(client.scene().message)


def _check_robot(robot: str) -> None:
    if fault := fault_of_robot(robot):
        raise FaultyRequestError(fault)


def _switch(client: Client, task: str, environment: str, regions: Sequence[str], wait_s: float) -> TaskGiven:
    found: list[Prior] = []
    try:
        switch = client.switch(task, environment or None, regions, wait_s, on_prior=found.append)
    except TaskError as error:
        if not found:
            raise
        return TaskGiven(found[0], None, wait_s, str(error))
    return TaskGiven(switch.prior, switch.scene, switch.seconds)

"""A running system as Python programs want it: ask, switch the task, correct poses, follow what changes."""

import contextlib
import queue
import threading
import time
import weakref
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from prior_sg.deploy.api.arrivals import Arrivals
from prior_sg.deploy.api.asking import Asking
from prior_sg.deploy.api.errors import NotInSceneError, PosesError, TaskError
from prior_sg.deploy.api.kept import kept
from prior_sg.deploy.api.scene import Scene
from prior_sg.deploy.api.together import given_each, not_above, told_once
from prior_sg.deploy.settings import DEFAULT_CONNECT, DEFAULT_ROBOT, ROUTER_WAIT_S
from prior_sg.schemas.answers import Answer, Difference
from prior_sg.schemas.codec import DecodeError, Message
from prior_sg.schemas.features import TextEmbeddings, TextRequest
from prior_sg.schemas.frames import PoseUpdate
from prior_sg.schemas.members import follows_robots, only_of_robots
from prior_sg.schemas.priors import Prior, PriorList, PriorRequest, Task
from prior_sg.schemas.queries import ChangedSince, Question, SceneAnswer, SceneQuery, WordsInUse, checked
from prior_sg.schemas.regions import PosteriorReply, PosteriorRequest
from prior_sg.schemas.scene import HistoryRequest, RevisionList, SceneRequest, StoredRevision
from prior_sg.schemas.scene import Scene as SceneMessage
from prior_sg.schemas.status import Consumed, ServiceStatus
from prior_sg.schemas.topics import (
    HISTORY,
    JOURNAL,
    OBJECT_DELTA,
    PLACE_DELTA,
    POSE_UPDATE,
    POSTERIOR,
    PRIORS,
    REGION_DELTA,
    SCENE,
    SCENE_QUERY,
    SCENE_REVISION,
    TEXT,
)
from prior_sg.services.runtime.bus import Bus, BusError, Sample, message_in
from prior_sg.services.runtime.client import BusClient
from prior_sg.services.runtime.zenoh_bus import ZenohBus

STORE_POLL_S = 0.1
NAMES_WAIT_S = 5.0  # for the objects' names, which follow a task's regions
MERGE_WAIT_S = 10.0  # for a merged map, which follows its robots once a second
MOST_CHANGES = 4096  # that wait for a follower
MOST_PRIORS = 16  # that a client keeps
DELTAS = (PLACE_DELTA, REGION_DELTA, OBJECT_DELTA)


@dataclass(frozen=True)
class Switch:
    """A task that is in force: its scene, its prior, and how long its regions took from being asked for."""

    scene: Scene
    prior: Prior
    seconds: float


@dataclass(frozen=True)
class Health:
    """Every process that is alive; of those that do not answer, why, by instance."""

    processes: list[ServiceStatus]
    silent: dict[str, str]


class Changes:
    """Messages as they arrive; iteration waits for the next and ends when the client, or this, is closed. Of those that
    nobody takes, the newest are kept; `lost` counts the others.
    """

    def __init__(self) -> None:
        self.lost = 0
        self._arrived: deque[Message] = deque(maxlen=MOST_CHANGES)
        self._closed = False
        self._changed = threading.Condition()

    def __iter__(self) -> Iterator[Message]:
        while (message := self._next()) is not None:
            yield message

    def _next(self) -> Message | None:
        with self._changed:
            self._changed.wait_for(lambda: self._arrived or self._closed)
            return self._arrived.popleft() if self._arrived else None

    def put(self, message: Message) -> None:
        """One more message, from any thread; none after the end."""
        with self._changed:
            if self._closed:
                return
            self.lost += len(self._arrived) == MOST_CHANGES
            self._arrived.append(message)
            self._changed.notify()

    def close(self) -> None:
        """End the iteration after what has arrived."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()


class Client(Asking):
    """One robot of a running system. Use as a context manager, or call `close`. Raises BusError when no router answers.

    `bus` takes the place of a connection of its own, for tests and for programs that hold one.
    """

    def __init__(self, connect: str = DEFAULT_CONNECT, robot: str = DEFAULT_ROBOT, *, bus: Bus | None = None) -> None:
        self.robot = robot
        self._above: tuple[str, ...] = ()  # merged maps for whose robots this one is asked
        self._client = BusClient(ZenohBus(connect, ROUTER_WAIT_S) if bus is None else bus)
        self._lock = threading.Lock()
        self._priors: dict[str, Prior] = {}  # by digest
        self._followers: dict[str, weakref.WeakSet[Changes]] = {}  # by topic

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Leave the system; whoever iterates over `changes` comes to the end."""
        self._client.bus.close()
        with self._lock:
            for follower in {one for followers in self._followers.values() for one in followers}:
                follower.close()

    def scene(self, *, revision: int | None = None, stamp_ns: int | None = None) -> Scene:
        """The scene graph as stored now, as it was at a revision, or as it was last at a time. Raises BusError,
        NotInSceneError.
        """
        request = SceneRequest(robot=self.robot, revision=revision, stamp_ns=stamp_ns)
        message: SceneMessage = self._client.ask(SCENE, request)
        return kept(Scene(message), revision, stamp_ns)

    def history(self, limit: int = 1000, before: int | None = None) -> list[StoredRevision]:
        """The newest revisions that the store keeps, of those below `before`, oldest first; at most 10 000 at once.
        Raises BusError.
        """
        request = HistoryRequest(robot=self.robot, limit=limit, before=before)
        reply: RevisionList = self._client.ask(HISTORY, request)
        return reply.revisions

    def ask(self, *questions: Question) -> list[Answer]:
        """Answers to questions of `prior_sg.schemas.queries`, in their order, over one revision. Raises BusError."""
        return self.answers(*questions).answers

    def answers(self, *questions: Question) -> SceneAnswer:
        """The same with the revision that they are about. Raises BusError."""
        found: SceneAnswer = self._client.ask(
            SCENE_QUERY, SceneQuery(robot=self.robot, questions=[checked(one) for one in questions])
        )
        return found

    def changed_since(self, revision: int) -> Difference:
        """What is new, gone and renamed since a revision. Raises NotInSceneError where it is not kept, BusError."""
        difference: Difference = self._understood(ChangedSince(revision=revision))
        return difference

    def prior_of(self, digest: str) -> Prior | None:
        """The prior of a digest, where a gateway knows it. Raises BusError."""
        if digest not in self._priors:
            known: PriorList = self._client.ask(PRIORS, PriorRequest(digest=digest))
            self._priors |= {prior.digest(): prior for prior in known.priors}
            while len(self._priors) > MOST_PRIORS:
                self._priors.pop(next(iter(self._priors)))
        return self._priors.get(digest)

    def embed(self, space: str, phrases: Sequence[str]) -> np.ndarray[Any, Any]:
        """Unit vectors (phrase, dim) by a worker of the space. Raises BusError."""
        request = TextRequest(space=space, concepts=[[phrase] for phrase in phrases])
        reply: TextEmbeddings = self._client.ask(TEXT, request)
        return reply.embeddings

    def explain(self, place: int) -> PosteriorReply:
        """Why a place carries its label. Raises NotInSceneError, BusError."""
        if robots := self._merged_of():
            raise NotInSceneError(only_of_robots(self.robot, robots, "why a place carries its label"))
        reply: PosteriorReply = self._client.ask(POSTERIOR, PosteriorRequest(robot=self.robot, place_id=place))
        if not reply.found:
            raise NotInSceneError(f"{self.robot} has no labelled place {place}; Scene.places.ids lists them")
        return reply

    def task(
        self, text: str, environment: str | None = None, regions: Sequence[str] | None = None, timeout_s: float = 60.0
    ) -> Scene:
        """Give the robot a task and wait for its regions; `environment` is the one in force unless named, `regions`
        fixes their names. Raises TaskError, NoPriorError, BusError.
        """
        return self.switch(text, environment, regions, timeout_s).scene

    def switch(
        self,
        text: str,
        environment: str | None = None,
        regions: Sequence[str] | None = None,
        timeout_s: float = 60.0,
        *,
        waiting: Callable[[str], None] = lambda reason: None,
        on_prior: Callable[[Prior], None] = lambda prior: None,
    ) -> Switch:
        """As `task`, with all that came of it. `waiting` is told why there is no prior yet, `on_prior` the prior.

        Objects get their names a moment after the regions; the scene has them, unless that takes long. A merged map's
        task is given to each of its robots; the prior is the first one's.
        """
        before: Any
        (before,) = self.ask(WordsInUse())
        if before.merged_of:
            told: dict[str, Any] = {"waiting": waiting, "on_prior": told_once(on_prior)}
            return self._switch_each(before.merged_of, text, environment, regions, timeout_s, **told)
        environment = environment or before.environment
        if not environment:
            raise TaskError(f"{self.robot} has no environment yet; name one (--environment) with the task")
        task = Task(
            robot=self.robot,
            stamp_ns=self._client.task_stamp_ns(self.robot),
            environment=environment,
            task=text,
            regions=list(regions or ()),
        )
        arrivals = Arrivals(task)
        with contextlib.ExitStack() as listening:
            for topic in (REGION_DELTA, OBJECT_DELTA):
                listening.enter_context(self._client.listening(topic, self.robot, arrivals.see))
            prior = self._client.give_task(task, timeout_s, waiting)
            on_prior(prior)
            digest, end_s = prior.digest(), time.monotonic() + timeout_s
            if digest == before.prior_digest:  # nothing will come: the regions follow it already
                return Switch(self.scene(), prior, arrivals.seconds())
            seconds = arrivals.wait(digest, end_s)
            scene = None if seconds is None else self._stored(lambda now: now.prior_digest == digest, end_s)
            if seconds is None or scene is None:
                raise TaskError(f"no regions for the new task within {timeout_s:.0f} s; see `prior-sg health`")
            if prior.objects and scene.message.objects:
                end_s = time.monotonic() + NAMES_WAIT_S
                arrived = arrivals.wait_for_names(digest, end_s)
                named = self._stored(lambda now: arrivals.are_in(now, digest), end_s) if arrived else None
                scene = named or self.scene()
        return Switch(scene, prior, seconds)

    def _switch_each(self, robots: Sequence[str], *asked: Any, **told: Any) -> Switch:
        """Of a merged map: `switch` each of its robots, and wait until the map follows them."""
        given = given_each(robots, lambda one: self._below(one).switch(*asked, **told))
        task, digests = given[0].scene.task, {one.prior.digest() for one in given}
        end_s = time.monotonic() + MERGE_WAIT_S
        scene = self._stored(lambda now: now.task == task and now.prior_digest in digests, end_s)
        if scene is None:
            raise TaskError(
                f"{', '.join(robots)} follow the task, and their merged map {self.robot} does not within "
                f"{MERGE_WAIT_S:.0f} s; see `prior-sg health`"
            )
        return Switch(scene, given[0].prior, max(one.seconds for one in given))

    def _below(self, robot: str) -> "Client":
        """Of one of the robots that this map is merged of. Raises TaskError where that is a map merged of this one."""
        one = Client(robot=robot, bus=self._client.bus)
        one._above = not_above(robot, (*self._above, self.robot))
        return one

    def _stored(self, is_it: Callable[[SceneMessage], bool], end_s: float) -> Scene | None:
        """The scene once the store has taken what is waited for; None when it has not by then."""
        while not is_it((scene := self.scene()).message):
            if time.monotonic() > end_s:
                return None
            time.sleep(STORE_POLL_S)
        return scene

    def correct_poses(self, poses: Mapping[int, np.ndarray[Any, Any]], timeout_s: float = 60.0) -> float:
        """Give keyframes, by number, their corrected world_from_camera (4, 4), as after a loop closure, and wait until
        the map has taken them; returns the seconds. Raises PosesError.
        """
        update = self._pose_update(poses)
        if robots := self._merged_of():
            raise PosesError(follows_robots(self.robot, robots, "the poses"))
        if "place_graph" not in self._client.alive().values():
            raise PosesError("no place_graph is running to take the poses; start it with `prior-sg up`")
        taken: queue.SimpleQueue[int] = queue.SimpleQueue()  # which of ours; the journal's history tells of older ones

        def see(sample: Sample) -> None:
            with contextlib.suppress(DecodeError):
                entry: Consumed = message_in(sample)
                if (entry.service, entry.topic, entry.writer) == ("place_graph", POSE_UPDATE.name, self._client.writer):
                    taken.put(entry.sequence)

        with self._client.listening(JOURNAL, self.robot, see):
            started_s = time.monotonic()
            number = self._client.publish(POSE_UPDATE, update)
            try:
                while taken.get(timeout=max(started_s + timeout_s - time.monotonic(), 0.0)) != number:
                    pass
            except queue.Empty:
                raise PosesError(f"the map took no poses within {timeout_s:.0f} s; see `prior-sg health`") from None
        return time.monotonic() - started_s

    def _merged_of(self) -> list[str]:
        """Whose maps this one is merged of; none where it is a robot's own, or no store says."""
        if "scene_store" not in self._client.alive().values():
            return []
        words: Any
        (words,) = self.ask(WordsInUse())
        return list(words.merged_of)

    def _pose_update(self, poses: Mapping[int, np.ndarray[Any, Any]]) -> PoseUpdate:
        if not poses:
            raise PosesError("there are no poses to correct")
        try:
            return PoseUpdate(
                robot=self.robot,
                epoch=time.time_ns(),
                revision=0,
                stamp_ns=time.time_ns(),
                frame_ids=np.array(list(poses), np.int64),
                world_from_camera=np.stack([np.asarray(pose, np.float64) for pose in poses.values()]),
            )
        except ValueError as error:
            raise PosesError(f"the poses cannot be used: {error}") from error

    def changes(self, deltas: bool = False) -> Changes:
        """From now on, a SceneRevision whenever the store has made a change durable; with `deltas`, also every
        PlaceDelta, RegionDelta and ObjectDelta, beginning with the latest that their writers keep.
        """
        changes = Changes()
        for topic in (SCENE_REVISION, *(DELTAS if deltas else ())):
            with self._lock:
                known = topic.name in self._followers
                self._followers.setdefault(topic.name, weakref.WeakSet()).add(changes)
            if not known:
                self._client.listen(topic, self.robot, self._saw)
        return changes

    def _saw(self, sample: Sample) -> None:
        with contextlib.suppress(DecodeError):
            message: Message = message_in(sample)
            with self._lock:
                for follower in self._followers[sample.topic.name]:
                    follower.put(message)

    def health(self) -> Health:
        """What every process says of itself."""
        processes, silent = [], {}
        for instance, service in sorted(self._client.alive().items()):
            try:
                processes.append(self._client.status(service, instance))
            except BusError as error:
                silent[instance] = str(error)
        return Health(processes, silent)

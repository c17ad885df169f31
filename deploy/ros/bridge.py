"""A node of ROS 2 that tells of a robot's scene as the store has it, and gives the robot tasks where it may."""

import asyncio
import contextlib
import logging
import signal
import threading
import time
from collections.abc import Callable, Coroutine
from functools import partial
from typing import Any

from prior_sg.deploy.errors import UserError
from prior_sg.deploy.ros import frames, masks, parameters
from prior_sg.deploy.ros.options import Options
from prior_sg.deploy.ros.parameters import Parameters, fault_of_task_text
from prior_sg.deploy.ros.topics import SET_TASK, STRING, TASK_STATE, TF_TOPIC, Teller, latched_types
from prior_sg.deploy.running.serve import parent_gone
from prior_sg.deploy.serving.door import joined
from prior_sg.deploy.serving.system import System
from prior_sg.schemas.names import normal
from prior_sg.schemas.scene import Scene, SceneRevision
from prior_sg.services.errors import PriorSgError
from prior_sg.services.runtime.keys import bundle_in_force
from prior_sg.services.runtime.ros.session import Publisher, Received, RosSession
from prior_sg.services.runtime.ros.types import Types
from prior_sg.services.runtime.ros.wire import Channel, Quality

log = logging.getLogger(__name__)
TF_PERIOD_S = 1.0
IDLE_S = 10.0  # after which the scene is asked for though nobody told of a change: such notices may be lost
REST = 2.0  # times as long as telling of a large scene takes, nothing is told: others need the processor as well
TASK_WAIT_S = 300.0  # a language model may take minutes
TF_DEPTH = 100
CLOSED = "this bridge takes no tasks: start it with --take-tasks"
BUSY = "a task is being given: try again when the topic task tells of its end"
Say = Callable[[str], None]


def serve_ros(connect: str, robot: str, options: Options, opened: Say, say: Say, *, parent: int = 0) -> None:
    """Tell of a robot's scene until a signal; `opened` is told where, `say` what happens. Raises BusError, UserError,
    ExtraMissing.
    """
    bundle = bundle_in_force()
    if options.takes_tasks and bundle is not None and bundle.own.role == "viewer":
        raise UserError(f"these keys are of {bundle.own.name}, a viewer, who gives no tasks; leave out --take-tasks")
    types = bridge_types()
    look = options.look
    with RosSession(options.router, look.node, options.domain) as ros, joined(connect, robot) as system:
        bridge = Bridge(system, ros, types, options, say)
        opened(f"node /{look.node} on {options.router}, domain {options.domain}: topics under {look.topic('')}")
        asyncio.run(_until_end(bridge, parent))


def bridge_types() -> Types:
    """ROS 2's definitions, and what the bridge needs beside them. Raises ExtraMissing."""
    types = Types()
    types.add_message(masks.INFO, masks.INFO_TEXT)
    for name, (_, request, reply) in parameters.SERVICES.items():
        types.add_service(parameters.type_of(name), request, reply)
    return types


class Bridge:
    """One robot and one node; lives on the event loop, while messages come on Zenoh's threads."""

    def __init__(self, system: System, ros: RosSession, types: Types, options: Options, say: Say) -> None:
        self._system, self._ros, self._types, self._options, self._say = system, ros, types, options, say
        self._teller = Teller(types.store.types, options.look)
        self._parameters = Parameters(types.store.types, self._in_force, self._give)
        self._publishers = {name: self._publisher(name, kind) for name, kind in latched_types(options.look).items()}
        self._tf = ros.publisher(self._channel(TF_TOPIC, frames.TF, Quality(TF_DEPTH)))
        self._told: dict[str, bytes] = {}  # the latest message of each topic
        self._scene: Scene | None = None
        self._arrived_s = 0.0
        self._giving = threading.Lock()  # held while a task is being given
        self._missing: list[str] = []
        self._silent = ""  # why there is no scene
        self._jobs: set[asyncio.Task[None]] = set()

    def _publisher(self, name: str, kind: str) -> Publisher:
        return self._ros.publisher(self._channel(self._options.look.topic(name), kind, Quality(1, latched=True)))

    def _channel(self, name: str, kind: str, quality: Quality = Quality()) -> Channel:
        return Channel(name, kind, self._types.hash(kind), quality)

    async def run(self) -> None:
        """Until it is cancelled."""
        self._loop, self._news = asyncio.get_running_loop(), asyncio.Event()
        self._system.on_revision.append(self._saw)
        for name, message in self._teller.filter_infos():
            self._put(name, message)
        self._listen()
        async with asyncio.TaskGroup() as jobs:
            jobs.create_task(self._follow())
            jobs.create_task(self._repeat_tf())

    def _saw(self, revision: SceneRevision) -> None:
        if revision.robot == self._system.robot:
            self._loop.call_soon_threadsafe(self._news.set)

    async def _follow(self) -> None:
        """Tell of the scene whenever it has changed, and no oftener than asked for."""
        while True:
            self._news.clear()
            since_s = time.monotonic()
            try:
                scene = (await self._system.scene(self._system.robot)).message
                self._silent = ""
            except PriorSgError as error:
                self._tell_silence(str(error))
            else:
                if scene.revision >= 0 and _tag(scene) != _tag(self._scene):
                    await asyncio.to_thread(self._tell, scene)
            await asyncio.sleep(max(self._options.interval_s, REST * (time.monotonic() - since_s)))
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._news.wait(), IDLE_S)

    def _tell_silence(self, reason: str) -> None:
        if reason != self._silent:
            self._silent = reason
            self._say(reason)

    def _tell(self, scene: Scene) -> None:
        for name, message in self._teller.about(scene):
            self._put(name, message)
        self._scene, self._arrived_s = scene, time.monotonic()
        self._put_tf()
        if not self._giving.locked():
            self._put(TASK_STATE, self._teller.task_state(_state(scene.task, "in force" if scene.task else "none")))
        missing = masks.without_region(self._options.look.rules, scene.regions)
        if missing != self._missing:
            self._missing = missing
            self._say(f"masks without a region at present: {', '.join(missing) or 'none'}")

    def _put(self, name: str, message: Any) -> None:
        """Publish what is not what was said last."""
        data = self._types.encode(message)
        if self._told.get(name) != data:
            self._told[name] = data
            self._publishers[name].publish(data)

    async def _repeat_tf(self) -> None:
        while True:
            await asyncio.sleep(TF_PERIOD_S)
            self._put_tf()

    def _put_tf(self) -> None:
        """With the time that it is by the clock of the scene's stamps."""
        if self._scene is not None:
            now_ns = self._scene.stamp_ns + round((time.monotonic() - self._arrived_s) * 1e9)
            self._tf.publish(self._types.encode(self._teller.tf(self._scene, now_ns)))

    def _listen(self) -> None:
        """Take what comes from ROS."""
        self._ros.subscribe(self._channel(self._options.look.topic(SET_TASK), STRING), self._hear, self._complain)
        for service in parameters.SERVICES:
            channel = self._channel(self._options.look.topic(service), parameters.type_of(service))
            self._ros.serve(channel, partial(self._answer, service), self._complain)

    def _complain(self, topic: str, reason: str) -> None:
        log.warning("message of ROS not taken", extra={"topic": topic, "why": reason})

    def _answer(self, service: str, request: bytes) -> bytes:
        asked = self._types.decode(request, f"{parameters.type_of(service)}_Request")
        return self._types.encode(self._parameters.answer(service, asked))

    def _hear(self, message: Received) -> None:
        try:
            text = self._types.decode(message.payload, STRING).data
            fault = fault_of_task_text(text) or self._give(normal(text))
        except ValueError as error:
            fault = str(error)
        if fault:
            self._complain(message.topic, fault)

    def _in_force(self) -> dict[str, str]:
        scene = self._scene
        task, environment = (scene.task, scene.environment) if scene is not None else ("", "")
        return {"task": task, "environment": environment, "robot": self._system.robot}

    def _give(self, task: str) -> str:
        """Begin to give a task; why not, empty = begun."""
        if not self._options.takes_tasks:
            return CLOSED
        if not self._giving.acquire(blocking=False):
            return BUSY
        self._loop.call_soon_threadsafe(self._start, task)
        return ""

    def _start(self, task: str) -> None:
        job = asyncio.create_task(self._switch(task))
        self._jobs.add(job)
        job.add_done_callback(self._jobs.discard)

    async def _switch(self, task: str) -> None:
        self._say(f"asked by ROS for the task {task!r}")
        self._put(TASK_STATE, self._teller.task_state(_state(task, "asked for")))
        try:
            given = await self._system.give_task(self._system.robot, task, "", (), TASK_WAIT_S)
            state = _state(task, "given" if given.scene is None else "in force", given.note)
        except PriorSgError as error:
            state = _state(task, "refused", str(error))
        finally:
            self._giving.release()
        self._put(TASK_STATE, self._teller.task_state(state))
        self._say(": ".join(filter(None, (f"the task {task!r} is {state['state']}", state["note"]))))


def _tag(scene: Scene | None) -> tuple[int, int] | None:
    """Another one whenever the scene is another."""
    return None if scene is None else (scene.revision, scene.stamp_ns)


def _state(task: str, state: str, note: str = "") -> dict[str, str]:
    return {"task": task, "state": state, "note": note}


async def _until_end(bridge: Bridge, parent: int) -> None:
    """Run until a signal, or until the parent process is gone."""
    stop = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    ends: tuple[Coroutine[Any, Any, Any], ...] = (bridge.run(), stop.wait(), parent_gone(parent))
    jobs = [asyncio.create_task(job) for job in ends]
    done, others = await asyncio.wait(jobs, return_when=asyncio.FIRST_COMPLETED)
    for job in others:
        job.cancel()
    await asyncio.wait(jobs)
    for job in done:
        job.result()

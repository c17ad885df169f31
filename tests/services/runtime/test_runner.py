"""One service without a bus, and several joined by what they declare."""

from dataclasses import dataclass, field

import msgspec
import numpy as np
import pytest

from prior_sg.schemas.codec import DecodeError, Message
from prior_sg.schemas.frames import Intrinsics, Keyframe
from prior_sg.schemas.places import SnapshotRequest
from prior_sg.schemas.priors import Recall, Recalled, Task, TaskInForce, TaskRequest
from prior_sg.schemas.status import JobDone, Tick
from prior_sg.schemas.topics import ENCODE, KEYFRAME, PLACE_SNAPSHOT, TASK, TASK_IN_FORCE
from prior_sg.services.runtime.runner import Pipeline, Runner
from prior_sg.services.runtime.service import Ask, Errand, Identity, Service, UndeclaredError

LOOK_UP = Errand("LOOK_UP", Recall, Recalled, lambda cfg, identity: None)


class Config(msgspec.Struct, frozen=True):
    group: str = ""


@dataclass
class State:
    identity: Identity
    got: list = field(default_factory=list)
    closed: bool = False


def init(cfg, identity):
    return State(identity)


def remember(state, message, cfg):
    state.got.append(message)
    return iter(())


def close(state):
    state.closed = True


def made(name="reader", step=remember, **fields):
    return Service(name, "", "robot", Config, init, step, close=close, **fields)


def task(text="tidy up", robot="robot1"):
    return Task(robot=robot, stamp_ns=1, environment="home", task=text)


def keyframe(number, robot="robot1", space=""):
    return Keyframe(
        robot=robot,
        frame_id=number,
        stamp_ns=number,
        intrinsics=Intrinsics(4, 4, 1.0, 1.0, 2.0, 2.0),
        world_from_camera=np.eye(4),
        color=b"",
        depth=b"",
        depth_scale_m=0.001,
        space=space,
    )


def asks_on_tick(state, message, cfg):
    """On a tick: a question, a task, the same question again; on a reply: what it says."""
    state.got.append(message)
    if isinstance(message, Tick):
        yield Ask(TASK_IN_FORCE, TaskRequest(robot="robot1"))
        yield TASK, task("before the reply")
        yield Ask(TASK_IN_FORCE, TaskRequest(robot="robot1"))
    if isinstance(message, TaskInForce) and message.task is not None:
        yield TASK, message.task


ASKER = made("asker", asks_on_tick, writes=(TASK,), asks=(TASK_IN_FORCE,))
TICK = Tick(stamp_ns=5)


def in_force(request):
    return TaskInForce(robot=request.robot, task=task("the reply"))


def test_outputs_of_a_step_come_before_those_of_the_replies_to_it():
    runner = Runner(ASKER, answers={TASK_IN_FORCE: in_force})
    texts = [(topic, message.task) for topic, message in runner.feed(TICK)]
    assert texts == [(TASK, "before the reply"), (TASK, "the reply"), (TASK, "the reply")]
    assert runner.asks == [] and [type(message).__name__ for message in runner.state.got] == [
        "Tick",
        "TaskInForce",
        "TaskInForce",
    ]


@pytest.mark.parametrize("answers", [{}, {TASK_IN_FORCE: lambda request: None}])
def test_a_question_that_nobody_answers_is_kept_once(answers):
    runner = Runner(ASKER, answers=answers)
    runner.feed(TICK, TICK)
    assert runner.asks == [Ask(TASK_IN_FORCE, TaskRequest(robot="robot1"))]
    runner.asks.clear()
    runner.feed(TICK)
    assert len(runner.asks) == 1


def test_another_runner_answers_and_an_errand_is_run():
    def step(state, message, cfg):
        state.got.append(message)
        if isinstance(message, Tick):
            yield Ask(LOOK_UP, Recall(question="q", environment="e", task="t"))
            yield Ask(TASK_IN_FORCE, TaskRequest(robot="robot1"))

    store = Runner(made("store", answers={TASK_IN_FORCE: lambda state, request, cfg: in_force(request)}))
    service = made(step=step, asks=(TASK_IN_FORCE,), errands=(LOOK_UP,))
    runner = Runner(service, answers={TASK_IN_FORCE: store, LOOK_UP: lambda ask: Recalled(question=ask.question)})
    runner.feed(TICK)
    assert runner.state.got[1:] == [Recalled(question="q"), in_force(TaskRequest(robot="robot1"))]


def test_what_is_not_declared_is_a_fault():
    def writes(state, message, cfg):
        yield TASK, task()

    def asks(state, message, cfg):
        yield Ask(PLACE_SNAPSHOT, SnapshotRequest(robot="r"))

    for step in (writes, asks):
        with pytest.raises(UndeclaredError, match=r"reader .*which it does not declare"):
            Runner(made(step=step)).feed(TICK)


def test_over_the_wire_messages_are_checked_and_share_no_memory():
    class Writer:
        pose = np.eye(4)

    def step(state, message, cfg):
        state.got.append(message)
        yield KEYFRAME, msgspec.structs.replace(keyframe(1), world_from_camera=Writer.pose)

    service = made(step=step, writes=(KEYFRAME,))
    sent = keyframe(7)
    (_, plain), (_, wired) = Runner(service).feed(sent) + Runner(service, wire=True).feed(sent)
    assert plain.world_from_camera is Writer.pose
    assert not np.shares_memory(wired.world_from_camera, Writer.pose) and not wired.world_from_camera.flags.writeable
    runner = Runner(service, wire=True)
    with pytest.raises(DecodeError):
        runner.feed(msgspec.structs.replace(sent, stamp_ns="now"))
    assert runner.state.got == []


def test_identity_and_end():
    with Runner(made()) as runner:
        assert runner.identity == Identity("robot1", "reader", 1) and runner.cfg == Config()
    assert runner.state.closed
    again = Runner(made(), Config(group="g"), state=runner.state)
    assert again.state is runner.state and again.cfg.group == "g"


def test_a_pipeline_follows_the_declarations():
    def work(state, message, cfg):
        if isinstance(message, Keyframe):
            yield TASK, task(f"{state.identity.instance} did {message.frame_id}", message.robot)

    def drive(state, message, cfg):
        state.got.append(message)
        if isinstance(message, Keyframe):
            yield ENCODE, message

    source = Runner(made("source", drive, writes=(ENCODE,)))
    workers = [
        Runner(
            made("worker", work, writes=(TASK,), job=ENCODE, job_group=lambda cfg: cfg.group),
            Config(group),
            Identity("robot1", name, 1),
        )
        for name, group in (("a", "small"), ("b", "small"), ("c", "large"))
    ]
    mine, other = Runner(made(reads=(TASK,))), Runner(made(reads=(TASK,)), identity=Identity("robot2", "o", 1))
    pipeline = Pipeline((source, *workers, mine, other))
    told = pipeline.feed(source, keyframe(3))
    assert [topic.name for topic, _ in told] == ["ENCODE", "TASK", "TASK"]
    assert [message.task for message in mine.state.got] == ["a did 3", "c did 3"]
    assert other.state.got == []
    assert source.state.got[1:] == [JobDone(topic="ENCODE", frame_id=3, worker="a", attempts=1)]
    pipeline.feed(source, keyframe(4, space="large"))
    assert [message.task for message in mine.state.got[2:]] == ["c did 4"]
    pipeline.publish(TASK, task("from outside", "robot2"))
    assert [message.task for message in other.state.got] == ["from outside"]


def test_a_pipeline_answers_by_key_and_keeps_answers_that_are_there():
    def says(text):
        def answer(state, request: Message, cfg):
            return TaskInForce(robot="robot1", task=task(text))

        return made("store", answers={TASK_IN_FORCE: answer})

    stores = [Runner(says("another's"), identity=Identity("robot2", "s", 1)), Runner(says("mine"))]
    asker = Runner(ASKER)
    pipeline = Pipeline((asker, *stores))
    assert [message.task for _, message in pipeline.feed(asker, TICK)][1:] == ["mine", "mine"]
    special = Runner(ASKER, answers={TASK_IN_FORCE: in_force})
    assert [message.task for _, message in Pipeline((special, *stores)).feed(special, TICK)][1:] == ["the reply"] * 2
    alone = Runner(ASKER)
    Pipeline((alone, stores[0])).feed(alone, TICK)
    assert len(alone.asks) == 1

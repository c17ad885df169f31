"""What a prompted detector is to look for: the objects of the prior that answers the task of a keyframe's robot (pure).

One worker serves robots with different tasks. It hears every task and every prior of the fleet; what it has missed, for
it joined later, it asks for when the robot's first keyframe comes.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field

from schemas.codec import Message
from schemas.priors import Prior, PriorList, PriorRequest, Task, TaskInForce, TaskRequest

REMEMBERED = 32  # priors, the newest


@dataclass
class Vocabulary:
    """Tasks by robot, and the priors that may answer them, the newest last, by digest."""

    tasks: dict[str, Task | None] = field(default_factory=dict)  # None = asked for, no reply yet
    priors: dict[str, Prior] = field(default_factory=dict)
    asked: set[tuple[str, str, tuple[str, ...]]] = field(default_factory=set)  # environment, task and regions


def hear(vocabulary: Vocabulary, message: Message) -> None:
    """Take a task or a prior; an older task changes nothing."""
    match message:
        case Task():
            known = vocabulary.tasks.get(message.robot)
            if known is None or message.stamp_ns >= known.stamp_ns:
                vocabulary.tasks[message.robot] = message
        case TaskInForce():
            if message.task is not None:
                hear(vocabulary, message.task)
        case Prior():
            digest = message.digest()
            vocabulary.priors.pop(digest, None)
            vocabulary.priors[digest] = message
            for old in list(vocabulary.priors)[:-REMEMBERED]:
                del vocabulary.priors[old]
        case PriorList():
            for prior in reversed(message.priors):
                hear(vocabulary, prior)


def questions(vocabulary: Vocabulary, robot: str) -> Iterator[TaskRequest | PriorRequest]:
    """What has to be asked to know the objects for a robot, each question once."""
    if robot not in vocabulary.tasks:
        vocabulary.tasks[robot] = None
        yield TaskRequest(robot=robot)
    task = vocabulary.tasks[robot]
    if task is None or _prior(vocabulary, task) is not None:
        return
    asked = (task.environment, task.task, tuple(task.regions))
    if asked not in vocabulary.asked:
        vocabulary.asked.add(asked)
        yield PriorRequest(environment=task.environment, task=task.task, regions=task.regions)


def objects(vocabulary: Vocabulary, robot: str) -> tuple[str, ...]:
    """Names of the objects to look for in a robot's keyframes; none before its task and a prior for it are known."""
    task = vocabulary.tasks.get(robot)
    prior = None if task is None else _prior(vocabulary, task)
    return () if prior is None else tuple(item.name for item in prior.objects)


def _prior(vocabulary: Vocabulary, task: Task) -> Prior | None:
    answers = [prior for prior in vocabulary.priors.values() if prior.answers(task)]
    return answers[-1] if answers else None

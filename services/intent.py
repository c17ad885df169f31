"""What a prompted detector is to look for: the objects of the prior that answers the task of a keyframe's robot (pure).

One worker serves robots with different tasks. It hears every task and every prior of the fleet; what it has missed, for
it joined later, it asks for when the robot's first keyframe comes.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field

from prior_sg.schemas.codec import Message
from prior_sg.schemas.priors import Prior, PriorList, PriorRequest, Task, TaskInForce, TaskRequest

REMEMBERED = 32  # priors, the newest


@dataclass
class Vocabulary:
    """Tasks by robot, and the priors that may answer them, the newest last, by digest."""

    tasks: dict[str, Task | None] = field(default_factory=dict)  # None = asked for, no reply yet
    priors: dict[str, Prior] = field(default_factory=dict)


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
            _forget(vocabulary)
        case PriorList():
            for prior in reversed(message.priors):
                hear(vocabulary, prior)


def questions(vocabulary: Vocabulary, robot: str) -> Iterator[TaskRequest | PriorRequest]:
    """What is to be asked to know the objects for a robot: its task once, a prior for it as long as none is known."""
    if robot not in vocabulary.tasks:
        vocabulary.tasks[robot] = None
        yield TaskRequest(robot=robot)
    task = vocabulary.tasks[robot]
    if task is not None and _prior(vocabulary, task) is None:
        yield PriorRequest(environment=task.environment, task=task.task, regions=task.regions)


def objects(vocabulary: Vocabulary, robot: str) -> tuple[str, ...]:
    """Names of the objects to look for in a robot's keyframes; none before its task and a prior for it are known."""
    task = vocabulary.tasks.get(robot)
    prior = None if task is None else _prior(vocabulary, task)
    return () if prior is None else tuple(item.name for item in prior.objects)


def _forget(vocabulary: Vocabulary) -> None:
    """Of too many priors, those go first that answer nobody's task, and of these the oldest."""
    tasks = [task for task in vocabulary.tasks.values() if task is not None]
    in_use = {digest for digest, prior in vocabulary.priors.items() if any(map(prior.answers, tasks))}
    too_many = max(len(vocabulary.priors) - REMEMBERED, 0)
    for old in sorted(vocabulary.priors, key=lambda digest: digest in in_use)[:too_many]:
        del vocabulary.priors[old]


def _prior(vocabulary: Vocabulary, task: Task) -> Prior | None:
    answers = [prior for prior in vocabulary.priors.values() if prior.answers(task)]
    return answers[-1] if answers else None

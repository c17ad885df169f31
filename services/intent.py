"""What a robot is meant to do: the task in force, and the prior that answers it (pure).

The newest task counts, whatever order tasks arrive in; of the priors that answer it, the one heard latest. A prior may
arrive before its task, and one process may serve robots with different tasks, so priors are remembered: of too many,
those go first that answer nobody's task, and of these the oldest. What was missed, for one joined later, is asked for.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field

from prior_sg.schemas.codec import Message, copied
from prior_sg.schemas.priors import Prior, PriorList, PriorRequest, Task, TaskInForce, TaskRequest

REMEMBERED = 32  # priors, the newest


@dataclass
class Intent:
    """Tasks by robot, and the priors that may answer them, the newest last, by digest."""

    remembered: int = REMEMBERED
    tasks: dict[str, Task | None] = field(default_factory=dict)  # None = asked for, no reply yet
    priors: dict[str, Prior] = field(default_factory=dict)


def hear(intent: Intent, message: Message) -> bool:
    """Take a task or a prior; True when a task came into force. An older task changes nothing."""
    match message:
        case Task():
            known = intent.tasks.get(message.robot)
            if known is not None and message.stamp_ns < known.stamp_ns:
                return False
            intent.tasks[message.robot] = message
            return True
        case TaskInForce():
            return message.task is not None and hear(intent, message.task)
        case Prior():
            digest = message.digest()
            intent.priors.pop(digest, None)
            intent.priors[digest] = copied(message)
            _forget(intent)
        case PriorList():
            for prior in reversed(message.priors):
                hear(intent, prior)
    return False


def questions(intent: Intent, robot: str) -> Iterator[TaskRequest | PriorRequest]:
    """What is to be asked for a robot: its task once, a prior for it as long as none is known."""
    if robot not in intent.tasks:
        intent.tasks[robot] = None
        yield TaskRequest(robot=robot)
    yield from prior_question(intent, robot)


def prior_question(intent: Intent, robot: str) -> Iterator[PriorRequest]:
    """The question for a prior that answers the robot's task, as long as none is known."""
    task = intent.tasks.get(robot)
    if task is not None and prior_in_force(intent, robot) is None:
        yield PriorRequest(environment=task.environment, task=task.task, regions=task.regions)


def prior_in_force(intent: Intent, robot: str) -> tuple[str, Prior] | None:
    """The latest prior that answers the robot's task, with its digest; None before both are known."""
    task = intent.tasks.get(robot)
    if task is None:
        return None
    answers = [(digest, prior) for digest, prior in intent.priors.items() if prior.answers(task)]
    return answers[-1] if answers else None


def objects(intent: Intent, robot: str) -> tuple[str, ...]:
    """Names of the objects of the robot's prior; none before its task and a prior for it are known."""
    found = prior_in_force(intent, robot)
    return () if found is None else tuple(item.name for item in found[1].objects)


def _forget(intent: Intent) -> None:
    """Of too many priors, those go first that answer nobody's task, and of these the oldest."""
    tasks = [task for task in intent.tasks.values() if task is not None]
    in_use = {digest for digest, prior in intent.priors.items() if any(map(prior.answers, tasks))}
    too_many = max(len(intent.priors) - intent.remembered, 0)
    for old in sorted(intent.priors, key=lambda digest: digest in in_use)[:too_many]:
        del intent.priors[old]

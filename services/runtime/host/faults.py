"""Why an input is not let in, beyond what its type and its key tell."""

import time

from prior_sg.schemas.codec import Message
from prior_sg.schemas.priors import Task, TaskInForce
from prior_sg.schemas.topics import DELTAS, topic_of
from prior_sg.services.refusals import fault_of_stamp
from prior_sg.services.runtime.host.lease import Fence


def fault_of_reply(request: Message, reply: Message) -> str:
    """Why this is no answer to the request: it speaks of another robot."""
    asked, told = (getattr(message, "robot", None) for message in (request, reply))
    return "" if None in (asked, told) or asked == told else f"asked about {asked!r}, told about {told!r}"


def fault_of_clock(message: Message) -> str:
    """Why a task cannot be as new as it says. Looked at here, where there is a clock: what is refused is no input."""
    task = message.task if isinstance(message, TaskInForce) else message
    return fault_of_stamp("the task", task.stamp_ns, time.time_ns()) if isinstance(task, Task) else ""


def fault_of_writer(fence: Fence | None, message: Message) -> str:
    """Why a delta is not let in: another than its writer is in charge."""
    topic = topic_of(type(message))
    if fence is None or topic is None or topic not in DELTAS:
        return ""
    return fence.fault_of(topic.name, message.robot, message.epoch)  # type: ignore[attr-defined]

"""Messages of a live robot, as bytes, for what puts frames together."""

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

from prior_sg.services.ingest.core.clouds.sweep import CloudError, Sweep, sweep_of
from prior_sg.services.ingest.core.options import ReadOptions
from prior_sg.services.ingest.core.ros.assembly import Assembly, Shot
from prior_sg.services.ingest.core.ros.clouds import LIVOX_DEFINITIONS, columns_of_message
from prior_sg.services.ingest.core.ros.motions import Fault, Motions
from prior_sg.services.ingest.core.ros.topics import POSES, TF_TYPES, Chosen, Topic
from prior_sg.services.ingest.core.ros.transforms import Stamped, transforms_of, written_stamp_ns
from prior_sg.services.ingest.sources.base import FrameError
from prior_sg.services.runtime.ros.session import Received
from prior_sg.services.runtime.ros.types import Types
from prior_sg.services.runtime.ros.wire import WireError


@cache
def robot_types() -> Types:
    """The definitions of ROS 2, and those of drivers that bring their own. Raises ExtraMissing."""
    types = Types()
    for name, text in LIVOX_DEFINITIONS.items():
        types.add_message(name, text)
    return types


@dataclass(frozen=True)
class Reader:
    """Reads messages as they came, by the clock that was asked for."""

    types: Types
    options: ReadOptions
    topics: dict[str, Topic]

    def shot(self, message: Received) -> Shot:
        """An image or a cloud. Raises WireError where it has no header."""
        stamp_ns = _written_ns(message.payload)
        received = self.options.clock == "received"
        return Shot(message.received_ns if received else stamp_ns, message.received_ns, message.payload)

    def moves(self, topic: Topic) -> bool:
        """Whether a topic has transforms or poses."""
        return topic.type in TF_TYPES or topic.taken_for == POSES

    def motions(self, message: Received) -> list[Stamped]:
        """Transforms or poses of a message. Raises WireError."""
        found = list(transforms_of(self.types.decode(message.payload, self.topics[message.topic].type)))
        if self.options.clock == "received":
            return [replace(one, stamp_ns=message.received_ns) for one in found]
        return found

    def hand_over(self, message: Received, choice: Chosen, assembly: Assembly) -> Fault | None:
        """Give a message to where frames of a camera are put together; what is wrong with it."""
        try:
            if message.topic == choice.color.name:
                (assembly.cloud if choice.alone else assembly.color)(self.shot(message))
            elif message.topic == choice.depth.name:
                assembly.depth(self.shot(message))
        except WireError as error:
            return Fault(f"messages of {message.topic}", str(error))
        return None

    def move(self, message: Received, motions: Motions) -> Fault | None:
        """Give a message, where it has transforms or poses, to where these are; what is wrong with it."""
        if not self.moves(topic := self.topics[message.topic]):
            return None
        try:
            motions.take(topic, self.motions(message))
        except WireError as error:
            return Fault(f"messages of {message.topic}", str(error))
        return None

    def message(self, shot: Shot, topic: Topic) -> Any:
        """The decoded image. Raises FrameError."""
        try:
            return self.types.decode(shot.data, topic.type)
        except WireError as error:
            raise FrameError(f"an image of {topic.name} cannot be read: {error}") from error

    def sweep(self, shot: Shot, topic: Topic) -> Sweep:
        """The decoded cloud. Raises FrameError."""
        try:
            message = self.types.decode(shot.data, topic.type)
            return sweep_of(columns_of_message(message), _written_ns(shot.data))
        except (WireError, CloudError) as error:
            raise FrameError(f"a cloud of {topic.name} cannot be used: {error}") from error


def _written_ns(data: bytes) -> int:
    """The stamp in a header. Raises WireError."""
    try:
        return written_stamp_ns(data)
    except ValueError as error:
        raise WireError(str(error)) from error

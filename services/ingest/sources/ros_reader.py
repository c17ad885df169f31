"""Messages of a live robot, as bytes, for what puts frames together."""

from dataclasses import dataclass, replace
from typing import Any

from prior_sg.services.ingest.core.options import ReadOptions
from prior_sg.services.ingest.core.ros.assembly import Assembly, Fault, Posed, Shot
from prior_sg.services.ingest.core.ros.topics import POSES, TF_TYPES, Chosen, Topic
from prior_sg.services.ingest.core.ros.transforms import Stamped, transforms_of, written_stamp_ns
from prior_sg.services.ingest.sources.base import FrameError, Images
from prior_sg.services.ingest.sources.ros_pictures import Pictures
from prior_sg.services.runtime.ros.session import Received
from prior_sg.services.runtime.ros.types import Types
from prior_sg.services.runtime.ros.wire import WireError


@dataclass(frozen=True)
class Reader:
    """Reads messages as they came, by the clock that was asked for."""

    types: Types
    options: ReadOptions
    topics: dict[str, Topic]

    def shot(self, message: Received) -> Shot:
        """An image. Raises WireError where it has no header."""
        try:
            stamp_ns = written_stamp_ns(message.payload)
        except ValueError as error:
            raise WireError(str(error)) from error
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
        """Give a message to where frames are put together; what is wrong with it."""
        try:
            if message.topic == choice.color.name:
                assembly.color(self.shot(message))
            elif message.topic == choice.depth.name:
                assembly.depth(self.shot(message))
            elif self.moves(topic := self.topics[message.topic]):
                assembly.motion(topic, self.motions(message))
        except WireError as error:
            return Fault(f"messages of {message.topic}", str(error))
        return None

    def images(self, posed: Posed, choice: Chosen, images: Pictures) -> Images:
        """The decoded pictures of a frame. Raises FrameError and ImageError."""
        return images(self._image(posed.color, choice.color), self._image(posed.depth, choice.depth))

    def _image(self, shot: Shot, topic: Topic) -> Any:
        try:
            return self.types.decode(shot.data, topic.type)
        except WireError as error:
            raise FrameError(f"an image of {topic.name} cannot be read: {error}") from error

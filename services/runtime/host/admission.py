"""What of the bus becomes an input: said on its key, by the writer in charge, at a time that can be, once, signed."""

from prior_sg.schemas.codec import Message
from prior_sg.services.runtime.bus import Sample
from prior_sg.services.runtime.host.asks import Reply
from prior_sg.services.runtime.host.door import Door
from prior_sg.services.runtime.host.faults import fault_of_clock, fault_of_reply, fault_of_writer
from prior_sg.services.runtime.host.lease import Fence
from prior_sg.services.runtime.host.replays import Replays
from prior_sg.services.runtime.signatures import Unsigned


class Admission:
    """Of one service, by its door. What comes from writers that are not in charge stays outside the `fence`."""

    def __init__(self, door: Door, fence: Fence | None, signatures: Unsigned) -> None:
        self._door, self._fence, self._signatures = door, fence, signatures
        self._replays = Replays()

    def of_sample(self, sample: Sample) -> Message | None:
        """The message of a sample; None where it is not let in, which is counted and logged."""
        topic, key = sample.topic, sample.key
        return self._door.admitted(
            topic.type,
            sample.payload,
            name=topic.name,
            key=key,
            fault_of=lambda message: (
                topic.fault_of(key, message)
                or fault_of_writer(self._fence, message)
                or fault_of_clock(message)
                or self._replays.fault_of(sample, message)
                or self._signatures.fault_of(message)
            ),
            writer=sample.writer,
        )

    def of_reply(self, reply: Reply) -> Message | None:
        """The message of an answer to one of our questions; None likewise."""
        query = reply.ask.query
        return self._door.admitted(
            query.reply,
            reply.payload,
            name=query.name,
            key=query.key,
            fault_of=lambda told: (
                fault_of_reply(reply.ask.request, told)
                or fault_of_writer(self._fence, told)
                or fault_of_clock(told)
                or self._signatures.fault_of(told)
            ),
        )

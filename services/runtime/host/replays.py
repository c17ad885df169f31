"""Old messages that are sent again as if they were new.

A repeat with its own number is ordinary, for delivery is at least once: it is dropped before it is decoded. What rises
from one message of a writer to the next cannot fall while their numbers rise: then somebody else sends what was said.
No window is needed for links that lose or reorder: the bus holds what comes early until what it lacks has come again,
and hands on each writer's samples in their order.
"""

from collections import OrderedDict

from prior_sg.schemas.codec import Message
from prior_sg.services.runtime.bus import Sample

MOST_WRITERS = 4096  # whose newest message is known, by key


class Replays:
    """What each writer has said last; used by one thread."""

    def __init__(self) -> None:
        self._newest: OrderedDict[tuple[str, str], tuple[int, ...]] = OrderedDict()

    def fault_of(self, sample: Sample, message: Message) -> str:
        """Why a message is one of before, as a sentence; empty when it is not, and from now on it is the newest."""
        fields = sample.topic.rises
        if not fields or not sample.writer:
            return ""
        place, said = (sample.writer, sample.key), tuple(getattr(message, field) for field in fields)
        newest = self._newest.get(place)
        if newest is not None and said <= newest:
            return f"a replay: {', '.join(fields)} of this writer have come to {newest}, and it says {said} once more"
        self._newest[place] = said
        self._newest.move_to_end(place)
        if len(self._newest) > MOST_WRITERS:
            self._newest.popitem(last=False)
        return ""

"""A look at a running robot: who publishes what, and what the first messages say."""

import time
from collections import deque
from dataclasses import dataclass, field
from typing import Any

from prior_sg.services.ingest.core.ros.images import encoding_of, shown_by
from prior_sg.services.ingest.core.ros.motions import Fault
from prior_sg.services.ingest.core.ros.topics import CAMERA_INFO, CLOUDS, COMPRESSED, IMAGE, READ_TYPES, Topic
from prior_sg.services.ingest.core.ros.transforms import frame_name
from prior_sg.services.ingest.sources.ros.feed import Feed, Tally
from prior_sg.services.runtime.ros import wire
from prior_sg.services.runtime.ros.session import Received, RosSession
from prior_sg.services.runtime.ros.types import Types
from prior_sg.services.runtime.ros.wire import WireError

MOST_TOPICS = 500
HEAVY_TYPES = (IMAGE, COMPRESSED, *CLOUDS)
CAMERA_TYPES = (CAMERA_INFO, *HEAVY_TYPES)
MOMENT_S = 0.1
IMAGES_KEPT, OTHERS_KEPT = 8, 4000
SETTLED_S = 1.5  # after the first publisher was seen, all that publishes steadily has been heard
PATIENCE_S = 4.0  # for images that are announced and do not come
SEARCH_S = 0.5  # between two looks at who is there


@dataclass
class Heard:
    """What is known of a topic."""

    type: str
    count: int = 0
    first_ns: int = 0
    newest_ns: int = 0
    kept: deque[Received] = field(default_factory=deque)
    encoding: str = ""
    frame: str = ""
    shows: str = ""
    message: Any = None  # the first one of a camera info

    def topic(self, name: str) -> Topic:
        """As the choice of topics takes it."""
        span_s = (self.newest_ns - self.first_ns) / 1e9
        rate_hz = (self.count - 1) / span_s if self.count > 1 and span_s > 0 else 0.0
        return Topic(name, self.type, self.count, rate_hz, self.encoding, self.frame, self.shows)


class Look:
    """Listens to all topics that could serve, and remembers their newest messages."""

    def __init__(self, session: RosSession, types: Types) -> None:
        self.heard: dict[str, Heard] = {}
        self.tally = Tally()
        self._session, self._types = session, types
        self._feed = Feed()
        self._searched_s = self._found_s = 0.0

    def listen(self, seconds: float) -> None:
        """Hear what comes for a moment."""
        now_s = time.monotonic()
        if now_s - self._searched_s >= SEARCH_S:
            self._searched_s = now_s
            self._search()
        messages, faults = self._feed.take(seconds)
        for fault in faults:
            self.tally.add(fault)
        for message in messages:
            self._hear(message)

    @property
    def settled(self) -> bool:
        """Whether all who are there have been heard, as far as one can tell."""
        waited_s = time.monotonic() - self._found_s if self._found_s else 0.0
        silent = any(heard.type in CAMERA_TYPES and not heard.count for heard in self.heard.values())
        return waited_s >= (PATIENCE_S if silent else SETTLED_S)

    def topics(self) -> list[Topic]:
        """Those heard or announced, by name."""
        return [heard.topic(name) for name, heard in sorted(self.heard.items())]

    def infos(self) -> dict[str, Any]:
        """The first camera info of each topic."""
        return {name: heard.message for name, heard in self.heard.items() if heard.message is not None}

    def messages(self) -> list[Received]:
        """Those that are kept, by arrival."""
        kept = [message for heard in self.heard.values() for message in heard.kept]
        return sorted(kept, key=lambda message: message.received_ns)

    def _search(self) -> None:
        for entity in self._session.entities():
            channel = entity.channel
            if entity.kind != wire.PUBLISHER or channel is None or channel.name in self.heard:
                continue
            if channel.type not in READ_TYPES or not self._types.knows(channel.type) or len(self.heard) >= MOST_TOPICS:
                continue
            most = IMAGES_KEPT if channel.type in HEAVY_TYPES else OTHERS_KEPT
            self.heard[channel.name] = Heard(channel.type, kept=deque(maxlen=most))
            self._feed.open(self._session, Topic(channel.name, channel.type, 0, 0.0), self._types)
            self._found_s = self._found_s or time.monotonic()

    def _hear(self, message: Received) -> None:
        heard = self.heard[message.topic]
        if heard.type in CAMERA_TYPES and not heard.frame:
            try:
                self._look_at(heard, self._types.decode(message.payload, heard.type))
            except WireError as error:
                self.tally.add(Fault(f"messages of {message.topic}", str(error)))
                return
        heard.count += 1
        heard.first_ns = heard.first_ns or message.received_ns
        heard.newest_ns = message.received_ns
        heard.kept.append(message)

    def _look_at(self, heard: Heard, message: Any) -> None:
        heard.frame = frame_name(message.header.frame_id)
        if heard.type == CAMERA_INFO:
            heard.message = message
        elif heard.type not in CLOUDS:
            heard.encoding, heard.shows = encoding_of(message), shown_by(message)

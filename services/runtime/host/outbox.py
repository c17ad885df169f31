"""What a process writes: samples with its name and their number, and the journal of the inputs it has finished with."""

import time
from typing import Any

from prior_sg.schemas.codec import Message, encode
from prior_sg.schemas.status import Consumed
from prior_sg.schemas.topics import JOURNAL, Topic
from prior_sg.services.runtime.bus import Bus, pack_header
from prior_sg.services.runtime.host.flow import Progress
from prior_sg.services.runtime.service import Identity


class Outbox:
    """Used by one thread only."""

    def __init__(self, service: str, identity: Identity, bus: Bus, progress: Progress) -> None:
        self.writer = f"{service}/{identity.instance}/{identity.epoch}"
        self._service, self._identity, self._bus, self._progress = service, identity, bus, progress
        self._sequences: dict[str, int] = {}  # next one, by key
        self._order = 0
        self.written = 0  # messages other than journal entries

    def put(self, topic: Topic, message: Message) -> None:
        """Publish one message."""
        key = topic.key_of(message)
        sequence = self._sequences.get(key, 0)
        self._sequences[key] = sequence + 1
        if topic is not JOURNAL:
            self.written += 1
            self._progress.published(topic.name, sequence)
        self._bus.put(topic, key, encode(message), pack_header(self.writer, sequence, time.time_ns()))

    def journal(self, topic: str, **fields: Any) -> None:
        """One more input is finished with; `fields` are those of `Consumed` that say which."""
        entry = Consumed(
            robot=self._identity.whose,
            service=self._service,
            instance=self._identity.instance,
            order=self._order,
            topic=topic,
            **fields,
        )
        self._order += 1
        self.put(JOURNAL, entry)

"""Records every recorded topic of all robots into one log, and knows how far its readers are."""

import math
import queue
import threading
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from prior_sg.schemas.codec import DecodeError, Message
from prior_sg.schemas.status import Consumed
from prior_sg.schemas.topics import TOPICS, Topic
from prior_sg.services.registry import SERVICES
from prior_sg.services.runtime.bus import Sample, message_in
from prior_sg.services.runtime.client import BusClient
from prior_sg.services.runtime.record import LogError, LogWriter

FLUSH_S = 1.0
REST_S = 1.5  # without inputs, until the segmenter rests, adapts to the whole map, and settles
TICKS_AFTER = {service.name: math.ceil(REST_S / service.tick_s) for service in SERVICES if service.tick_s is not None}
Tap = Callable[[Sample, Message], None]


class Recorder:
    """Subscribes at once; writes on its own thread until `close`. `taps` see every valid message on that thread."""

    def __init__(self, client: BusClient, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._log = LogWriter(path)
        self.taps: list[Tap] = []
        self.counts: Counter[str] = Counter()
        self.malformed: Counter[str] = Counter()
        self.attachments: dict[str, tuple[str, bytes]] = {}  # name: media type and content, written at the end
        self.error: LogError | None = None
        self._queue: queue.SimpleQueue[Sample | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._write, name="recorder", daemon=True)
        self._thread.start()
        for topic in TOPICS:
            if topic.recorded:
                client.listen(topic, "*", self._queue.put)

    def close(self) -> None:
        """Write what has arrived, then finish the file. Raises LogError when something could not be written."""
        self._queue.put(None)
        self._thread.join()
        self.check()
        for name, (media_type, data) in self.attachments.items():
            self._log.attach(name, media_type, data)
        self._log.close()

    def check(self) -> None:
        """Raise LogError when writing has failed."""
        if self.error is not None:
            raise self.error

    def _write(self) -> None:
        """Until the end, or until the log cannot be written (a full disk); the taps go on seeing what arrives."""
        while True:
            try:
                sample = self._next()
                if sample is None:
                    return
                self._add(sample)
            except LogError as error:
                self.error = self.error or error

    def _next(self) -> Sample | None:
        while True:
            try:
                return self._queue.get(timeout=FLUSH_S)
            except queue.Empty:
                if self.error is None:
                    self._log.flush()

    def _add(self, sample: Sample) -> None:
        """Record what is valid; what is not never reached any service's state either."""
        try:
            message = message_in(sample)
        except DecodeError:
            self.malformed[sample.topic.name] += 1
            return
        self.counts[sample.topic.name] += 1
        for tap in self.taps:
            tap(sample, message)
        if sample.writer and self.error is None:
            self._log.add(
                sample.topic, sample.key, sample.payload, sample.writer, sample.sequence, sample.sent_ns, time.time_ns()
            )


class Settling:
    """A tap: whether every reader has finished with everything published on the topics a run consists of."""

    def __init__(self, topics: tuple[Topic, ...]) -> None:
        self._topics = {topic.name for topic in topics}
        self._readers = [
            (service.name, topic.name) for service in SERVICES for topic in service.reads if topic.name in self._topics
        ]
        self._published: dict[tuple[str, str, str], int] = {}  # newest by topic, key, writer
        self._consumed: dict[tuple[str, str, str], int] = {}  # newest by service, key, writer
        self._due: dict[str, int] = {}  # of services that work on their ticks: how many have yet to follow an input
        self.changed_s = time.monotonic()

    def __call__(self, sample: Sample, message: Message) -> None:
        """See one recorded message."""
        match message:
            case Consumed(topic="Tick"):
                self._due[message.service] = max(self._due.get(message.service, 0) - 1, 0)
            case Consumed() if message.writer:
                self._due[message.service] = TICKS_AFTER.get(message.service, 0)
                name = (message.service, message.key, message.writer)
                self._consumed[name] = max(message.sequence, self._consumed.get(name, -1))
            case _ if sample.topic.name in self._topics and sample.writer:
                self._published[sample.topic.name, sample.key, sample.writer] = sample.sequence
                self.changed_s = time.monotonic()

    def settled(self, quiet_s: float) -> bool:
        """Nothing waits anywhere, and nothing new has been published for a while."""
        behind = any(
            self._consumed.get((service, key, writer), -1) < newest
            for (topic, key, writer), newest in list(self._published.items())
            for service, read in self._readers
            if read == topic
        )
        return not behind and not any(self._due.values()) and time.monotonic() - self.changed_s > quiet_s

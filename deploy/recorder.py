"""Records every recorded topic of all robots into one log, and knows how far its readers are."""

import queue
import threading
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from deploy.client import Client
from schemas.codec import DecodeError, Message, decode
from schemas.status import Consumed
from schemas.topics import TOPICS, Topic
from services.registry import SERVICES
from services.runtime.bus import Sample
from services.runtime.record import LogWriter

FLUSH_S = 1.0
Tap = Callable[[Sample, Message], None]


class Recorder:
    """Subscribes at once; writes on its own thread until `close`. `taps` see every valid message on that thread."""

    def __init__(self, client: Client, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._log = LogWriter(path)
        self.taps: list[Tap] = []
        self.counts: Counter[str] = Counter()
        self.malformed: Counter[str] = Counter()
        self.attachments: dict[str, tuple[str, bytes]] = {}  # name: media type and content, written at the end
        self._queue: queue.SimpleQueue[Sample | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._write, name="recorder")
        self._thread.start()
        for topic in TOPICS:
            if topic.recorded:
                client.listen(topic, "*", self._queue.put)

    def close(self) -> None:
        """Write what has arrived, then finish the file."""
        self._queue.put(None)
        self._thread.join()
        for name, (media_type, data) in self.attachments.items():
            self._log.attach(name, media_type, data)
        self._log.close()

    def _write(self) -> None:
        flushed_s = time.monotonic()
        while True:
            try:
                sample = self._queue.get(timeout=FLUSH_S)
            except queue.Empty:
                self._log.flush()
                continue
            if sample is None:
                return
            self._add(sample)
            if time.monotonic() - flushed_s > FLUSH_S:
                self._log.flush()
                flushed_s = time.monotonic()

    def _add(self, sample: Sample) -> None:
        """Record what is valid; what is not never reached any service's state either."""
        try:
            message = decode(sample.topic.type, sample.payload)
        except DecodeError:
            self.malformed[sample.topic.name] += 1
            return
        self.counts[sample.topic.name] += 1
        if sample.writer:
            self._log.add(
                sample.topic, sample.key, sample.payload, sample.writer, sample.sequence, sample.sent_ns, time.time_ns()
            )
        for tap in self.taps:
            tap(sample, message)


class Settling:
    """A tap: whether every reader has finished with everything published on the topics a run consists of."""

    def __init__(self, topics: tuple[Topic, ...]) -> None:
        self._topics = {topic.name for topic in topics}
        self._readers = [
            (service.name, topic.name) for service in SERVICES for topic in service.reads if topic.name in self._topics
        ]
        self._published: dict[tuple[str, str, str], int] = {}  # newest by topic, key, writer
        self._consumed: dict[tuple[str, str, str], int] = {}  # newest by service, key, writer
        self.changed_s = time.monotonic()

    def __call__(self, sample: Sample, message: Message) -> None:
        """See one recorded message."""
        match message:
            case Consumed() if message.writer:
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
        return not behind and time.monotonic() - self.changed_s > quiet_s

"""Records every recorded topic of all robots into one log, and knows how far its readers are.

What arrives faster than it can be written waits, up to `MOST_WAITING_BYTES`; then whoever publishes is held back, for
the bus gives nothing more to this process. A disk that takes nothing for `STUCK_S` holds nobody up any longer: what
comes meanwhile is left out, and counted.
"""

import logging
import math
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from pathlib import Path

from prior_sg.schemas.codec import DecodeError, Message
from prior_sg.schemas.status import Consumed
from prior_sg.schemas.topics import TOPICS, Topic
from prior_sg.services.errors import PriorSgError
from prior_sg.services.registry import SERVICES
from prior_sg.services.runtime.bus import Sample, message_in
from prior_sg.services.runtime.client import BusClient
from prior_sg.services.runtime.record import LogError, LogWriter

log = logging.getLogger(__name__)

FLUSH_S = 1.0
MOST_WAITING_BYTES = 256_000_000  # of messages not written yet
STUCK_S = 10.0
REST_S = 1.5  # without inputs, until the segmenter rests, adapts to the whole map, and settles
TICKS_AFTER = {service.name: math.ceil(REST_S / service.tick_s) for service in SERVICES if service.tick_s is not None}
Tap = Callable[[Sample, Message], None]


class TapError(PriorSgError):
    """What follows the messages beside the log has failed; the text is one sentence for the user."""


class Waiting:
    """Samples on their way to one writer, in order. Who puts one waits while there are too many, unless the writer has
    taken none for a while: then it is left out.
    """

    def __init__(self, most_bytes: int = MOST_WAITING_BYTES, stuck_s: float = STUCK_S) -> None:
        self._most_bytes, self._stuck_s = most_bytes, stuck_s
        self._changed = threading.Condition()
        self._samples: deque[Sample] = deque()
        self._bytes = 0
        self._taken_s = time.monotonic()
        self._closed = False
        self.left_out = 0

    def put(self, sample: Sample) -> None:
        """Add a sample; after `close` there is no more to add."""
        with self._changed:
            if not self._samples:
                self._taken_s = time.monotonic()  # nothing to take is no sign of a writer that is stuck
            while not self._closed and self._samples and self._bytes + len(sample.payload) > self._most_bytes:
                left_s = self._taken_s + self._stuck_s - time.monotonic()
                if left_s <= 0:
                    self.left_out += 1
                    return
                self._changed.wait(left_s)
            if not self._closed:
                self._samples.append(sample)
                self._bytes += len(sample.payload)
                self._changed.notify_all()

    def take(self, timeout_s: float) -> Sample | None:
        """The oldest sample; None when none has come for so long, or when all are taken and it is closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._samples or self._closed, timeout_s)
            if not self._samples:
                return None
            sample = self._samples.popleft()
            self._bytes -= len(sample.payload)
            self._taken_s = time.monotonic()
            self._changed.notify_all()
            return sample

    def close(self) -> None:
        """Take nothing more in."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    @property
    def ended(self) -> bool:
        """Closed, and all taken."""
        return self._closed and not self._samples


class Recorder:
    """Subscribes at once; writes on its own thread until `close`. `taps` see every valid message on that thread; one
    that fails sees no more, and what it is for ends by that.

    With `limit_mb`, recording ends when the log has grown to so much; 0 = it does not. The taps go on.
    """

    def __init__(self, client: BusClient, path: Path, limit_mb: float = 0.0) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._path, self._limit_bytes = path, limit_mb * 1e6
        self._log = LogWriter(path)
        self.taps: list[Tap] = []
        self.counts: Counter[str] = Counter()
        self.malformed: Counter[str] = Counter()
        self.beyond = 0  # messages that came when the log was full
        self.attachments: dict[str, tuple[str, bytes]] = {}  # name: media type and content, written at the end
        self.error: LogError | None = None
        self.tap_error: TapError | None = None
        self._waiting = Waiting()
        self._thread = threading.Thread(target=self._write, name="recorder", daemon=True)
        self._thread.start()
        for topic in TOPICS:
            if topic.recorded:
                client.listen(topic, "*", self._waiting.put)

    def close(self) -> None:
        """Write what has arrived, then finish the file. Raises LogError when something could not be written, and
        TapError, the file finished, when a tap has failed.
        """
        self._waiting.close()
        self._thread.join()
        self._check_log()
        for name, (media_type, data) in self.attachments.items():
            self._log.attach(name, media_type, data)
        self._log.close()
        self.check()

    def check(self) -> None:
        """Raise LogError when writing has failed, TapError when a tap has."""
        self._check_log()
        if self.tap_error is not None:
            raise self.tap_error

    def _check_log(self) -> None:
        if self.error is not None:
            raise self.error

    @property
    def lacks(self) -> str:
        """What the log lacks, as a sentence; empty when it holds everything."""
        if self._waiting.left_out:
            return f"{self._path} lacks {self._waiting.left_out} messages: the disk took nothing for {STUCK_S:.0f} s"
        if self.beyond:
            return f"{self._path} lacks the last {self.beyond} messages: it has grown to {self._limit_bytes / 1e6:g} MB"
        return ""

    def _write(self) -> None:
        """Until the end, or until the log cannot be written (a full disk); the taps go on seeing what arrives."""
        while not self._waiting.ended:
            try:
                sample = self._waiting.take(FLUSH_S)
                if sample is not None:
                    self._add(sample)
                elif self.error is None:
                    self._log.flush()
            except LogError as error:
                self.error = self.error or error
            except Exception as error:  # a fault of ours: without a word the run would go on, and its log end here
                log.exception("recording failed")
                self.error = self.error or LogError(f"{self._path} cannot be written on: {error!r}")

    def _add(self, sample: Sample) -> None:
        """Record what is valid; what is not never reached any service's state either."""
        try:
            message = message_in(sample)
        except DecodeError:
            self.malformed[sample.topic.name] += 1
            return
        for tap in list(self.taps):
            self._show(tap, sample, message)
        if self._limit_bytes and self._log.size_bytes >= self._limit_bytes:
            self.beyond += 1
            return
        self.counts[sample.topic.name] += 1
        if sample.writer and self.error is None:
            self._log.add(
                sample.topic, sample.key, sample.payload, sample.writer, sample.sequence, sample.sent_ns, time.time_ns()
            )

    def _show(self, tap: Tap, sample: Sample, message: Message) -> None:
        try:
            tap(sample, message)
        except Exception as error:  # a fault of ours: the log has nothing to do with it
            name = getattr(tap, "__name__", type(tap).__name__)
            log.exception("a tap failed")
            self.taps.remove(tap)
            self.tap_error = self.tap_error or TapError(
                f"{name}, which follows what is recorded, failed at a message of {sample.topic.name}: {error!r}; "
                f"{self._path} is whole, report this with it"
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

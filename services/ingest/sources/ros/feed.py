"""What comes in from a live robot, between Zenoh's threads and the one that reads: bounded, drops counted by reason."""

import threading
import time
from collections import deque
from collections.abc import Iterator

from prior_sg.services.ingest.core.frames import Unused
from prior_sg.services.ingest.core.ros.motions import Fault
from prior_sg.services.ingest.core.ros.topics import CAMERA_INFO, CLOUDS, COMPRESSED, FIXED_TRANSFORMS, IMAGE, Topic
from prior_sg.services.losses import kind_of
from prior_sg.services.runtime.ros.session import Received, RosSession
from prior_sg.services.runtime.ros.types import Types
from prior_sg.services.runtime.ros.wire import Channel, Quality

WAITING = {IMAGE: 32, COMPRESSED: 64, CAMERA_INFO: 4} | dict.fromkeys(CLOUDS, 16)  # messages of a topic, by its type
OTHERS_WAITING = 4096  # transforms and poses: they are small, and a frame needs them
MOST_BYTES = 64 << 20
LATCHED_DEPTH = 100  # one message of /tf_static of each node of a large robot
AGAIN_S = 10.0  # between two words on the same fault
BEHIND, TOO_LARGE = "the reader was behind", "it has more than 64 MiB"


class Feed:
    """Messages of some topics in their order of arrival; of each topic the newest."""

    def __init__(self) -> None:
        self._arrived = threading.Condition()
        self._waiting: dict[str, deque[Received]] = {}
        self._faults: deque[Fault] = deque(maxlen=OTHERS_WAITING)

    def open(self, session: RosSession, topic: Topic, types: Types) -> None:
        """Subscribe to a topic. Raises WireError."""
        most = WAITING.get(topic.type, OTHERS_WAITING)
        with self._arrived:
            self._waiting[topic.name] = deque(maxlen=most)
        latched = topic.taken_for == FIXED_TRANSFORMS
        quality = Quality(LATCHED_DEPTH if latched else min(most, 100), latched)
        session.subscribe(Channel(topic.name, topic.type, types.hash(topic.type), quality), self.put, self.fault)

    def put(self, message: Received) -> None:
        """Take in a message; called by Zenoh's threads."""
        if len(message.payload) > MOST_BYTES:
            self.fault(message.topic, TOO_LARGE)
            return
        with self._arrived:
            waiting = self._waiting[message.topic]
            if len(waiting) == waiting.maxlen:
                self._faults.append(Fault(f"messages of {message.topic}", BEHIND))
            waiting.append(message)
            self._arrived.notify()

    def fault(self, topic: str, reason: str) -> None:
        """A message that cannot be taken; called by Zenoh's threads."""
        with self._arrived:
            self._faults.append(Fault(f"messages of {topic}", reason))

    def take(self, timeout_s: float) -> tuple[list[Received], list[Fault]]:
        """All that waits, by arrival, and what could not be taken; waits for a message."""
        with self._arrived:
            self._arrived.wait_for(lambda: any(self._waiting.values()), timeout_s)
            messages = [message for waiting in self._waiting.values() for message in waiting]
            for waiting in self._waiting.values():
                waiting.clear()
            faults = list(self._faults)
            self._faults.clear()
        return sorted(messages, key=lambda message: message.received_ns), faults


class Tally:
    """Faults as words on them: of each kind the first at once, then at most one in ten seconds, with the count."""

    def __init__(self) -> None:
        self._found: dict[tuple[str, str], list] = {}  # count and first text since the last word
        self._said_s: dict[tuple[str, str], float] = {}

    def add(self, fault: Fault, count: int = 1) -> None:
        """Count one, or several of the same."""
        key = fault.what, fault.kind or kind_of(fault.text)
        self._found.setdefault(key, [0, fault.text])[0] += count

    def words(self, ended: bool = False) -> Iterator[Unused]:
        """Those that are due; at the end all."""
        now_s = time.monotonic()
        for (what, reason), (count, example) in list(self._found.items()):
            if ended or now_s - self._said_s.get((what, reason), -AGAIN_S) >= AGAIN_S:
                del self._found[what, reason]
                self._said_s[what, reason] = now_s
                yield Unused(what=what, reason=reason, count=count, example=example)

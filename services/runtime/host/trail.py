"""What became of the newest keyframes in one process: kept while it runs, told to whoever asks for its status."""

import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager

from prior_sg.schemas.codec import Message
from prior_sg.schemas.status import JobDone, Passage, StatusRequest
from prior_sg.schemas.topics import Topic
from prior_sg.services.runtime.bus import Sample

MOST_PASSAGES = 512  # minutes of a stream
MOST_OF_A_STEP = 16
LONGEST_FAULT = 200  # characters


class Trail:
    """Passages of one service: written by its thread, read by any."""

    def __init__(self, robot: str) -> None:
        self._robot = robot
        self._lock = threading.Lock()
        self._passages: deque[Passage] = deque(maxlen=MOST_PASSAGES)
        self._made: dict[tuple[str, int], tuple[int, dict[str, int]]] = {}  # stamps and topics, by keyframe
        self._event = ""

    def published(self, topic: Topic, message: Message) -> None:
        """The step under way has published this; of what only the newest counts nothing is kept."""
        if topic.delivery == "latest":
            return
        keyframe = (getattr(message, "robot", self._robot), getattr(message, "frame_id", -1))
        if keyframe in self._made or len(self._made) < MOST_OF_A_STEP:
            _, topics = self._made.setdefault(keyframe, (getattr(message, "stamp_ns", 0), {}))
            topics[topic.name] = getattr(message, "revision", -1)
        self._event = getattr(message, "event", "") or self._event

    @contextmanager
    def passing(self, message: Message, name: str, waited_s: float, sample: Sample | None) -> Iterator[None]:
        """Around the step with an input: it is kept where it concerns a keyframe or a delta."""
        self._made, self._event = {}, ""
        began_ns = time.time_ns()
        try:
            yield
        except Exception as error:
            self._event = str(error) or type(error).__name__
            raise
        finally:
            self._keep(message, name, (began_ns - int(waited_s * 1e9), began_ns, time.time_ns()), sample)

    def asked(self, request: StatusRequest) -> list[Passage]:
        """What a request for status wants to know, oldest first."""
        with self._lock:
            kept = list(self._passages)
        return [one for one in kept if (0 <= request.frame_id == one.frame_id) or (0 < request.since_ns < one.ended_ns)]

    def newest(self, number: int) -> list[Passage]:
        """Oldest first."""
        with self._lock:
            return list(self._passages)[-number:]

    def _keep(self, message: Message, name: str, times_ns: tuple[int, int, int], sample: Sample | None) -> None:
        """One passage for each keyframe that the step has published something for, else one of its input."""
        done = message if isinstance(message, JobDone) else None
        robot, revision = getattr(message, "robot", self._robot), getattr(message, "revision", -1)
        frame_id = getattr(message, "frame_id", -1) if done or hasattr(message, "robot") else -1  # not of raw frames
        made = {keyframe: found for keyframe, found in self._made.items() if keyframe[1] >= 0}
        others = {topic: one for _, topics in self._made.values() for topic, one in topics.items()} if not made else {}
        event = self._event or (done.error if done else "")
        if not (made or others or event) and frame_id < 0 and revision < 0:
            return
        of_input = {(robot, frame_id): (getattr(message, "stamp_ns", 0), others)}
        for (of, number), (stamp_ns, topics) in (made or of_input).items():
            passage = Passage(
                robot=of,
                topic=name,
                frame_id=number,
                revision=revision,
                stamp_ns=stamp_ns,
                sent_ns=0 if sample is None else max(sample.sent_ns, 0),
                received_ns=times_ns[0],
                began_ns=times_ns[1],
                ended_ns=times_ns[2],
                writer="" if sample is None else sample.writer,
                traceparent="" if sample is None else sample.traceparent,
                published=topics,
                worker=done.worker if done else "",
                attempts=done.attempts if done else 0,
                fault=event[:LONGEST_FAULT],
            )
            with self._lock:
                self._passages.append(passage)

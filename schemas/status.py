"""What services say about themselves: consumption journal, health."""

from typing import ClassVar

import msgspec

from prior_sg.schemas.codec import Message, Number, NumberOrNone, Part, Stamp

STEP_BOUNDS_S = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0)


class Consumed(Message, frozen=True, kw_only=True):
    """One input a service has taken and finished with, in its order: what replay needs, and what flow control reads.

    `key`, `writer` and `sequence` point at a recorded message. Inputs that no topic carries (start, ticks, replies to
    questions, messages of unknown writers) travel whole in `inline`.
    """

    OF_A_ROBOT: ClassVar[bool] = False

    robot: str
    service: str
    instance: str
    order: Number  # 0, 1, 2, … per instance
    topic: str  # topic, query or message name
    frame_id: NumberOrNone = -1  # of a keyframe
    writer: str = ""
    sequence: NumberOrNone = -1
    inline: bytes = b""
    key: str = ""


class Started(Message, frozen=True, kw_only=True):
    """Opens a journal: everything replay needs to build the same state. It never goes beyond version 1: it tells those
    of the messages that its journal holds `inline`.
    """

    OF_A_ROBOT: ClassVar[bool] = False

    robot: str
    service: str
    instance: str
    epoch: NumberOrNone
    config: bytes  # the resolved config as JSON
    reads: list[str] = []  # names of the topics it reads
    versions: dict[str, int] = {}  # of messages, by name, where it is not 1


class EpochRequest(Message, frozen=True, kw_only=True):
    """Ask `keeper`, a service that follows deltas, how far the epochs of a robot's `topic` have come."""

    robot: str
    topic: str
    keeper: str


class EpochKnown(Message, frozen=True, kw_only=True):
    """The epoch that is followed, and its newest revision; -1 = none yet."""

    robot: str
    topic: str
    epoch: NumberOrNone
    revision: NumberOrNone


class Tick(Message, frozen=True, kw_only=True):
    """Time, as a message."""

    stamp_ns: Stamp


class JobDone(Message, frozen=True, kw_only=True):
    """A job this process dispatched has been finished by a worker."""

    topic: str
    frame_id: NumberOrNone
    worker: str
    attempts: Number  # 1 unless workers died or hung
    error: str = ""  # why it was given up, when it was


class TopicCount(msgspec.Struct, frozen=True, kw_only=True):
    """What happened to one topic in one process since it started."""

    topic: str
    received: int = 0
    consumed: int = 0
    published: int = 0
    malformed: int = 0  # could not be decoded; dropped
    skipped: int = 0  # superseded by a newer sample before it was read (`latest`)
    duplicate: int = 0  # seen before, dropped
    missed: int = 0  # known to exist, never arrived
    limited: int = 0  # too many on one key; dropped
    last_age_ms: float = -1.0  # age of the newest consumed sample when it was consumed


class Loss(msgspec.Struct, frozen=True, kw_only=True):
    """What a service could not use, for one reason."""

    what: str  # "frames refused", "keyframes not mapped", …
    reason: str  # without what differs from one to the next
    count: int
    example: str  # the first, in full


class PoolCount(msgspec.Struct, frozen=True, kw_only=True):
    """Jobs that a process has given to workers, and those that wait for one."""

    topic: str
    waiting: int
    running: int
    oldest_wait_s: float  # of those that wait, since they were given
    workers: dict[str, int]  # alive, by the work they do (an embedding space)


class Passage(Part, frozen=True, kw_only=True):
    """One input on its way through one process: a keyframe or what was made of it. Times are of this process's host,
    but `sent_ns`, which is of the writer's.
    """

    robot: str
    topic: str  # topic, job or message name
    frame_id: NumberOrNone = -1  # of the input, else of what was published for it
    revision: NumberOrNone = -1  # of a delta
    stamp_ns: Stamp = 0  # when it was captured
    sent_ns: Stamp = 0  # 0 = it did not come by a topic
    received_ns: Stamp = 0
    began_ns: Stamp = 0
    ended_ns: Stamp = 0
    writer: str = ""
    traceparent: str = ""  # context of the writer, where it told one
    published: dict[str, int] = {}  # topics, each with its last revision, -1 = it has none
    worker: str = ""  # of a job that is over: who did it
    attempts: int = 0
    fault: str = ""  # why it could not be used, or was given up


class StatusRequest(Message, frozen=True, kw_only=True):
    """Ask a process for its health; also for its passages of one keyframe, or of all that ended after a time."""

    frame_id: NumberOrNone = -1  # -1 = of none
    since_ns: Stamp = 0  # 0 = of no time


class ServiceStatus(Message, frozen=True, kw_only=True):
    """Health of one process."""

    OF_A_ROBOT: ClassVar[bool] = False

    service: str
    instance: str
    robot: str
    pid: Number
    uptime_s: float
    backlog: Number  # inputs waiting
    busy_share: float  # share of the last seconds spent computing
    step_ms_p50: float
    step_ms_p99: float
    resident_mb: float
    waiting_for: list[str]  # questions without an answer yet
    topics: list[TopicCount]
    losses: list[Loss] = []  # most frequent first
    step_s: float = 0.0  # since when it has been at one input
    step_compiling_s: float = 0.0  # of that, in which it compiled inner loops, as a first run does
    clock_ns: Stamp = 0  # of its host when it answered; 0 = not told
    release: str = ""  # of the program it runs
    cpu_s: float = 0.0  # processor time since it started
    oldest_wait_s: float = 0.0  # of the inputs that wait
    step_counts: list[int] = []  # steps by how long they took: as long as STEP_BOUNDS_S, and longer than all
    step_sum_s: float = 0.0
    pools: list[PoolCount] = []
    figures: dict[str, float] = {}  # of the service itself
    passages: list[Passage] = []  # oldest first, where they were asked for

"""What a service is: a declaration around a pure step function."""

from collections.abc import Awaitable, Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, Literal, TypeVar

import msgspec

from prior_sg.schemas.codec import Message
from prior_sg.schemas.status import Loss
from prior_sg.schemas.succession import Bequest
from prior_sg.schemas.topics import FLEET, Query, Topic
from prior_sg.services.errors import PriorSgError

State = TypeVar("State")
Config = TypeVar("Config", bound=msgspec.Struct)


class ServiceError(PriorSgError):
    """A service cannot run as it is configured; the message is one sentence that says what to do."""


class LaterError(ServiceError):
    """A running service lacks what can come back, such as room on a disk: it is started again until it has it."""


class UndeclaredError(Exception):
    """A service wrote or asked what its declaration does not name: a fault in the service."""


@dataclass(frozen=True)
class Identity:
    """Who a running service is. `robot` is `*` for a service of the whole fleet."""

    robot: str
    instance: str
    epoch: int

    @property
    def whose(self) -> str:
        """Who is served, as it stands in keys where the name of a robot stands."""
        return FLEET if self.robot == "*" else self.robot


@dataclass(frozen=True)
class Errand(Generic[Config]):
    """Slow or outside work of a service, such as a call over the network, which must hold up neither its steps nor its
    answers. `open(cfg, identity)`, called once when the service starts and never in a replay, gives the coroutine
    function that does it: request in, reply out; it must not raise for what may happen in ordinary life.
    """

    name: str
    request: type[Message]
    reply: type[Message]
    open: Callable[[Config, Identity], Callable[[Any], Awaitable[Message]]]
    key: str = ""  # no key: nobody else can ask


@dataclass(frozen=True)
class Ask:
    """An output of a step: a question to the bus, or an errand. The reply is an input of a later step; the host repeats
    a question until then."""

    query: Query | Errand
    request: Message


@dataclass(frozen=True)
class Pause:
    """An output of a step that goes on, whose state is one to answer questions from: those that wait are answered."""


Output = tuple[Topic, Message] | Ask | Pause


@dataclass(frozen=True)
class Handover(Generic[State, Config]):
    """How a service that others follow goes on in another process. Its successor reads what it reads and tells nothing:
    the step gets `Succession` first, and `TakesOver` when it is its turn. `lacks` says, as part of a sentence, what a
    successor still waits for before it can take over; empty = nothing. `bequest` is the last word of the predecessor.
    """

    lacks: Callable[[State, Config], str]
    bequest: Callable[[State, Identity, Config], Bequest]


@dataclass(frozen=True)
class Service(Generic[State, Config]):
    """One service: what it reads, writes and answers, and the functions that do it, over its own state and config.

    `step(state, message, cfg)` takes one input and yields outputs; it may change `state` and does nothing else. A long
    one yields `Pause` where `answers` may be called before it goes on.
    Inputs are messages of `reads`, of `job`, replies to its questions and errands, and `Tick` every `tick_s` seconds.
    `answers` maps a query to `f(state, request, cfg) -> reply`, which must not change the state.
    `reads_of`, where it is given, names the robots whose messages of `reads` come in, instead of its own.
    `drive`, for sources only, is a coroutine that feeds inputs from outside (see host/port.py).
    """

    name: str
    purpose: str
    scope: Literal["robot", "fleet"]
    config: type[Config]
    init: Callable[[Config, Identity], State]
    step: Callable[[State, Message, Config], Iterator[Output]]
    reads: tuple[Topic, ...] = ()
    writes: tuple[Topic, ...] = ()
    answers: Mapping[Query, Callable[[State, Any, Config], Message]] = field(default_factory=dict)
    asks: tuple[Query, ...] = ()
    errands: tuple[Errand[Config], ...] = ()
    job: Topic | None = None  # the pool this service works for
    job_group: Callable[[Config], str] = lambda cfg: ""  # workers of one group do the same work
    prepare: Callable[[State, list[Message], Config], None] | None = None  # told of jobs that wait; must not block
    job_limit: Callable[[Config], int] = lambda cfg: 0  # jobs written that may wait before the oldest is skipped
    tick_s: float | None = None
    reads_of: Callable[[Config], Sequence[str]] | None = None
    drive: Callable[[Any, Config], Awaitable[None]] | None = None
    key_fields: Callable[[Config], dict[str, str]] = lambda cfg: {}  # config values that appear in keys of `answers`
    losses: Callable[[State], list[Loss]] = lambda state: []  # what could not be used; also read during a step
    figures: Callable[[State], dict[str, float]] = lambda state: {}  # what it tells of itself; read as `losses` is
    close: Callable[[State], None] = lambda state: None
    handover: Handover | None = None  # without: a successor begins anew
    beside: bool = False  # a successor serves before its predecessor ends; else, without `handover`, after
    replay_tolerance: float = 1e-6  # by which floats of a replay may differ; networks differ with threads and machine
    replay_config: Callable[[Config], Config] = lambda cfg: cfg  # for a replay, which touches nothing outside

    def check_write(self, topic: Topic) -> None:
        """Raise UndeclaredError unless the service declares this topic."""
        if topic not in self.writes:
            raise UndeclaredError(f"{self.name} wrote {topic.name}, which it does not declare")

    def check_ask(self, ask: Ask) -> None:
        """Raise UndeclaredError unless the service declares this question or errand."""
        if ask.query not in (*self.asks, *self.errands):
            raise UndeclaredError(f"{self.name} asked {ask.query.name}, which it does not declare")

    def read_keys(self, topic: Topic, robot: str, cfg: Config) -> list[str]:
        """The key expressions on which a process of this service reads a topic."""
        return [topic.pattern(one) for one in ((robot,) if self.reads_of is None else self.reads_of(cfg))]

    def answer_key(self, query: Query, robot: str, cfg: Config) -> str:
        """The key expression on which a process of this service answers a question."""
        fields = {name: robot if name == "robot" else "*" for name in query.request.__struct_fields__}
        return query.key.format(**(fields | self.key_fields(cfg)))

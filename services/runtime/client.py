"""A program's end of the bus: publish, ask and listen with typed messages."""

import contextlib
import threading
import time
import uuid
from collections.abc import Callable, Iterator, Mapping
from functools import cached_property
from types import TracebackType
from typing import Any, NamedTuple, TypeVar

from prior_sg.schemas.codec import DecodeError, Message, decode, encode
from prior_sg.schemas.priors import Prior, PriorList, PriorRequest, Task, TaskInForce, TaskRequest
from prior_sg.schemas.status import ServiceStatus, StatusRequest
from prior_sg.schemas.succession import Swapped, SwapRequest
from prior_sg.schemas.topics import (
    PRIOR,
    PRIORS,
    TASK,
    TASK_IN_FORCE,
    Query,
    Topic,
    alive_key,
    lease_key,
    roll_key,
    status_key,
    swap_key,
)
from prior_sg.services.errors import PriorSgError
from prior_sg.services.runtime.bus import NOBODY, Answer, Bus, BusError, Sample, message_in, pack_header
from prior_sg.services.runtime.host.lease import Standing, standing
from prior_sg.services.runtime.signatures import Unsigned, signatures_in_force

R = TypeVar("R", bound=Message)
POLL_S = 0.5
STAMP_TIMEOUT_S = 2.0
STAMP_TRIES = 5  # of a store that is there and busy
PATIENT_POLLS = 4
ALIVE_TIMEOUT_S = 2.0


class OnTheRoll(NamedTuple):
    """A process as who started it tells."""

    service: str
    instance: str
    pid: str


class NoPriorError(PriorSgError):
    """The task has no prior; the message is the gateway's reason."""


class NobodyError(BusError):
    """Nobody is there who answers this question."""


class BusClient:
    """Use as a context manager; leaves the bus at the end."""

    def __init__(self, bus: Bus) -> None:
        self.bus = bus
        self.writer = f"client/{uuid.uuid4().hex[:8]}/{time.time_ns()}"
        self._sequences: dict[str, int] = {}
        self._alive: dict[str, str] = {}
        self._watching = False

    def __enter__(self) -> "BusClient":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.bus.close()

    @cached_property
    def signatures(self) -> Unsigned:
        """What priors are checked by. Raises BusError, ExtraMissing."""
        return signatures_in_force()

    def publish(self, topic: Topic, message: Message, traceparent: str = "") -> int:
        """Publish one message, in the context of a trace if there is one; returns which of ours on its key it is, from
        0."""
        key = topic.key_of(message)
        sequence = self._sequences.get(key, 0)
        self._sequences[key] = sequence + 1
        self.bus.put(topic, key, encode(message), pack_header(self.writer, sequence, time.time_ns(), traceparent))
        return sequence

    def listen(self, topic: Topic, robot: str, on_sample: Callable[[Sample], None]) -> Callable[[], None]:
        """Receive samples on a foreign thread; returns what ends it."""
        return self.bus.subscribe(topic, topic.pattern(robot), on_sample, lambda topic, number: None)

    @contextlib.contextmanager
    def listening(self, topic: Topic, robot: str, on_sample: Callable[[Sample], None]) -> Iterator[None]:
        """The same for as long as the body takes."""
        end = self.listen(topic, robot, on_sample)
        try:
            yield
        finally:
            end()

    def ask(self, query: Query, request: Message, timeout_s: float = 10.0) -> Any:
        """The reply, decoded. Raises BusError when nobody answers in time."""
        return self._ask(query.key_of(request), query.reply, request, query.name, timeout_s)

    def _ask(self, key: str, reply_type: type[R], request: Message, name: str, timeout_s: float) -> R:
        return self._asked(key, reply_type, request, name, timeout_s)()

    def _asked(self, key: str, reply_type: type[R], request: Message, name: str, timeout_s: float) -> Callable[[], R]:
        """Ask, and return what waits for the reply."""
        arrived = threading.Event()
        answers: list[Answer] = []

        def receive(answer: Answer) -> None:
            answers.append(answer)
            arrived.set()

        def reply() -> R:
            if not arrived.wait(timeout_s + 1.0):
                raise BusError(
                    f"{name}: no answer within {timeout_s:.0f} s; is the service running (`prior-sg health`)?"
                )
            answer = answers[0]
            if answer.payload is None:
                kind = NobodyError if answer.reason == NOBODY else BusError
                raise kind(f"{name}: {_explain(answer.reason)}")
            try:
                told = decode(reply_type, answer.payload)
            except DecodeError as error:
                raise BusError(f"{name}: the answer is not valid: {error}") from error
            if isinstance(told, PriorList) and (fault := self.signatures.fault_of(told)):
                raise BusError(f"{name}: {fault}")
            return told

        self.bus.call(key, encode(request), timeout_s, receive)
        return reply

    def task_stamp_ns(self, robot: str) -> int:
        """The stamp of a task given now: after the one in force, whatever the clock of the host that gave it said.

        A busy store is asked again: a task stamped by the clock alone may come before the one in force, and nobody
        would follow it. Raises BusError when it stays busy.
        """
        tries = 1
        while True:
            try:
                known: TaskInForce = self.ask(TASK_IN_FORCE, TaskRequest(robot=robot), STAMP_TIMEOUT_S)
            except NobodyError:  # no store is there that knows of one
                return time.time_ns()
            except BusError:
                if tries >= STAMP_TRIES:
                    raise
                tries += 1
            else:
                return time.time_ns() if known.task is None else max(time.time_ns(), known.task.stamp_ns + 1)

    def give_task(self, task: Task, timeout_s: float, waiting: Callable[[str], None] = lambda reason: None) -> Prior:
        """Publish a task and wait for the prior that answers it; a model may take minutes, and `waiting` is told why
        meanwhile. Raises NoPriorError, BusError."""
        found: list[Prior] = []
        signatures = self.signatures
        arrived = threading.Event()
        given_ns = time.time_ns()

        def see(sample: Sample) -> None:
            with contextlib.suppress(DecodeError):
                prior: Prior = message_in(sample)
                if sample.sent_ns >= given_ns and prior.answers(task) and not signatures.fault_of(prior):
                    found.append(prior)
                    arrived.set()

        with self.listening(PRIOR, "*", see):
            self.publish(TASK, task)
            told = self._prior_told(task, arrived, timeout_s, waiting)
        return found[0] if told is None else told

    def _prior_told(
        self, task: Task, arrived: threading.Event, timeout_s: float, waiting: Callable[[str], None]
    ) -> Prior | None:
        """Ask for the prior of a task until it has arrived by itself: then None. Raises NoPriorError, BusError."""
        request = PriorRequest(environment=task.environment, task=task.task, regions=task.regions)
        end_s, polls = time.monotonic() + timeout_s, 0
        while not arrived.wait(POLL_S):
            reply, polls = self.ask(PRIORS, request), polls + 1
            if not reply.priors and not reply.pending:
                raise NoPriorError(reply.reason)
            if reply.priors and not reply.pending and polls > PATIENT_POLLS:  # another clock may be behind ours
                prior: Prior = reply.priors[0]
                return prior
            if time.monotonic() > end_s:
                raise NoPriorError(f"no prior within {timeout_s:.0f} s: {reply.reason or 'see `prior-sg health`'}")
            waiting(reply.reason)
        return None

    def alive(self, settle_s: float = 0.3, patience_s: float = 2.0) -> dict[str, str]:
        """Instance to service of everything alive now; on a busy host the first to be seen may take `patience_s`."""
        if not self._watching:
            self._watching = True
            self.bus.watch(alive_key("*", "*"), self._saw)
            end_s = time.monotonic() + patience_s
            time.sleep(settle_s)
            while not self._alive and time.monotonic() < end_s:
                time.sleep(settle_s)
        return dict(self._alive)

    def standings(self) -> list[Standing]:
        """Who is in charge of which robot's services, and who waits for that, sorted."""
        keys = self.bus.announced(lease_key("*", "*", "*", "*"), ALIVE_TIMEOUT_S)
        return sorted((one for key in keys if (one := standing(key)) is not None), key=str)

    def on_the_roll(self) -> list[OnTheRoll]:
        """Every process that exists where it was started and was alive once, whether it is heard or not, sorted."""
        keys = self.bus.announced(roll_key("*", "*", "*"), ALIVE_TIMEOUT_S)
        return sorted(OnTheRoll(*key.split("/")[-3:]) for key in keys)

    def status(self, service: str, instance: str, timeout_s: float = 3.0) -> ServiceStatus:
        """Health of one process. Raises BusError."""
        return self._ask(
            status_key(service, instance), ServiceStatus, StatusRequest(), f"status of {instance}", timeout_s
        )

    def swap(self, service: str, instance: str, request: SwapRequest, timeout_s: float) -> Swapped:
        """Have a process exchanged by who started it. Raises BusError where nobody answers."""
        return self._ask(swap_key(service, instance), Swapped, request, f"exchange of {instance}", timeout_s)

    def statuses(
        self, request: StatusRequest = StatusRequest(), timeout_s: float = 3.0, among: Mapping[str, str] | None = None
    ) -> tuple[list[ServiceStatus], dict[str, str]]:
        """Health of all who are alive, or of those `among` them (services by instance), asked at once, sorted by
        instance; why others did not answer, by instance."""
        replies = {
            instance: self._asked(
                status_key(service, instance), ServiceStatus, request, f"status of {instance}", timeout_s
            )
            for instance, service in sorted((self.alive() if among is None else among).items())
        }
        heard, silent = [], {}
        for instance, reply in replies.items():
            try:
                heard.append(reply())
            except BusError as error:
                silent[instance] = str(error)
        return heard, silent

    def _saw(self, key: str, alive: bool) -> None:
        service, instance = key.split("/")[-2:]
        if alive:
            self._alive[instance] = service
        else:
            self._alive.pop(instance, None)


def _explain(reason: str) -> str:
    if reason == NOBODY:
        return "nobody answers; is the service running (`prior-sg health`)?"
    return "no answer in time; the service is busy or hangs" if reason == "timeout" else reason

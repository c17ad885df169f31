"""Runs services without a bus: each input at once, in one thread, the same outputs for the same inputs.

`Runner` drives one service, `Pipeline` several that are joined by what they declare. What a host adds to a step
(dropping, retrying, counting, the journal) is left out; what it forbids, such as undeclared outputs, is forbidden here
too.
"""

import contextlib
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Self, Union

from prior_sg.schemas.codec import Message, copied, encode
from prior_sg.schemas.status import JobDone
from prior_sg.schemas.topics import Query, Topic
from prior_sg.services.refusals import NotYet
from prior_sg.services.runtime.bus import key_matches
from prior_sg.services.runtime.service import Ask, Errand, Identity, Pause, Service

Published = tuple[Topic, Message]
Answerer = Union["Runner", Callable[[Any], Message | None]]
DEFAULT_ROBOT = "robot1"


class Runner:
    """One service. `answers` says who answers its questions and does its errands: another runner, or a function from
    request to reply that returns None where nobody answers. Use as a context manager, or call `close`.

    `state` is one to go on with, instead of a new one. With `wire`, every message passes through bytes as it does on a
    bus: validated, its arrays read-only and shared with no state. Without, an output may point into the state and holds
    until the next input.
    """

    def __init__(
        self,
        service: Service[Any, Any],
        cfg: Any = None,
        identity: Identity | None = None,
        answers: Mapping[Query | Errand[Any], Answerer] | None = None,
        *,
        state: Any = None,
        wire: bool = False,
    ) -> None:
        self.service = service
        self.cfg = service.config() if cfg is None else cfg
        self.identity = identity or Identity(DEFAULT_ROBOT if service.scope == "robot" else "*", service.name, 1)
        self.answers: dict[Query | Errand[Any], Answerer] = dict(answers or {})
        self.asks: list[Ask] = []  # not answered yet, each once, oldest first
        self.wire = wire
        self.state = service.init(self.cfg, self.identity) if state is None else state

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Let the service end: it closes what it has opened."""
        self.service.close(self.state)

    def feed(self, *messages: Message) -> list[Published]:
        """What the service publishes on these inputs, in order; replies to its questions are its next inputs.

        Raises UndeclaredError when it writes or asks what it does not declare.
        """
        published: list[Published] = []
        inputs = deque(messages)
        while inputs:
            outputs, asks = self._step(inputs.popleft())
            published += outputs
            replies = [reply for ask in asks if (reply := self._reply(ask)) is not None]
            inputs.extendleft(reversed(replies))
        return published

    def answer(self, query: Query, request: Message) -> Any:
        """The service's own answer to a question, of the query's reply type."""
        reply = self.service.answers[query](self.state, request, self.cfg)
        return copied(reply) if self.wire else reply

    def serves(self, query: Query, request: Message) -> bool:
        """Whether a host of this service would answer this question."""
        return query in self.service.answers and key_matches(
            self.service.answer_key(query, self.identity.robot, self.cfg), query.key_of(request)
        )

    def reads(self, topic: Topic, message: Message) -> bool:
        """Whether a host of this service would receive this message."""
        patterns = self.service.read_keys(topic, self.identity.robot, self.cfg)
        return topic in self.service.reads and any(key_matches(one, topic.key_of(message)) for one in patterns)

    def _step(self, message: Message) -> tuple[list[Published], list[Ask]]:
        """The outputs of one whole step: no reply comes before its end."""
        published: list[Published] = []
        asks: list[Ask] = []
        for output in self.service.step(self.state, copied(message) if self.wire else message, self.cfg):
            if isinstance(output, Pause):
                continue  # nobody else can ask meanwhile
            if isinstance(output, Ask):
                self.service.check_ask(output)
                asks.append(output)
            else:
                topic, outgoing = output
                self.service.check_write(topic)
                published.append((topic, copied(outgoing) if self.wire else outgoing))
        return published, asks

    def _reply(self, ask: Ask) -> Message | None:
        """The reply, or None after noting that there is none yet."""
        answerer = self.answers.get(ask.query)
        reply: Message | None = None
        with contextlib.suppress(NotYet):
            if isinstance(answerer, Runner):
                assert isinstance(ask.query, Query)
                reply = answerer.answer(ask.query, ask.request)
            elif answerer is not None:
                reply = answerer(ask.request)
        if reply is None and all(_name(ask) != _name(open_) for open_ in self.asks):
            self.asks.append(ask)
        return reply


class Pipeline:
    """Runners joined as on a bus: messages go to whoever reads their topic, in order, jobs to one worker of each group,
    questions to the first runner that serves their key, unless the runner that asks has an answer of its own.
    """

    def __init__(self, runners: Iterable[Runner]) -> None:
        self.runners = tuple(runners)
        self._waiting: deque[tuple[Runner, Message]] = deque()
        for runner in self.runners:
            for query in runner.service.asks:
                runner.answers.setdefault(query, self._answerer(query))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close all runners."""
        for runner in self.runners:
            runner.close()

    def of(self, service: str) -> Runner:
        """The first runner of a service."""
        return next(runner for runner in self.runners if runner.service.name == service)

    def feed(self, runner: Runner, message: Message) -> list[Published]:
        """Everything published by anybody on one input of one runner, until nothing waits."""
        self._waiting.append((runner, message))
        return self._drain()

    def publish(self, topic: Topic, message: Message) -> list[Published]:
        """The same on a message from outside."""
        self._deliver(None, topic, message)
        return self._drain()

    def _drain(self) -> list[Published]:
        published: list[Published] = []
        while self._waiting:
            runner, message = self._waiting.popleft()
            for topic, output in runner.feed(message):
                published.append((topic, output))
                self._deliver(runner, topic, output)
        return published

    def _deliver(self, writer: Runner | None, topic: Topic, message: Message) -> None:
        """Queue a message for its readers; the writer of a job hears of its end."""
        if topic.delivery != "job":
            self._waiting.extend((runner, message) for runner in self.runners if runner.reads(topic, message))
            return
        workers = self._workers(topic, message)
        self._waiting.extend((worker, message) for worker in workers)
        if writer is not None and workers:
            frame_id: int = getattr(message, "frame_id", -1)
            done = JobDone(topic=topic.name, frame_id=frame_id, worker=workers[0].identity.instance, attempts=1)
            self._waiting.append((writer, done))

    def _workers(self, job: Topic, message: Message) -> Sequence[Runner]:
        """The first worker of each group, or of the one group that the message names."""
        wanted: str = getattr(message, "space", "")
        groups: dict[str, Runner] = {}
        for runner in self.runners:
            if runner.service.job is job:
                groups.setdefault(runner.service.job_group(runner.cfg), runner)
        return [runner for group, runner in groups.items() if wanted in ("", group)]

    def _answerer(self, query: Query) -> Callable[[Message], Message | None]:
        def reply(request: Message) -> Message | None:
            server = next((runner for runner in self.runners if runner.serves(query, request)), None)
            return None if server is None else server.answer(query, request)

        return reply


def _name(ask: Ask) -> tuple[str, bytes]:
    return ask.query.name, encode(ask.request)

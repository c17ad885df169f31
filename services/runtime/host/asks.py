"""What a service has asked: questions to the bus, repeated until they are answered, and errands."""

import asyncio
import logging
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any

from prior_sg.schemas.codec import Message, encode
from prior_sg.services.runtime.bus import Answer, Bus
from prior_sg.services.runtime.host.inbox import Inbox
from prior_sg.services.runtime.service import Ask, Errand

log = logging.getLogger(__name__)

ASK_TIMEOUT_S = 10.0
ASK_RETRY_S = 0.5


@dataclass(frozen=True)
class Reply:
    """An answer to one of the service's questions."""

    ask: Ask
    payload: bytes


async def answer_to(bus: Bus, key: str, request: bytes, timeout_s: float) -> Answer:
    """Ask on a bus, which answers on a foreign thread, perhaps when nobody waits any more."""
    loop = asyncio.get_running_loop()
    answered: asyncio.Future[Answer] = loop.create_future()

    def settle(answer: Answer) -> None:
        if not answered.done():
            answered.set_result(answer)

    def receive(answer: Answer) -> None:
        loop.call_soon_threadsafe(settle, answer)

    await asyncio.to_thread(bus.call, key, request, timeout_s, receive)
    return await answered


class Asks:
    """Open questions and errands of one service. Replies come to the inbox; `fault` fails when an errand has raised."""

    def __init__(self, bus: Bus, inbox: Inbox, stopping: asyncio.Event) -> None:
        self._bus, self._inbox, self._stopping = bus, inbox, stopping
        self._loop = asyncio.get_running_loop()
        self._open: dict[tuple[str, bytes], Ask] = {}
        self._errands: dict[Errand, Callable[[Any], Awaitable[Message]]] = {}
        self._running: set[asyncio.Task] = set()
        self.fault: asyncio.Future = self._loop.create_future()

    @property
    def tasks(self) -> tuple[asyncio.Future, ...]:
        """What is under way on the event loop."""
        return (*self._running, self.fault)

    @property
    def under_way(self) -> int:
        """Errands that are being done."""
        return len(self._running)

    @property
    def waiting_for(self) -> list[str]:
        """Names of what is asked and not answered yet, sorted."""
        return sorted({name for name, _ in list(self._open)})

    def can_do(self, errand: Errand, does: Callable[[Any], Awaitable[Message]]) -> None:
        """Note what does an errand."""
        self._errands[errand] = does

    def ask(self, ask: Ask) -> None:
        """Ask, unless the same is asked already."""
        name = (ask.query.name, encode(ask.request))
        if name not in self._open:
            self._open[name] = ask
            self._call(ask)

    def answered(self, ask: Ask) -> None:
        """The answer was a good one."""
        self._open.pop((ask.query.name, encode(ask.request)), None)

    def ask_later(self, ask: Ask) -> None:
        """Repeat a question that got no good answer."""
        self._loop.call_soon_threadsafe(self._loop.call_later, ASK_RETRY_S, self._call_again, ask)

    def _call(self, ask: Ask) -> None:
        if isinstance(ask.query, Errand):
            self._loop.call_soon_threadsafe(self._run_errand, ask.query, ask)
            return

        def replied(answer: Answer) -> None:
            if answer.payload is not None:
                self._inbox.put(Reply(ask, answer.payload))
            else:
                log.debug("no answer yet", extra={"query": ask.query.name, "why": answer.reason})
                self.ask_later(ask)

        self._bus.call(ask.query.key_of(ask.request), encode(ask.request), ASK_TIMEOUT_S, replied)

    def _call_again(self, ask: Ask) -> None:
        if not self._stopping.is_set():
            self._loop.run_in_executor(None, self._call, ask)

    def _run_errand(self, errand: Errand, ask: Ask) -> None:
        async def work() -> None:
            reply = await self._errands[errand](ask.request)
            self._inbox.put(Reply(ask, encode(reply)))

        task = self._loop.create_task(work())
        self._running.add(task)
        task.add_done_callback(self._errand_ended)

    def _errand_ended(self, task: asyncio.Task) -> None:
        self._running.discard(task)
        if not task.cancelled() and (error := task.exception()) is not None and not self.fault.done():
            self.fault.set_exception(error)

"""The end of a process from which another takes over: it takes in nothing more, and finishes what it has begun."""

import asyncio
import logging
import time
from collections.abc import Callable

from prior_sg.schemas.codec import DecodeError, decode, encode
from prior_sg.schemas.succession import Bequest, YieldRequest
from prior_sg.schemas.topics import YIELD
from prior_sg.services.runtime.bus import Request
from prior_sg.services.runtime.host.inbox import Inbox
from prior_sg.services.runtime.host.items import LastWord
from prior_sg.services.runtime.host.lease import Lease

log = logging.getLogger(__name__)
DRAIN_S = 60.0  # for what has been begun
LOOK_S = 0.02


class Yielding:
    """Of one host. `no_more` is set when a source is to be read no further; `may` says why not yet, empty = it may."""

    def __init__(self, inbox: Inbox, no_more: asyncio.Event, may: Callable[[], str]) -> None:
        self._inbox, self._no_more, self._may = inbox, no_more, may
        self._loop = asyncio.get_running_loop()
        self._heir: Request | None = None
        self.begun = asyncio.Event()
        self.bequest: Bequest | None = None  # the last word, once it is said: nothing is taken in after that

    def receive(self, request: Request) -> None:
        """Somebody asks, on a foreign thread."""
        try:
            successor = decode(YieldRequest, request.payload).successor
        except DecodeError:
            self._inbox.of(YIELD.name).malformed += 1
            request.refuse("the request is not a valid YieldRequest")
            return
        self._loop.call_soon_threadsafe(self._begin, request, successor)

    def _begin(self, request: Request, successor: str) -> None:
        if self._heir is not None:
            request.refuse("it yields to another already")
        elif fault := self._may():
            request.refuse(fault)
        else:
            log.info("yields", extra={"to": successor})
            self._heir = request
            self._no_more.set()
            self.begun.set()

    async def drain(self, is_busy: Callable[[], bool]) -> None:
        """Once asked to, wait for what has been begun, within a bound; the last word comes after all that waits."""
        await self.begun.wait()
        deadline_s = time.monotonic() + DRAIN_S
        while is_busy() and time.monotonic() < deadline_s:
            await asyncio.sleep(LOOK_S)
        self._inbox.put(LastWord())

    async def hand_over(self, lease: Lease | None) -> None:
        """Let go of what this process is in charge of, and say the last word, if somebody has asked for it."""
        if self._heir is None:
            return
        if self.bequest is None:
            self._heir.refuse("it was stopped before it was done")
            return
        if lease is not None:
            await lease.release()
        self._heir.reply(encode(self.bequest))

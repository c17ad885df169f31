"""How a process takes over from another: it is asked to yield, answers with its last word, and ends.

A service whose deltas others follow stands by first: it reads what its predecessor reads until it lacks nothing, and
tells nothing. One that serves beside others joins them first. Any other begins once its predecessor has ended.
"""

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass

from prior_sg.schemas.codec import DecodeError, decode, encode
from prior_sg.schemas.succession import Bequest, YieldRequest
from prior_sg.schemas.topics import alive_key, yield_key
from prior_sg.services.runtime.bus import NOBODY, Answer, Bus
from prior_sg.services.runtime.host.asks import answer_to
from prior_sg.services.runtime.host.lease import Lease
from prior_sg.services.runtime.service import ServiceError

log = logging.getLogger(__name__)
YIELD_S = 90.0  # in which who yields finishes what it has begun, a conversation with a model among it
ALIVE_S = 2.0
FOUND_S = 5.0  # in which a session that has just begun is told who answers
PATIENCE_S = 60.0  # without anything new, after which who stands by gives up
LOOK_S = 0.05


@dataclass(frozen=True)
class Predecessor:
    """The process to take over from, as its successor sees it."""

    bus: Bus
    whose: str  # see Identity
    service: str
    instance: str
    successor: str

    async def yields(self) -> Bequest | None:
        """Ask it to yield; its last word, None where it has died. Raises ServiceError where it does not."""
        deadline_s = time.monotonic() + FOUND_S
        answer = await self._asked()
        while answer.reason == NOBODY and await self._is_alive() and time.monotonic() < deadline_s:
            await asyncio.sleep(LOOK_S)  # this session may not have been told yet who answers
            answer = await self._asked()
        if answer.payload is not None:
            try:
                return decode(Bequest, answer.payload)
            except DecodeError as error:
                log.warning("the last word of the predecessor is not understood", extra={"why": str(error)[:200]})
                return None
        if not await self._is_alive():
            log.warning(f"{self.instance} has ended without a word")
            return None
        raise ServiceError(f"{self.instance} does not yield ({answer.reason}): it serves on, and this process ends")

    async def _asked(self) -> Answer:
        key = yield_key(self.whose, self.service, self.instance)
        return await answer_to(self.bus, key, encode(YieldRequest(successor=self.successor)), YIELD_S)

    async def _is_alive(self) -> bool:
        return bool(await asyncio.to_thread(self.bus.announced, alive_key(self.service, self.instance), ALIVE_S))


@dataclass(frozen=True)
class Standby:
    """What a process that stands by waits for."""

    predecessor: Predecessor
    lease: Lease

    async def turn(self, lacks: Callable[[], Awaitable[str]]) -> Bequest | None:
        """Wait until nothing is lacking, have the predecessor yield, and be in charge; at once where it dies. Returns
        its last word. Raises ServiceError, SupersededError.
        """
        died, ready = asyncio.create_task(self.lease.alone()), asyncio.create_task(_nothing(lacks))
        try:
            await asyncio.wait((died, ready), return_when=asyncio.FIRST_COMPLETED)
            if died.done():
                died.result()
                bequest = None
            else:
                ready.result()
                log.info("nothing is lacking: the predecessor is asked to yield")
                bequest = await self.predecessor.yields()
        finally:
            for task in (died, ready):
                task.cancel()
            await asyncio.gather(died, ready, return_exceptions=True)
        await self.lease.take_over()
        return bequest


async def _nothing(lacks: Callable[[], Awaitable[str]]) -> None:
    """Until nothing is lacking. Raises ServiceError where what is lacking stays the same for too long."""
    last, since_s = "", time.monotonic()
    while lacking := await lacks():
        if lacking != last:
            last, since_s = lacking, time.monotonic()
        if time.monotonic() - since_s > PATIENCE_S:
            raise ServiceError(f"this process cannot take over: it lacks {lacking}; its predecessor serves on")
        await asyncio.sleep(LOOK_S)

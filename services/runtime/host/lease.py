"""One writer for each robot and service: who is in charge holds a token that names its epoch.

The token is Zenoh's liveliness: it goes when its holder ends, dies or cannot be reached. An epoch is drawn above every
one seen: in tokens, and by the keepers, the services that follow the writer. Where two are in charge, after a link was
cut or when both began at once, the higher epoch wins and the other stops itself. One that starts while another is in
charge waits for its end, or stands by until that one yields to it.
"""

import asyncio
import logging
import re
import time
from collections.abc import Callable, Container, Mapping, Sequence
from typing import NamedTuple

from prior_sg.schemas.codec import LAST_NUMBER, DecodeError, decode, encode
from prior_sg.schemas.status import EpochKnown, EpochRequest
from prior_sg.schemas.topics import EPOCH, WAITING, Topic, lease_key
from prior_sg.services.deltas import fault_of_epoch, next_epoch
from prior_sg.services.errors import PriorSgError
from prior_sg.services.runtime.bus import Bus, BusError
from prior_sg.services.runtime.host.asks import answer_to

log = logging.getLogger(__name__)

GRACE_S = 1.5  # a router that was started again hears within a second from everybody who lost it
CHECK_S = 5.0
ANSWER_S = 2.0
MOST_TOLD = 100  # sentences, of whoever invents tokens
HISTORY_S = 0.3  # in which a watch hears of who is there


class SupersededError(PriorSgError):
    """This process is not the one that writes: it has stopped itself, and says why."""


class Holder(NamedTuple):
    """Who is in charge; of several, the greatest."""

    epoch: int
    instance: str


class Standing(NamedTuple):
    """What one token says."""

    robot: str
    service: str
    holder: Holder | None  # None = waits
    instance: str


def standing(key: str) -> Standing | None:
    """What a token of a lease says; None where it is none."""
    parts = key.split("/")
    if len(parts) != 6:
        return None
    _, robot, _, service, number, instance = parts
    if number == WAITING:
        return Standing(robot, service, None, instance)
    if not re.fullmatch(r"[1-9]\d{0,18}", number) or int(number) > LAST_NUMBER:
        return None
    return Standing(robot, service, Holder(int(number), instance), instance)


class Lease:
    """The right of one process to write for a robot. `await take()`, or `await stand_by()` and later `await
    take_over()`; then `await keep()`, which ends by SupersededError. `shared` names the topics that another writes as
    well, by right, and may number above.
    """

    def __init__(
        self,
        bus: Bus,
        robot: str,
        service: str,
        instance: str,
        *,
        topics: Sequence[Topic] = (),
        keepers: Sequence[str] = (),
        shared: Container[str] = (),
    ) -> None:
        self._bus, self._robot, self._service, self._instance = bus, robot, service, instance
        self._asked = [(topic.name, keeper) for topic in topics for keeper in keepers]
        self._shared = shared
        self._pattern = lease_key(robot, service, "*", "*")
        self._loop = asyncio.get_running_loop()
        self._changed = asyncio.Event()
        self._revisions: dict[str, int] = {}  # told last, by topic
        self._seen: frozenset[str] = frozenset()
        self._followed = -1  # the highest epoch that a keeper has said it follows
        self._told: set[str] = set()
        self._withdraw: Callable[[], None] = lambda: None  # of the token
        self.holder = Holder(-1, instance)

    @property
    def has_predecessor(self) -> bool:
        """Whether readers follow what another wrote before; known from `take` on."""
        return 0 <= self._followed != self.holder.epoch

    async def take(self) -> int:
        """Wait until nobody else is in charge, then be it; returns the epoch."""
        await self._look()
        await self.alone()
        while True:
            epoch = await self._draw()
            if await self._hold():
                return epoch
            await self.alone()

    async def stand_by(self) -> int:
        """The epoch with which this process is to take over from who is in charge now."""
        await self._look()
        return await self._draw()

    async def take_over(self) -> None:
        """Be in charge, with the epoch drawn when this process began to stand by. Raises SupersededError."""
        if not await self._hold():
            await self._check_others()

    async def release(self) -> None:
        """Be in charge no more."""
        await asyncio.to_thread(self._withdraw)

    async def _look(self) -> None:
        """See who is in charge, now and from now on."""
        await self._known()
        others = await self._others()  # first: beside a watch, Zenoh answers from what that has heard so far
        await asyncio.to_thread(self._bus.watch, self._pattern, self._saw)
        await asyncio.sleep(HISTORY_S if others else 0.0)

    async def _draw(self) -> int:
        await self._known()
        others = await self._others()
        epoch = next_epoch(time.time_ns(), max([self._followed, *(other.epoch for other in others)]))
        self.holder = Holder(epoch, self._instance)
        return epoch

    async def _hold(self) -> bool:
        """Announce that this process is in charge; False after taking it back, for another is."""
        self._withdraw = await asyncio.to_thread(self._announce, str(self.holder.epoch))
        if max([self.holder, *await self._others()]) == self.holder:
            return True
        await self.release()
        return False

    async def keep(self) -> None:
        """Until another is in charge. Raises SupersededError."""
        while True:
            self._changed.clear()
            await self._check_others()
            if ahead := [topic for topic, told in (await self._known()).items() if self._is_foreign(topic, told)]:
                await asyncio.sleep(GRACE_S)  # after a pause or a cut, who is in charge is heard a moment later
                await self._check_others()
                raise SupersededError(
                    f"readers of {', '.join(ahead)} follow what {self._what} did not write, and no other is in charge: "
                    f"this process (epoch {self.holder.epoch}) starts again above it"
                )
            try:
                await asyncio.wait_for(self._changed.wait(), CHECK_S)
            except TimeoutError:
                continue

    async def _check_others(self) -> None:
        if (other := max([self.holder, *await self._others()])) != self.holder:
            raise SupersededError(
                f"{other.instance} is in charge of {self._what} since epoch {other.epoch}, after this process (epoch "
                f"{self.holder.epoch}): this one stops; end the other if it is not meant to write"
            )

    @property
    def _what(self) -> str:
        return f"{self._service} of {self._robot}"

    def _announce(self, epoch: str) -> Callable[[], None]:
        return self._bus.announce(lease_key(self._robot, self._service, epoch, self._instance))

    async def alone(self) -> None:
        """Wait, and be seen to, until nobody else has been in charge for a while."""
        if not (others := await self._others()):
            return
        log.warning(
            f"{max(others).instance} is in charge of {self._what}: waiting for its end, then this one takes over"
        )
        withdraw = await asyncio.to_thread(self._announce, WAITING)
        try:
            while True:
                self._changed.clear()
                if not await self._others():
                    await asyncio.sleep(GRACE_S)
                    if not await self._others() and self._bus.connected():
                        break
                else:
                    await self._changed.wait()
        finally:
            withdraw()
        log.warning(f"nobody is in charge of {self._what} any more: this process takes over")

    async def _others(self) -> list[Holder]:
        """The others in charge now. No answer says nothing about them: asked again until there is one, or until one of
        them is heard.
        """
        while True:
            try:
                announced = await asyncio.to_thread(self._bus.announced, self._pattern, ANSWER_S)
            except BusError as error:
                self._tell(f"who is in charge of {self._what} cannot be found out yet: {error}")
                if others := self._believed(self._seen):
                    return others
                await asyncio.sleep(GRACE_S)
            else:
                return self._believed(self._seen | announced)

    def _believed(self, keys: frozenset[str]) -> list[Holder]:
        """The others that these tokens name, without those whose deltas no reader would take."""
        found = []
        for key in keys:
            one = standing(key)
            if one is None or one.holder is None or one.holder == self.holder:
                continue
            if fault := fault_of_epoch(one.holder.epoch, max(self._followed, self.holder.epoch)):
                self._tell(f"{one.instance} poses as {self._what}: {fault}; end it")
            else:
                found.append(one.holder)
        return found

    def _tell(self, sentence: str) -> None:
        """Once, however often it is found out."""
        if sentence not in self._told and len(self._told) < MOST_TOLD:
            self._told.add(sentence)
            log.warning(sentence)

    def tells(self, topic: str, revision: int) -> None:
        """This process is about to tell a revision."""
        self._revisions[topic] = revision

    def _is_foreign(self, topic: str, told: tuple[int, int]) -> bool:
        """Whether this process cannot have told this epoch and revision, nor another by right."""
        return topic not in self._shared and told > (self.holder.epoch, self._revisions.get(topic, -1))

    async def _known(self) -> dict[str, tuple[int, int]]:
        """The highest epoch and revision that a keeper follows, by topic; those before any left out."""
        known: dict[str, tuple[int, int]] = {}
        for told in await asyncio.gather(*(self._ask(*asked) for asked in self._asked)):
            if told is not None:
                known[told.topic] = max(known.get(told.topic, (-1, -1)), (told.epoch, told.revision))
                self._followed = max(self._followed, told.epoch)
        return known

    async def _ask(self, topic: str, keeper: str) -> EpochKnown | None:
        request = EpochRequest(robot=self._robot, topic=topic, keeper=keeper)
        payload = (await answer_to(self._bus, EPOCH.key_of(request), encode(request), ANSWER_S)).payload
        try:
            told = None if payload is None else decode(EpochKnown, payload)
        except DecodeError as error:
            log.warning("epoch not understood", extra={"keeper": keeper, "why": str(error)[:200]})
            return None
        if told is not None and (fault := fault_of_epoch(told.epoch, told.epoch)):
            self._tell(f"{keeper} says of what it follows of {self._what}: {fault}; start it without what it has kept")
            return None
        return told

    def _saw(self, key: str, alive: bool) -> None:
        self._seen = self._seen | {key} if alive else self._seen - {key}
        self._loop.call_soon_threadsafe(self._changed.set)


class Fence:
    """Which epochs of which writers are let in: none above that of those in charge, where somebody is. `services` names
    the services that write each topic; where there are several, one may number its own just above the other's."""

    def __init__(self, bus: Bus, robot: str, services: Mapping[str, Sequence[str]]) -> None:
        self._services = services
        self._holders: dict[tuple[str, str], set[Holder]] = {}
        for service in sorted({name for names in services.values() for name in names}):
            bus.watch(lease_key(robot, service, "*", "*"), self._saw)

    def fault_of(self, topic: str, robot: str, epoch: int) -> str:
        """Why a delta of this epoch is not let in, as a sentence; empty when it is."""
        services = self._services.get(topic, ())
        holders = [(one, name) for name in services for one in tuple(self._holders.get((robot, name), ()))]
        if not holders:
            return ""
        top, service = max(holders)
        if epoch <= top.epoch + len(services) - 1:
            return ""
        return f"it is of epoch {epoch}, and {top.instance} is in charge of {service} of {robot} with epoch {top.epoch}"

    def _saw(self, key: str, alive: bool) -> None:
        one = standing(key)
        if one is None or one.holder is None:
            return
        role = (one.robot, one.service)
        known = self._holders.get(role, set())
        self._holders[role] = known | {one.holder} if alive else known - {one.holder}
        if not self._holders[role]:
            del self._holders[role]

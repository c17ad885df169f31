"""What changed in a scene, told to everybody who follows it: asked for once, bounded in rate and in what waits."""

import asyncio
import itertools
from collections import deque
from collections.abc import AsyncIterator
from dataclasses import dataclass
from typing import Any

import msgspec

from prior_sg.deploy.serving.errors import BusyError
from prior_sg.deploy.serving.system import System
from prior_sg.schemas.answers import Difference
from prior_sg.schemas.queries import ChangedSince, SceneAnswer, WordsInUse
from prior_sg.schemas.scene import SceneRevision
from prior_sg.services.errors import PriorSgError

MOST_FOLLOWERS = 200
MOST_WAITING = 32  # events of one follower; one that is slower is sent away and may resume
RECENT = 256  # events of a robot that are kept for those who resume
PERIOD_S = 0.25  # between two events of one robot
SILENCE_S = 15.0  # after which a comment shows that the connection lives


@dataclass(frozen=True)
class Event:
    """`changes` since an older revision, or a `snapshot` where that one is not kept."""

    name: str
    since: int
    revision: int
    data: dict[str, Any]


class Feed:
    """The changes of one robot; lives on the event loop."""

    def __init__(self, system: System, robot: str) -> None:
        self._system, self._robot = system, robot
        self._followers: set[asyncio.Queue[Event | None]] = set()
        self._recent: deque[Event] = deque(maxlen=RECENT)
        self._told = -1  # the revision that followers have
        self._news = asyncio.Event()
        self._pump: asyncio.Task[None] | None = None
        self._starting = asyncio.Lock()

    @property
    def followers(self) -> int:
        """How many follow it now."""
        return len(self._followers)

    def wake(self) -> None:
        """The store has a newer revision."""
        self._news.set()

    def close(self) -> None:
        """Send everybody away."""
        for follower in self._followers:
            _end(follower)
        if self._pump is not None:
            self._pump.cancel()

    async def follow(self, last_revision: int | None) -> AsyncIterator[Event | None]:
        """Events from a revision on, or from now on; None at once, and from time to time, while there are none. Raises
        what `System.answers` raises, before the first.
        """
        queue: asyncio.Queue[Event | None] = asyncio.Queue(MOST_WAITING)
        self._followers.add(queue)
        try:
            async with self._starting:
                if self._pump is None or self._pump.done():
                    self._told = (await self._system.answers(self._robot)).revision
                    self._pump = asyncio.create_task(self._tell())
            missed, seen = await self._missed(last_revision), -1
            if not missed:
                yield None
            for event in missed:
                seen = event.revision
                yield event
            async for news in _arriving(queue):
                if news is None or news.revision > seen:
                    yield news
        finally:
            self._followers.discard(queue)

    async def _missed(self, last_revision: int | None) -> list[Event]:
        """What one who knows a revision has to be told first."""
        if last_revision is None:
            return [await self._snapshot("")]
        kept = list(itertools.dropwhile(lambda event: event.since != last_revision, self._recent))
        known = kept[-1].revision if kept else last_revision
        if known != self._told:  # what came while nobody followed is not among those that are kept
            kept.append(await self._change(known))
        return kept

    async def _tell(self) -> None:
        """Ask for changes whenever there are some, as long as anybody follows."""
        while self._followers:
            await self._news.wait()
            self._news.clear()
            try:
                event = await self._change(self._told)
            except PriorSgError:  # the store does not answer: the next revision tells that it does again
                continue
            if event.revision != self._told:
                self._told = event.revision
                self._recent.append(event)
                for follower in list(self._followers):
                    _put(follower, event)
            await asyncio.sleep(PERIOD_S)

    async def _change(self, since: int) -> Event:
        found = await self._system.answers(self._robot, ChangedSince(revision=since))
        difference: Any = found.answers[0]
        if difference.reason or not isinstance(difference, Difference):
            return await self._snapshot(difference.reason)
        return Event("changes", since, found.revision, _where(found) | msgspec.to_builtins(difference))

    async def _snapshot(self, reason: str) -> Event:
        """Which revision the scene is at, and which labels are in it."""
        found = await self._system.answers(self._robot, WordsInUse())
        data = _where(found) | {"scene": msgspec.to_builtins(found.answers[0])}
        return Event("snapshot", -1, found.revision, data | ({"reason": reason} if reason else {}))


async def _arriving(queue: asyncio.Queue[Event | None]) -> AsyncIterator[Event | None]:
    """Events as they come, None after a silence; ends where the queue holds None."""
    while True:
        try:
            async with asyncio.timeout(SILENCE_S):
                event = await queue.get()
        except TimeoutError:
            yield None
            continue
        if event is None:
            return
        yield event


class Feeds:
    """The feeds of all robots that anybody follows."""

    def __init__(self, system: System) -> None:
        self._system = system
        self._feeds: dict[str, Feed] = {}
        self._loop: asyncio.AbstractEventLoop | None = None
        system.on_revision.append(self._saw)

    def close(self) -> None:
        """Send everybody away."""
        for feed in self._feeds.values():
            feed.close()

    def follow(self, robot: str, last_revision: int | None) -> AsyncIterator[Event | None]:
        """As `Feed.follow`. Raises BusyError."""
        self._loop = asyncio.get_running_loop()
        if sum(feed.followers for feed in self._feeds.values()) >= MOST_FOLLOWERS:
            raise BusyError(f"{MOST_FOLLOWERS} connections follow changes already: close one, or try again later")
        self._feeds = {name: feed for name, feed in self._feeds.items() if feed.followers} | {
            robot: self._feeds.get(robot) or Feed(self._system, robot)
        }
        return self._feeds[robot].follow(last_revision)

    def _saw(self, revision: SceneRevision) -> None:
        """On a foreign thread."""
        if self._loop is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._wake, revision.robot)

    def _wake(self, robot: str) -> None:
        if robot in self._feeds:
            self._feeds[robot].wake()


def _where(found: SceneAnswer) -> dict[str, Any]:
    return {"robot": found.robot, "revision": found.revision, "stamp_ns": found.stamp_ns}


def _put(follower: asyncio.Queue[Event | None], event: Event) -> None:
    try:
        follower.put_nowait(event)
    except asyncio.QueueFull:
        _end(follower)


def _end(follower: asyncio.Queue[Event | None]) -> None:
    """What waits is dropped, so that the end is next."""
    while not follower.empty():
        follower.get_nowait()
    follower.put_nowait(None)

"""Reads a source of posed RGB-D frames; writes keyframes, encoder jobs, the camera's pose and its own progress."""

import asyncio
import logging
import time
from collections.abc import Awaitable, Iterator
from typing import Protocol

import msgspec

from prior_sg.schemas.codec import Message
from prior_sg.schemas.features import Backfill
from prior_sg.schemas.frames import Keyframe, PoseUpdate
from prior_sg.schemas.status import JobDone, Tick
from prior_sg.schemas.topics import (
    ARCHIVE,
    BACKFILL,
    CAMERA_STATE,
    ENCODE,
    INGEST_STATE,
    KEYFRAME,
    POSE_UPDATE,
    Topic,
)
from prior_sg.services.ingest import archive_file
from prior_sg.services.ingest.core import resuming, selection
from prior_sg.services.ingest.core.checkpoint import Checkpoint
from prior_sg.services.ingest.core.config import Config
from prior_sg.services.ingest.core.continuity import AHEAD_NS, Held
from prior_sg.services.ingest.core.frames import (
    BadFrame,
    BegunAnew,
    Closure,
    Correction,
    EndOfSource,
    RawFrame,
    Resumed,
    Unused,
)
from prior_sg.services.ingest.core.keeping import keep, keep_after
from prior_sg.services.ingest.core.options import is_live
from prior_sg.services.ingest.sources import LastingError, Source, SourceError, open_source
from prior_sg.services.ingest.sources.base import Event
from prior_sg.services.runtime import heap
from prior_sg.services.runtime.service import Identity, Output, Service

log = logging.getLogger(__name__)
PROGRESS_S = 1.0
SEARCH_S = 1.0  # between two searches for a robot


class Port(Protocol):
    """What `drive` needs of its host."""

    stopping: asyncio.Event

    async def consume(self, message: Message) -> None:
        """Run `step` on a message; returns when its outputs are out."""

    async def room(self, window: int) -> None:
        """Return when fewer than `window` keyframes are under way at every reader."""


def init(cfg: Config, identity: Identity) -> selection.State:
    """An empty state, or that of the process before as far as it was kept."""
    state = selection.State(robot=identity.robot, epoch=identity.epoch)
    state.keeper, kept = archive_file.opened(cfg, identity.robot, time.time)
    if kept is not None:
        resuming.resume(state, kept, cfg)
    return state


def step(state: selection.State, message: Message, cfg: Config) -> Iterator[Output]:
    """Take one frame, one finished job, corrected poses, or the end of the source."""
    could_keep = state.keeper is not None
    for topic, told in _told(state, message, cfg):
        if isinstance(told, Keyframe) and topic is KEYFRAME and not isinstance(message, Resumed):
            keep(state, told)
        yield topic, told
    keep_after(state, message)
    if could_keep and state.keeper is None:
        log.warning(
            f"keyframes are no longer kept in {cfg.archive_path}: {state.not_kept}; an ingest that dies now reads its "
            "source from the beginning"
        )


def _told(state: selection.State, message: Message, cfg: Config) -> Iterator[tuple[Topic, Message]]:
    match message:
        case RawFrame():
            yield from _take(state, message, cfg)
        case BadFrame():
            log.warning("frame unreadable", extra={"frame": message.frame_id, "why": message.reason})
            yield from selection.lose(state, message)
        case Unused():
            log.warning("not used", extra={"what": message.what, "count": message.count, "why": message.example})
            yield from selection.pass_over(state, message)
        case JobDone():
            yield from selection.encoded(state, message)
        case Correction():
            yield from selection.announce(state, message)
        case Closure():
            log.info("the poses have jumped", extra={"keyframes": len(state.trail)})
            yield from selection.close_loop(state, message)
        case Backfill():
            yield from selection.backfill(state, message)
        case PoseUpdate():
            selection.correct(state, message)
        case Resumed():
            yield from resuming.tell_again(state, message.live)
        case BegunAnew():
            resuming.forget(state)
        case EndOfSource():
            yield from _refuse(state, state.continuity.release())
            yield from selection.end(state)
        case Tick():  # the topic keeps no history: whoever comes late, or missed the last word, hears it again
            yield selection.progress(state)


def _take(state: selection.State, frame: RawFrame, cfg: Config) -> Iterator[tuple[Topic, Message]]:
    verdict = selection.judge(state, frame, cfg)
    yield from _refuse(state, verdict.refused)
    if verdict.held is not None:
        log.info("frame held back", extra={"frame": frame.frame_id, "why": verdict.held.text})
        yield selection.progress(state)
    if verdict.jump:
        log.warning("believed again", extra={"frame": frame.frame_id, "why": verdict.jump})
    for accepted in verdict.accepted:
        yield from selection.accept(state, accepted, cfg)


def _refuse(state: selection.State, refused: list[Held]) -> Iterator[tuple[Topic, Message]]:
    for held in refused:
        log.warning("frame refused", extra={"frame": held.frame.frame_id, "why": held.refusal.text})
        yield from selection.refuse(state, held)


async def drive(port: Port, cfg: Config) -> None:
    """Feed the source's frames, paced by their stamps, by the pipeline's room, or by both. Raises SourceError."""
    if not cfg.source:
        log.info("no source is configured: set ingest.source to a dataset folder or an MCAP log")
        return
    source = await _opened(port, cfg)
    if source is None:
        return
    heap.give_back()  # what the images that were looked at took
    log.info("reading", extra={"source": cfg.source, "layout": source.layout, "frames": source.total})
    for note in source.notes:
        log.info("source", extra={"note": note})
    stopping = asyncio.ensure_future(port.stopping.wait())
    stopping.add_done_callback(lambda _: source.close())  # a live source may be waiting for its next frame
    try:
        if await _fed(port, source, cfg):
            await port.consume(EndOfSource())
    finally:
        stopping.cancel()


async def _opened(port: Port, cfg: Config) -> Source | None:
    """The source; a robot or camera that is not there is awaited, until the host wishes to stop.

    Raises SourceError; of a robot LastingError, for what waiting does not mend.
    """
    while not port.stopping.is_set():
        try:
            return await asyncio.to_thread(_open, cfg)
        except SourceError as error:
            if isinstance(error, LastingError) or not is_live(cfg.source):
                raise
            log.warning("it is not there yet", extra={"why": str(error)})
            await _stopped_while(port, asyncio.sleep(SEARCH_S))
    return None


async def _fed(port: Port, source: Source, cfg: Config) -> bool:
    """Feed all that comes; False when the host wishes to stop before the end."""
    events = await _begun(port, source, await asyncio.to_thread(archive_file.left_off, cfg))
    pace = Pace(cfg.speed)
    while (event := await asyncio.to_thread(next, events, None)) is not None:
        if source.live is None:
            if cfg.speed > 0 and await _stopped_while(port, pace.until_due(event)):
                return False
            slows_down = cfg.speed <= 0 or cfg.when_behind == "wait"
            if slows_down and await _stopped_while(port, port.room(cfg.window)):
                return False
        await port.consume(event)
    return not port.stopping.is_set()


async def _begun(port: Port, source: Source, left: Checkpoint | None) -> Iterator[Event]:
    """The source's events, from where the process before left off if it is the same source."""
    if left is None:
        return source.events()
    if source.live is not None:
        log.info("going on", extra={"keyframes": left.keyframes})
        await port.consume(Resumed(live=True))
        return source.events()
    events = source.events(since=left.index)
    found = await asyncio.to_thread(_next_frame, events)
    if isinstance(found, RawFrame) and (found.frame_id, found.stamp_ns) == left.source_frame:
        log.info("going on", extra={"after_frame": left.frame_id, "keyframes": left.keyframes})
        await port.consume(Resumed(live=False))
        return events
    log.warning("the source is read from its beginning: it has changed since it was read", extra={"frame": left.index})
    await port.consume(BegunAnew())
    return source.events()


def _next_frame(events: Iterator[Event]) -> Event | None:
    return next((event for event in events if isinstance(event, RawFrame | BadFrame)), None)


class Pace:
    """Real time from stamps: the first frame is due at once, others as far behind it as their stamps say. After a stamp
    that goes back or lies far ahead, time counts from that frame."""

    def __init__(self, speed: float) -> None:
        self.speed = speed
        self._origin: tuple[float, int] | None = None  # loop time in seconds, stamp in nanoseconds
        self._newest_ns = 0

    async def until_due(self, frame: Event) -> None:
        """Return when the frame is due; all else, and frames that come late, are due at once."""
        if not isinstance(frame, RawFrame):
            return
        now_s = asyncio.get_running_loop().time()
        if self._origin is None or not 0 <= frame.stamp_ns - self._newest_ns <= AHEAD_NS:
            self._origin = (now_s, frame.stamp_ns)
        self._newest_ns = frame.stamp_ns
        due_s = self._origin[0] + (frame.stamp_ns - self._origin[1]) / 1e9 / self.speed
        await asyncio.sleep(max(0.0, due_s - now_s))


def _keeps_pace(cfg: Config) -> bool:
    """Whether frames come whether or not the workers follow; a robot waits for nobody."""
    return is_live(cfg.source) or (cfg.when_behind == "skip" and cfg.speed > 0)


def _open(cfg: Config) -> Source:
    source = open_source(cfg.source, options=cfg)
    if source.total == 0 and source.live is None:
        raise SourceError(f"{cfg.source} holds no frames")
    return source


async def _stopped_while(port: Port, waiting: Awaitable[None]) -> bool:
    """Wait, but not beyond the host's wish to stop; True when it wishes to."""
    tasks = (asyncio.ensure_future(waiting), asyncio.ensure_future(port.stopping.wait()))
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        if tasks[0].done():
            tasks[0].result()
        return port.stopping.is_set()
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


def _close(state: selection.State) -> None:
    if state.keeper is not None:
        state.keeper.close()


SERVICE = Service(
    name="ingest",
    purpose="reads a posed RGB-D source and selects keyframes",
    scope="robot",
    config=Config,
    init=init,
    step=step,
    reads=(POSE_UPDATE, BACKFILL),
    writes=(KEYFRAME, POSE_UPDATE, CAMERA_STATE, INGEST_STATE, ENCODE),
    answers={ARCHIVE: selection.archived},
    drive=drive,
    losses=selection.losses,
    close=_close,
    replay_config=lambda cfg: msgspec.structs.replace(cfg, archive_path=""),
    job_limit=lambda cfg: cfg.window if _keeps_pace(cfg) else 0,
    tick_s=PROGRESS_S,
)

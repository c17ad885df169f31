"""Runs one service on a bus: takes inputs one by one, steps, publishes, keeps the journal, answers questions.

All of a service's state is touched by one worker thread only; the event loop handles time and shutdown.
"""

import asyncio
import logging
import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import msgspec

from prior_sg.schemas.codec import DecodeError, Message, decode, encode, versions
from prior_sg.schemas.status import JobDone, ServiceStatus, Started, StatusRequest, Tick, TopicCount
from prior_sg.schemas.succession import Bequest, Succession, TakesOver
from prior_sg.schemas.topics import DELTAS, Query, Topic, alive_key, status_key, worker_keys, yield_key
from prior_sg.services.refusals import InputRefused
from prior_sg.services.runtime import heap
from prior_sg.services.runtime.bus import Bus, Request, Sample
from prior_sg.services.runtime.extras import release
from prior_sg.services.runtime.host.admission import Admission
from prior_sg.services.runtime.host.answering import Answering
from prior_sg.services.runtime.host.asks import Asks, Reply
from prior_sg.services.runtime.host.door import Door
from prior_sg.services.runtime.host.flow import Progress
from prior_sg.services.runtime.host.giving import Giving
from prior_sg.services.runtime.host.inbox import Inbox
from prior_sg.services.runtime.host.items import LastWord, Question, Work
from prior_sg.services.runtime.host.lease import Fence, Lease
from prior_sg.services.runtime.host.outbox import Outbox
from prior_sg.services.runtime.host.port import Fed, Port
from prior_sg.services.runtime.host.readers import Readers
from prior_sg.services.runtime.host.succession import Predecessor, Standby
from prior_sg.services.runtime.host.timing import Timing
from prior_sg.services.runtime.host.trail import Trail
from prior_sg.services.runtime.host.workplace import Workplace
from prior_sg.services.runtime.host.yielding import Yielding
from prior_sg.services.runtime.service import Ask, Identity, Pause, Service
from prior_sg.services.runtime.signatures import signatures_in_force

log = logging.getLogger(__name__)
FEW_INPUTS = 4  # that may wait in a process that has caught up


class Host:
    """One running service. `await run()` ends when `stop` is called or the service fails (then it raises), also when
    it loses its `lease`. What comes from writers that are not in charge stays outside the `fence`. With `standby` it
    first waits for its turn; with `replaces` it asks that process to yield once it serves itself; `follows` = readers
    know of another that went before.
    """

    def __init__(
        self,
        service: Service,
        bus: Bus,
        cfg: Any,
        identity: Identity,
        *,
        lease: Lease | None = None,
        fence: Fence | None = None,
        standby: Standby | None = None,
        replaces: Predecessor | None = None,
        follows: bool = False,
    ) -> None:
        self.service, self.bus, self.cfg, self.identity = service, bus, cfg, identity
        self.inbox = Inbox(wake=self._wake)
        self._door = Door(self.inbox)
        self._lease = lease
        self._standby, self._replaces, self._follows = standby, replaces, follows
        self._no_more = asyncio.Event()  # of a source
        self._yielding = Yielding(self.inbox, self._no_more, self._may_yield)
        self._driving = self._answers = False
        self._signatures = signatures_in_force()
        self._admission = Admission(self._door, fence, self._signatures)
        self.stopping = asyncio.Event()
        self._loop = asyncio.get_running_loop()
        self._waiting = asyncio.Event()
        self._thread = ThreadPoolExecutor(1, thread_name_prefix=service.name)
        self._asks = Asks(bus, self.inbox, self.stopping)
        self._progress = Progress()
        self._giving = Giving(self.inbox, self._progress, self._loop)
        self._outbox = Outbox(service.name, identity, bus, self._progress)
        self._answering = Answering(self.inbox, self._door)
        self._workplace = self._workplace_of(service)
        self._timing = Timing()
        self.trail = Trail(identity.robot)
        self._state: Any = None

    def _workplace_of(self, service: Service) -> Workplace | None:
        if service.job is None:
            return None
        return Workplace(
            service.job, self.inbox, self._door, self._outbox, step=self._step, writes=bool(service.writes)
        )

    async def run(self) -> None:
        """Build the state, join the bus, and work until stopped."""
        self._state = await self._on_thread(self.service.init, self.cfg, self.identity)
        heap.give_back()
        for errand in self.service.errands:
            self._asks.can_do(errand, errand.open(self.cfg, self.identity))
        if self.service.handover is not None and (self._standby is not None or self._follows):
            self.inbox.put(Succession(predecessor=self._standby.predecessor.instance if self._standby else ""))
        await self._on_thread(self._join)
        tasks = [asyncio.create_task(self._work()), asyncio.create_task(self._drain())]
        if self.service.tick_s is not None:
            tasks.append(asyncio.create_task(self._tick(self.service.tick_s)))
        if self.service.drive is not None:
            tasks.append(asyncio.create_task(self._drive()))
        if self._lease is not None:
            tasks.append(asyncio.create_task(self._in_charge(self._lease)))
        if self._replaces is not None:
            tasks.append(asyncio.create_task(self._replace(self._replaces)))
        stop = asyncio.create_task(self.stopping.wait())
        try:
            pending = {*tasks, self._asks.fault, stop}
            while not stop.done():
                done, pending = await asyncio.wait(pending, return_when=asyncio.FIRST_COMPLETED)
                for task in done:
                    task.result()
            await self._on_thread(self._outbox.journal, "STOP")  # only of an orderly end
        finally:
            under_way = (*tasks, *self._asks.tasks, stop)
            for task in under_way:
                task.cancel()
            await asyncio.gather(*under_way, return_exceptions=True)
            await self._leave()

    async def _in_charge(self, lease: Lease) -> None:
        """Be in charge, after standing by where that is so."""
        if self._standby is not None:
            bequest = await self._standby.turn(self._lacking)
            await self._on_thread(self._answer)
            self.inbox.put(TakesOver(bequest=bequest), first=True)
            log.info("takes over", extra={"from": self._standby.predecessor.instance})
        await lease.keep()

    async def _lacking(self) -> str:
        """What this process still lacks; a few inputs wait in any."""
        handover = self.service.handover
        assert handover is not None
        if (waiting := len(self.inbox)) > FEW_INPUTS:
            return f"{waiting} inputs that wait"
        return str(await self._on_thread(handover.lacks, self._state, self.cfg))

    async def _replace(self, predecessor: Predecessor) -> None:
        """Have the predecessor yield; where it does not, this process ends."""
        await predecessor.yields()
        log.info("takes over", extra={"from": predecessor.instance})

    @property
    def yielded(self) -> bool:
        """Whether another has taken over from this process."""
        return self._yielding.bequest is not None

    async def _drain(self) -> None:
        await self._yielding.begun.wait()
        if self._workplace is not None:
            self._workplace.closed.set()
        await self._yielding.drain(self._is_busy)
        await self.stopping.wait()

    def _is_busy(self) -> bool:
        """Whether a source is still being read, or an errand or a job given to a worker is under way."""
        return self._driving or bool(self._asks.under_way) or self._giving.under_way

    def _may_yield(self) -> str:
        if self._standby is not None and not self._answers:
            return "it is not in charge itself yet"
        return "it is ending already" if self.stopping.is_set() else ""

    def stop(self) -> None:
        """Ask the service to end after the input it is working on; safe to call from the loop's thread only."""
        self.stopping.set()
        self._no_more.set()
        self._waiting.set()

    async def _leave(self) -> None:
        self._giving.close()
        await self._on_thread(self.service.close, self._state)
        await self._yielding.hand_over(self._lease)
        await self._on_thread(self.bus.close)
        self._thread.shutdown(wait=False)

    def _join(self) -> None:
        """Declare everything once; be seen only when all of it stands."""
        service, robot = self.service, self.identity.robot
        config = msgspec.json.encode(self.cfg)
        started = Started(
            robot=robot,
            service=service.name,
            instance=self.identity.instance,
            epoch=self.identity.epoch,
            config=config,
            reads=[topic.name for topic in service.reads],
            versions=versions(),
        )
        self._outbox.journal("START", inline=encode(started))
        log.info("started", extra={"robot": robot, "config": msgspec.to_builtins(self.cfg)})
        if self._standby is None:
            self._answer()
        self.bus.serve(status_key(service.name, self.identity.instance), self._answer_status)
        self.bus.serve(yield_key(self.identity.whose, service.name, self.identity.instance), self._yielding.receive)
        for topic in service.writes:
            if topic.delivery == "job":
                self._giving.open(self.bus, topic, robot, service.job_limit(self.cfg))
        for topic in service.reads:
            for pattern in service.read_keys(topic, robot, self.cfg):
                self.bus.subscribe(topic, pattern, self.inbox.offer, self._missed)
        if service.drive is not None:
            readers = Readers(self.inbox, self._door, self._progress, self._loop, writer=self._outbox.writer)
            readers.follow(self.bus, robot)
        if service.job is not None and self._workplace is not None:
            run_key, live_key = worker_keys(service.job, self.identity.instance, service.job_group(self.cfg))
            self.bus.serve(f"{run_key}/*", self._workplace.offer)
            self.bus.announce(live_key)
        self.bus.announce(alive_key(service.name, self.identity.instance))

    def _answer(self) -> None:
        """Declare what this process answers: nothing while another is in charge."""
        for query in self.service.answers:
            key = self.service.answer_key(query, self.identity.robot, self.cfg)
            self.bus.serve(key, partial(self._answering.receive, query))
        self._answers = True

    def _wake(self) -> None:
        self._loop.call_soon_threadsafe(self._waiting.set)

    async def _work(self) -> None:
        while not self.stopping.is_set():
            await self._waiting.wait()
            self._waiting.clear()
            while not self.stopping.is_set() and len(self.inbox):
                await self._on_thread(self._take_some)

    def _take_some(self, budget_s: float = 0.05) -> None:
        """Work for a while without going back to the event loop for every input."""
        end_s = time.monotonic() + budget_s
        while time.monotonic() < end_s and not self.yielded and (item := self.inbox.take()) is not None:
            self._handle(item)

    def _handle(self, item: Any) -> None:
        match item:
            case Sample():
                self._handle_sample(item)
            case Tick() | Succession() | TakesOver():
                name = type(item).__name__
                self._step(item, name)
                self._outbox.journal(name, inline=encode(item))
            case Reply():
                self._handle_reply(item)
            case Question():
                self._answering.reply(item, partial(self._answered, item.query))
            case Work():
                assert self._workplace is not None
                self._workplace.do(item, self._prepare)
            case JobDone():
                self._step(item, "JobDone")
            case Fed():
                self._step(item.message, "frame")
                self._loop.call_soon_threadsafe(item.done)
            case LastWord():
                self._say_last_word()

    def _say_last_word(self) -> None:
        """Nothing is taken in after this."""
        identity, handover = self.identity, self.service.handover
        if handover is None:
            self._yielding.bequest = Bequest(
                robot=identity.whose, service=self.service.name, instance=identity.instance
            )
        else:
            self._yielding.bequest = handover.bequest(self._state, identity, self.cfg)
        self._loop.call_soon_threadsafe(self.stop)

    def _handle_sample(self, sample: Sample) -> None:
        message = self._admission.of_sample(sample)
        if message is None:
            return
        counts = self.inbox.of(sample.topic.name)
        counts.last_age_ms = (time.time_ns() - sample.sent_ns) / 1e6 if sample.sent_ns else -1.0
        self._take(message, sample.topic.name, sample.key, sample)
        counts.consumed += 1
        known = bool(sample.writer)
        self._outbox.journal(
            sample.topic.name,
            frame_id=getattr(message, "frame_id", -1),
            writer=sample.writer,
            sequence=sample.sequence if known else -1,
            inline=b"" if known else sample.payload,
            key=sample.key,
        )

    def _answered(self, query: Query, request: Message) -> Message:
        return self._signatures.signed(self.service.answers[query](self._state, request, self.cfg))

    def _prepare(self, jobs: list[Message]) -> None:
        if self.service.prepare is not None:
            self.service.prepare(self._state, jobs, self.cfg)

    def _handle_reply(self, reply: Reply) -> None:
        query = reply.ask.query
        message = self._admission.of_reply(reply)
        if message is None:
            self._asks.ask_later(reply.ask)
            return
        self._asks.answered(reply.ask)
        self._take(message, query.name, query.key)
        self._outbox.journal(query.name, inline=reply.payload)

    def _take(self, message: Message, name: str, key: str, sample: Sample | None = None) -> None:
        """Step with an input from outside: an absurd one is counted and logged, and the service goes on."""
        try:
            self._step(message, name, sample)
        except InputRefused as error:
            self._door.refused(name, key, str(error), "" if sample is None else sample.writer)

    def _step(self, message: Message, name: str, sample: Sample | None = None) -> None:
        started_s = self._timing.begins()
        with self.trail.passing(message, name, self.inbox.waited_s, sample):
            for output in self.service.step(self._state, message, self.cfg):
                match output:
                    case Pause():
                        self._answer_waiting()
                    case Ask():
                        self._ask(output)
                    case _:
                        self._publish(*output)
        self._timing.stepped(started_s)

    def _answer_waiting(self) -> None:
        """Answer the questions that wait, amid a step."""
        while (question := self.inbox.take_first(Question)) is not None:
            self._handle(question)

    def _publish(self, topic: Topic, message: Message) -> None:
        self.service.check_write(topic)
        self.inbox.of(topic.name).published += 1
        self.trail.published(topic, message)
        if topic.delivery == "job":
            self._giving.give(topic, message)
        else:
            if self._lease is not None and topic in DELTAS:
                self._lease.tells(topic.name, message.revision)  # type: ignore[attr-defined]
            self._outbox.put(topic, self._signatures.signed(message))

    def _ask(self, ask: Ask) -> None:
        self.service.check_ask(ask)
        self._asks.ask(ask)

    async def _tick(self, period_s: float) -> None:
        while True:
            await asyncio.sleep(period_s)
            self.inbox.put(Tick(stamp_ns=time.time_ns()), once="tick")

    async def _drive(self) -> None:
        assert self.service.drive is not None
        port = Port(
            self.identity.robot, self._no_more, self.inbox, self._progress, self.service.writes, self._giving.pools
        )
        self._driving = True
        try:
            await self.service.drive(port, self.cfg)
        finally:
            self._driving = False

    def _missed(self, topic: Topic, number: int) -> None:
        self.inbox.missed(topic.name, number)
        log.warning("samples lost", extra={"topic": topic.name, "number": number})

    def _answer_status(self, request: Request) -> None:
        try:
            asked = decode(StatusRequest, request.payload) if request.payload else StatusRequest()
        except DecodeError:
            self.inbox.of("STATUS").malformed += 1
            request.refuse("the request is not a valid StatusRequest")
            return
        request.reply(encode(self.status(asked)))

    def status(self, asked: StatusRequest = StatusRequest()) -> ServiceStatus:
        """Health of this process now."""
        return ServiceStatus(
            service=self.service.name,
            instance=self.identity.instance,
            robot=self.identity.robot,
            pid=os.getpid(),
            backlog=len(self.inbox),
            oldest_wait_s=self.inbox.oldest_wait_s,
            waiting_for=self._asks.waiting_for,
            topics=[TopicCount(topic=name, **vars(counts)) for name, counts in sorted(self.inbox.counts.items())],
            losses=self.service.losses(self._state),
            clock_ns=time.time_ns(),
            release=release(),
            pools=self._giving.counts(),
            figures=self.service.figures(self._state),
            passages=self.trail.asked(asked),
            **self._timing.figures()._asdict(),
        )

    async def _on_thread(self, function: Callable[..., Any], *arguments: Any) -> Any:
        return await self._loop.run_in_executor(self._thread, function, *arguments)

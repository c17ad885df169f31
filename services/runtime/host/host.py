"""Runs one service on a bus: takes inputs one by one, steps, publishes, keeps the journal, answers questions.

All of a service's state is touched by one worker thread only; the event loop handles time and shutdown.
"""

import asyncio
import logging
import math
import os
import threading
import time
from collections import deque
from collections.abc import Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from statistics import quantiles
from typing import Any, cast

import msgspec
import psutil

from prior_sg.schemas.codec import DecodeError, Message, decode, encode
from prior_sg.schemas.status import Consumed, JobDone, ServiceStatus, Started, StatusRequest, Tick, TopicCount
from prior_sg.schemas.topics import JOURNAL, Query, Topic, alive_key, status_key, worker_keys
from prior_sg.services.runtime.bus import Answer, Bus, Request, Sample, pack_header
from prior_sg.services.runtime.host.flow import Progress
from prior_sg.services.runtime.host.inbox import Inbox
from prior_sg.services.runtime.jobs.dispatcher import CREDITS, Ended, JobPool
from prior_sg.services.runtime.service import Ask, Errand, Identity, Service

log = logging.getLogger(__name__)

ASK_TIMEOUT_S = 10.0
ASK_RETRY_S = 0.5
RECENT_STEPS = 512


@dataclass(frozen=True)
class Reply:
    """An answer to one of the service's questions."""

    ask: Ask
    payload: bytes


@dataclass(frozen=True)
class Question:
    """Somebody's question to this service."""

    query: Query
    request: Request


@dataclass(frozen=True)
class Work:
    """A job to do for a dispatcher."""

    request: Request
    message: Message | None  # None = malformed


@dataclass(frozen=True)
class Fed:
    """An input from the service's own `drive`."""

    message: Message
    done: Callable[[], None]


class Host:
    """One running service. `await run()` ends when `stop` is called or the service fails (then it raises)."""

    def __init__(self, service: Service, bus: Bus, cfg: Any, identity: Identity) -> None:
        self.service, self.bus, self.cfg, self.identity = service, bus, cfg, identity
        self.writer = f"{service.name}/{identity.instance}/{identity.epoch}"
        self.inbox = Inbox(wake=self._wake)
        self.stopping = asyncio.Event()
        self._loop = asyncio.get_running_loop()
        self._waiting = asyncio.Event()
        self._thread = ThreadPoolExecutor(1, thread_name_prefix=service.name)
        self._sequences: dict[str, int] = {}
        self._order = 0
        self._asks: dict[tuple[str, bytes], Ask] = {}
        self._errands: dict[Errand, Callable[[Any], Awaitable[Message]]] = {}
        self._running: set[asyncio.Task] = set()
        self._fault: asyncio.Future = self._loop.create_future()  # of an errand that raised
        self._pools: dict[Topic, JobPool] = {}
        self._slots = threading.Semaphore(CREDITS)
        self._progress = Progress()
        self._started_s = time.monotonic()
        self._steps: deque[tuple[float, float]] = deque(maxlen=RECENT_STEPS)  # (end, duration), seconds
        self._state: Any = None

    async def run(self) -> None:
        """Build the state, join the bus, and work until stopped."""
        self._state = await self._on_thread(self.service.init, self.cfg, self.identity)
        self._errands = {errand: errand.open(self.cfg, self.identity) for errand in self.service.errands}
        await self._on_thread(self._join)
        tasks = [asyncio.create_task(self._work())]
        if self.service.tick_s is not None:
            tasks.append(asyncio.create_task(self._tick(self.service.tick_s)))
        if self.service.drive is not None:
            tasks.append(asyncio.create_task(self._drive()))
        stop = asyncio.create_task(self.stopping.wait())
        try:
            pending = {*tasks, self._fault, stop}
            while not stop.done():
                done, pending = await asyncio.wait(pending, return_when=asyncio.FIRST_COMPLETED)
                for task in done:
                    task.result()
            await self._on_thread(self._journal, "STOP")  # only of an orderly end
        finally:
            under_way = (*tasks, *self._running, self._fault, stop)
            for task in under_way:
                task.cancel()
            await asyncio.gather(*under_way, return_exceptions=True)
            await self._leave()

    def stop(self) -> None:
        """Ask the service to end after the input it is working on; safe to call from the loop's thread only."""
        self.stopping.set()
        self._waiting.set()

    async def _leave(self) -> None:
        for pool in self._pools.values():
            pool.close()
        await self._on_thread(self.service.close, self._state)
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
        )
        self._journal("START", inline=encode(started))
        log.info("started", extra={"robot": robot, "config": msgspec.to_builtins(self.cfg)})
        for query in service.answers:
            self.bus.serve(service.answer_key(query, robot, self.cfg), partial(self._queue_question, query))
        self.bus.serve(status_key(service.name, self.identity.instance), self._answer_status)
        for topic in service.writes:
            if topic.delivery == "job":
                limit = service.job_limit(self.cfg)
                self._pools[topic] = JobPool(self.bus, topic, time.monotonic, self._job_ended(topic), limit=limit)
        for topic in service.reads:
            self.bus.subscribe(topic, topic.pattern(robot), self.inbox.offer, self._missed)
        if service.drive is not None:
            self.bus.subscribe(JOURNAL, JOURNAL.pattern(robot), self._saw_consumed, lambda topic, number: None)
            self.bus.watch(alive_key("*", "*"), self._saw_alive)
        if service.job is not None:
            run_key, live_key = worker_keys(service.job, self.identity.instance, service.job_group(self.cfg))
            self.bus.serve(run_key, self._offer_work)
            self.bus.announce(live_key)
        self.bus.announce(alive_key(service.name, self.identity.instance))

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
        while time.monotonic() < end_s and (item := self.inbox.take()) is not None:
            self._handle(item)

    def _handle(self, item: Any) -> None:
        match item:
            case Sample():
                self._handle_sample(item)
            case Tick():
                self._step(item)
                self._journal("Tick", inline=encode(item))
            case Reply():
                self._handle_reply(item)
            case Question():
                self._handle_question(item)
            case Work():
                self._handle_work(item)
            case JobDone():
                self._step(item)
            case Fed():
                self._step(item.message)
                self._loop.call_soon_threadsafe(item.done)

    def _handle_sample(self, sample: Sample) -> None:
        message = self._decoded(sample.topic.type, sample.payload, sample.topic.name, sample.key, sample.writer)
        if message is None:
            return
        counts = self.inbox.of(sample.topic.name)
        counts.last_age_ms = (time.time_ns() - sample.sent_ns) / 1e6 if sample.sent_ns else -1.0
        self._step(message)
        counts.consumed += 1
        known = bool(sample.writer)
        self._journal(
            sample.topic.name,
            frame_id=getattr(message, "frame_id", -1),
            writer=sample.writer,
            sequence=sample.sequence if known else -1,
            inline=b"" if known else sample.payload,
            key=sample.key,
        )

    def _handle_reply(self, reply: Reply) -> None:
        query = reply.ask.query
        message = self._decoded(query.reply, reply.payload, query.name, query.key, "")
        if message is None:
            self._loop.call_soon_threadsafe(self._loop.call_later, ASK_RETRY_S, self._call_again, reply.ask)
            return
        self._asks.pop((query.name, encode(reply.ask.request)), None)
        self._step(message)
        self._journal(query.name, inline=reply.payload)

    def _handle_question(self, question: Question) -> None:
        query = question.query
        request = self._decoded(query.request, question.request.payload, query.name, query.key, "")
        if request is None:
            question.request.refuse(f"the request is not a valid {query.request.__name__}")
            return
        self.inbox.of(query.name).consumed += 1
        try:
            answer = encode(self.service.answers[query](self._state, request, self.cfg))
        except Exception as error:  # an answer changes no state: a question it cannot take must not end the service
            log.exception("question not answered", extra={"query": query.name})
            question.request.refuse(f"{query.name}: {error}")
            return
        question.request.reply(answer)

    def _handle_work(self, work: Work) -> None:
        job = self.service.job
        assert job is not None
        message = work.message
        self._slots.release()
        if message is None:
            work.request.refuse("malformed")
            return
        self.inbox.of(job.name).consumed += 1
        if self.service.prepare is not None:
            self.service.prepare(self._state, [message, *self._waiting_jobs()], self.cfg)
        try:
            self._step(message)
        except Exception as error:  # jobs are independent of each other: one that cannot be done ends no worker
            log.exception("job failed", extra={"topic": job.name, "frame_id": getattr(message, "frame_id", -1)})
            work.request.refuse(f"failed: {error}")
            return
        self._journal(job.name, frame_id=getattr(message, "frame_id", -1))
        work.request.reply(b"done")

    def _queue_question(self, query: Query, request: Request) -> None:
        """Questions come first: they change nothing, and whoever asks waits."""
        self.inbox.put(Question(query, request), first=True)

    def _offer_work(self, request: Request) -> None:
        job = self.service.job
        assert job is not None
        if self._slots.acquire(blocking=False):
            message = self._decoded(job.type, request.payload, job.name, job.key, "")
            self.inbox.put(Work(request, message))
        else:
            request.refuse("busy")

    def _waiting_jobs(self) -> list[Message]:
        """Jobs taken in and not begun, oldest first."""
        waiting = (item.message for item in self.inbox.waiting() if isinstance(item, Work))
        return [message for message in waiting if message is not None]

    def _decoded(self, kind: type[Message], payload: bytes, name: str, key: str, writer: str) -> Message | None:
        """The message, or None after counting and logging that it is malformed."""
        try:
            return decode(kind, payload)
        except DecodeError as error:
            self.inbox.of(name).malformed += 1
            log.warning(
                "malformed message dropped",
                extra={"topic": name, "key": key, "writer": writer, "why": str(error)[:200]},
            )
            return None

    def _step(self, message: Message) -> None:
        started_s = time.monotonic()
        for output in self.service.step(self._state, message, self.cfg):
            if isinstance(output, Ask):
                self._ask(output)
            else:
                self._publish(*output)
        ended_s = time.monotonic()
        self._steps.append((ended_s, ended_s - started_s))

    def _publish(self, topic: Topic, message: Message) -> None:
        self.service.check_write(topic)
        self.inbox.of(topic.name).published += 1
        if topic.delivery == "job":
            job_id = (message.robot, message.frame_id)  # type: ignore[attr-defined]
            group = getattr(message, "space", "")  # of a back-fill, which gives way to the stream
            self._pools[topic].submit(job_id, encode(message), group, later=bool(group))
        else:
            self._put(topic, message)

    def _put(self, topic: Topic, message: Message) -> None:
        key = topic.key_of(message)
        sequence = self._sequences.get(key, 0)
        self._sequences[key] = sequence + 1
        if topic is not JOURNAL:
            self._progress.published(topic.name, sequence)
        self.bus.put(topic, key, encode(message), pack_header(self.writer, sequence, time.time_ns()))

    def _journal(self, topic: str, **fields: Any) -> None:
        """One more input is finished with; `fields` are those of `Consumed` that say which."""
        entry = Consumed(
            robot=self.identity.robot if self.identity.robot != "*" else "fleet",
            service=self.service.name,
            instance=self.identity.instance,
            order=self._order,
            topic=topic,
            **fields,
        )
        self._order += 1
        self._put(JOURNAL, entry)

    def _ask(self, ask: Ask) -> None:
        self.service.check_ask(ask)
        name = (ask.query.name, encode(ask.request))
        if name not in self._asks:
            self._asks[name] = ask
            self._call(ask)

    def _call(self, ask: Ask) -> None:
        if isinstance(ask.query, Errand):
            self._loop.call_soon_threadsafe(self._run_errand, ask)
            return

        def answered(answer: Answer) -> None:
            if answer.payload is not None:
                self.inbox.put(Reply(ask, answer.payload))
            else:
                log.debug("no answer yet", extra={"query": ask.query.name, "reason": answer.reason})
                self._loop.call_soon_threadsafe(self._loop.call_later, ASK_RETRY_S, self._call_again, ask)

        self.bus.call(ask.query.key_of(ask.request), encode(ask.request), ASK_TIMEOUT_S, answered)

    def _run_errand(self, ask: Ask) -> None:
        async def work() -> None:
            reply = await self._errands[ask.query](ask.request)  # type: ignore[index]
            self.inbox.put(Reply(ask, encode(reply)))

        task = self._loop.create_task(work())
        self._running.add(task)
        task.add_done_callback(self._errand_ended)

    def _errand_ended(self, task: asyncio.Task) -> None:
        self._running.discard(task)
        if not task.cancelled() and (error := task.exception()) is not None and not self._fault.done():
            self._fault.set_exception(error)

    def _call_again(self, ask: Ask) -> None:
        if not self.stopping.is_set():
            self._loop.run_in_executor(None, self._call, ask)

    def _job_ended(self, topic: Topic) -> Callable[[Ended], None]:
        def ended(job: Ended) -> None:
            if job.error:
                log.warning("job given up", extra={"topic": topic.name, "job": str(job.id), "reason": job.error})
            _, frame_id = cast(tuple[str, int], job.id)
            done = JobDone(
                topic=topic.name, frame_id=frame_id, worker=job.worker, attempts=job.attempts, error=job.error
            )
            self.inbox.put(done)
            self._progress.changed(self._loop)

        return ended

    async def _tick(self, period_s: float) -> None:
        while True:
            await asyncio.sleep(period_s)
            self.inbox.put(Tick(stamp_ns=time.time_ns()), once="tick")

    async def _drive(self) -> None:
        assert self.service.drive is not None
        await self.service.drive(Port(self), self.cfg)

    def _missed(self, topic: Topic, number: int) -> None:
        self.inbox.missed(topic.name, number)
        log.warning("samples lost", extra={"topic": topic.name, "number": number})

    def _saw_consumed(self, sample: Sample) -> None:
        try:
            entry = decode(Consumed, sample.payload)
            if entry.topic == "START":
                self._progress.reader(entry.instance, decode(Started, entry.inline).reads)
            else:
                own = entry.writer == self.writer
                self._progress.consumed(entry.instance, entry.topic, entry.sequence if own else -1)
        except DecodeError as error:
            self.inbox.of(JOURNAL.name).malformed += 1
            log.warning("malformed message dropped", extra={"topic": JOURNAL.name, "why": str(error)[:200]})
        self._progress.changed(self._loop)

    def _saw_alive(self, key: str, alive: bool) -> None:
        self._progress.alive(key.rsplit("/", 1)[-1], alive)
        self._progress.changed(self._loop)

    def _answer_status(self, request: Request) -> None:
        if request.payload:
            try:
                decode(StatusRequest, request.payload)
            except DecodeError:
                self.inbox.of("STATUS").malformed += 1
                request.refuse("the request is not a valid StatusRequest")
                return
        request.reply(encode(self.status()))

    def status(self) -> ServiceStatus:
        """Health of this process now."""
        now_s = time.monotonic()
        steps = list(self._steps)
        durations_ms = sorted(1e3 * duration for _, duration in steps)
        cuts = quantiles(durations_ms, n=100) if len(durations_ms) > 1 else durations_ms * 99 or [0.0] * 99
        window_s = min(10.0, max(now_s - self._started_s, 1e-3))
        busy_s = sum(duration for end, duration in steps if end > now_s - window_s)
        return ServiceStatus(
            service=self.service.name,
            instance=self.identity.instance,
            robot=self.identity.robot,
            pid=os.getpid(),
            uptime_s=now_s - self._started_s,
            backlog=len(self.inbox),
            busy_share=min(1.0, busy_s / window_s),
            step_ms_p50=cuts[49],
            step_ms_p99=cuts[98],
            resident_mb=psutil.Process().memory_info().rss / 1e6,
            waiting_for=sorted({name for name, _ in list(self._asks)}),
            topics=[TopicCount(topic=name, **vars(counts)) for name, counts in sorted(self.inbox.counts.items())],
        )

    async def _on_thread(self, function: Callable[..., Any], *arguments: Any) -> Any:
        return await self._loop.run_in_executor(self._thread, function, *arguments)


class Port:
    """What a source's `drive` may do."""

    def __init__(self, host: Host) -> None:
        self._host = host
        self.robot = host.identity.robot
        self.stopping = host.stopping

    async def consume(self, message: Message) -> None:
        """Run one step on this message; returns when its outputs are out."""
        done = asyncio.Event()
        self._host.inbox.put(Fed(message, done.set))
        await done.wait()

    async def room(self, window: int) -> None:
        """Wait until somebody reads, readers are at most `window` messages behind, there are workers, and fewer than
        `window` jobs are outstanding."""
        host, said = self._host, False
        while not host.stopping.is_set():
            host._progress.event.clear()
            lags = [host._progress.lag(topic.name) for topic in host.service.writes if topic.delivery == "every"]
            jobs = [pool.outstanding if pool.workers else math.inf for pool in host._pools.values()]
            if max(lags, default=0) <= window and max(jobs, default=0) < window:
                return
            if not said and math.inf in (*lags, *jobs):
                said = True
                log.info("waiting for readers and workers", extra={"lags": lags, "jobs": jobs})
            try:
                await asyncio.wait_for(host._progress.event.wait(), timeout=1.0)
            except TimeoutError:
                continue

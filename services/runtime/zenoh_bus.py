"""The bus over Zenoh. Beside what all sessions share, the router and the session with ROS 2, the only file that imports
zenoh.

Every process is a client of a router on its own host (peers do not relay). `every` uses advanced publishers with a
cache, history for late readers and recovery of missed samples; what these cannot recover is caught by the revisions of
deltas. The encoding of everything sent names its schema; what comes in another version is brought to ours, or refused.
"""

import threading
import time
from collections.abc import Callable
from typing import Any

import zenoh
from zenoh import CongestionControl, ConsolidationMode, Priority, QueryTarget, SampleKind
from zenoh import ext as zx

from prior_sg.schemas.codec import Message, Refused, schema_name
from prior_sg.schemas.migrations import received
from prior_sg.schemas.topics import LARGEST, MB, Query, Topic, called_on, called_with
from prior_sg.services.runtime.bus import (
    NOBODY,
    Answer,
    BusError,
    OnAlive,
    OnAnswer,
    OnMissed,
    OnRequest,
    OnSample,
    Sample,
    unpack_header,
)
from prior_sg.services.runtime.endpoints import check_endpoint, check_host, check_reach, secured, unanswered
from prior_sg.services.runtime.hearing import watch_hearing
from prior_sg.services.runtime.keys import bundle_in_force
from prior_sg.services.runtime.zenoh_session import (
    CLOSE_TIMEOUT_S,
    LOGGED,
    Presence,
    client_config,
    close_within,
    fixed_part,
    quietly,
)

HEARTBEAT_S = 0.3
AGAIN_S = 1.0  # for a second session, where a first has found the router
PRIORITIES = {
    "now": Priority.INTERACTIVE_HIGH,
    "soon": Priority.INTERACTIVE_LOW,
    "data": Priority.DATA,
    "bulk": Priority.DATA_LOW,
}


class ZenohRequest:
    """A request held open until it is answered."""

    def __init__(self, query: zenoh.Query) -> None:
        self._query = query
        self.key = str(query.key_expr)
        request, self._reply = called_with(self.key)
        called = called_on(self.key)
        self._most_bytes = called.most_reply_bytes if isinstance(called, Query) else LARGEST
        self.payload = _payload(request, query.payload, query.encoding, called.most_bytes if called else LARGEST)

    def reply(self, payload: bytes) -> None:
        """Answer; a caller that has gone away is no error. What no router would carry is said instead."""
        if len(payload) > self._most_bytes:
            self.refuse(
                f"the answer has {len(payload) / MB:.0f} MB, and {self._most_bytes / MB:.0f} are carried: ask for less"
            )
            return
        with self._query:
            quietly(lambda: self._query.reply(self.key, payload, encoding=_encoding(self._reply)))

    def refuse(self, reason: str) -> None:
        """Decline."""
        with self._query:
            quietly(lambda: self._query.reply_err(reason.encode()))


class ZenohBus:
    """One session. Raises BusError when no router answers within `wait_s`. `on_deaf` is called once, from a thread of
    its own, when nothing comes in any more though the session is connected (`hearing.watch_hearing`).
    """

    def __init__(self, endpoint: str, wait_s: float = 10.0, *, on_deaf: Callable[[], None] | None = None) -> None:
        zenoh.init_log_from_env_or(LOGGED)
        self._session = self._open(endpoint, wait_s)
        self._presence = Presence(self._session, lambda: self._open(endpoint, AGAIN_S))
        self._publishers: dict[str, Any] = {}
        self._lock = threading.Lock()
        self._entities: list[Any] = []
        self._held: dict[str, zenoh.KeyExpr] = {}
        self._end_watch = watch_hearing(self, on_deaf) if on_deaf is not None else lambda: None

    @staticmethod
    def _open(endpoint: str, wait_s: float) -> zenoh.Session:
        check_endpoint(endpoint)
        bundle = bundle_in_force()
        check_reach(endpoint, with_keys=bundle is not None)
        deadline = time.monotonic() + wait_s
        while True:
            try:
                return zenoh.open(client_config(endpoint, bundle))
            except zenoh.ZError as error:
                if time.monotonic() > deadline:
                    check_host(endpoint)
                    if bundle is not None and secured(endpoint):
                        raise BusError(
                            f"no router answers on {endpoint}, or it takes not the keys in {bundle.folder} "
                            f"(of {bundle.own.name}, until {bundle.own.until}); ask who keeps the authority"
                        ) from error
                    raise BusError(unanswered(endpoint)) from error
                time.sleep(0.2)

    def put(self, topic: Topic, key: str, payload: bytes, header: bytes) -> None:
        """Publish one sample. Raises BusError for one that no router and no reader would take."""
        if len(payload) > topic.most_bytes:
            raise BusError(f"{topic.name}: a message of {len(payload)} bytes, and at most {topic.most_bytes} are taken")
        with self._lock:
            publisher = self._publishers.get(key)
            if publisher is None:
                publisher = self._publishers[key] = self._declare_publisher(topic, key)
        publisher.put(payload, attachment=header)

    def _declare_publisher(self, topic: Topic, key: str) -> Any:
        encoding = _encoding(topic.type)
        if topic.delivery == "latest":
            return self._session.declare_publisher(
                key, encoding=encoding, congestion_control=CongestionControl.DROP, priority=PRIORITIES[topic.priority]
            )
        return zx.declare_advanced_publisher(
            self._session,
            key,
            encoding=encoding,
            congestion_control=CongestionControl.BLOCK,
            priority=PRIORITIES[topic.priority],
            cache=zx.CacheConfig(
                topic.cache,
                replies_config=zx.RepliesConfig(
                    congestion_control=CongestionControl.BLOCK, priority=PRIORITIES[topic.priority]
                ),
            ),
            sample_miss_detection=zx.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=HEARTBEAT_S),
            publisher_detection=True,
        )

    def subscribe(self, topic: Topic, pattern: str, on_sample: OnSample, on_missed: OnMissed) -> Callable[[], None]:
        """Receive samples of a topic."""

        def receive(sample: zenoh.Sample) -> None:
            if sample.kind == SampleKind.PUT:
                header = sample.attachment.to_bytes() if sample.attachment is not None else None
                payload = _payload(topic.type, sample.payload, sample.encoding, topic.most_bytes)
                on_sample(Sample(topic, str(sample.key_expr), payload, *unpack_header(header)))

        self._hold(fixed_part(pattern))
        if topic.delivery == "latest":
            return self._kept(self._session.declare_subscriber(pattern, receive))
        subscriber = zx.declare_advanced_subscriber(
            self._session,
            pattern,
            receive,
            history=zx.HistoryConfig(detect_late_publishers=True, max_samples=topic.cache),
            recovery=zx.RecoveryConfig(periodic_queries=None, heartbeat=True),
            subscriber_detection=True,
        )
        return self._kept(subscriber.sample_miss_listener(lambda miss: on_missed(topic, miss.nb)), subscriber)

    def _hold(self, key: str) -> None:
        """Keep the number that stands for a key within this process as long as the session. Zenoh gives it up with the
        last subscription to the key, or the last server of it, and a sample or a call that is just then under way to
        another one, by that number, is lost.
        """
        with self._lock:
            if key and key not in self._held:
                self._held[key] = self._session.declare_keyexpr(key)

    def _kept(self, *entities: Any) -> Callable[[], None]:
        """Hold on to what is dropped with its last reference; returns what lets go of it."""
        self._entities.extend(entities)

        def end() -> None:
            for entity in entities:
                self._entities.remove(entity)
                quietly(entity.undeclare)

        return end

    def serve(self, key: str, on_request: OnRequest) -> Callable[[], None]:
        """Answer calls on a key expression."""
        self._hold(fixed_part(key))
        return self._kept(
            self._session.declare_queryable(key, lambda query: on_request(ZenohRequest(query)), complete=True)
        )

    def call(self, key: str, payload: bytes, timeout_s: float, on_answer: OnAnswer) -> None:
        """Ask the nearest server of the key."""
        request, reply = called_with(key)
        called = called_on(key)
        self._session.get(
            key,
            _answer_once(reply, on_answer),
            target=QueryTarget.BEST_MATCHING,
            consolidation=ConsolidationMode.NONE,
            congestion_control=CongestionControl.BLOCK,
            priority=PRIORITIES[called.priority] if called else Priority.DATA,
            timeout=timeout_s,
            payload=payload,
            encoding=_encoding(request),
        )

    def announce(self, key: str) -> Callable[[], None]:
        """Be seen."""
        return self._kept(self._session.liveliness().declare_token(key))

    def watch(self, pattern: str, on_alive: OnAlive) -> None:
        """See who comes and goes."""
        self._entities.append(
            self._presence.watch(pattern, lambda sample: on_alive(str(sample.key_expr), sample.kind == SampleKind.PUT))
        )

    def announced(self, pattern: str, timeout_s: float) -> set[str]:
        """The keys announced now, as the router knows them."""
        replies = self._presence.ask(pattern, timeout_s)
        if any(reply.ok is None for reply in replies) or not self.connected():
            raise BusError(
                f"the router has not said within {timeout_s:g} s who is there, so it is busy or gone; try again, or "
                "start it again"
            )
        return {str(reply.ok.key_expr) for reply in replies if reply.ok is not None}

    def connected(self) -> bool:
        """Whether the router is there."""
        return bool(self._session.info.routers_zid())

    def close(self) -> None:
        """Leave the bus, within a bound."""
        self._end_watch()
        self._presence.close()
        readers = [entity for entity in self._entities if isinstance(entity, zenoh.Subscriber | zx.AdvancedSubscriber)]
        close_within(self._session, CLOSE_TIMEOUT_S, readers)


def _encoding(kind: type[Message] | None) -> zenoh.Encoding:
    encoding = zenoh.Encoding("application/msgpack")
    return encoding if kind is None else encoding.with_schema(schema_name(kind))


def _payload(
    kind: type[Message] | None, payload: zenoh.ZBytes | None, encoding: zenoh.Encoding | None, most_bytes: int = LARGEST
) -> bytes:
    """What has arrived, in our version where it is a message; what is too large is refused before it is looked at."""
    if payload is not None and len(payload) > most_bytes:
        return Refused(f"it has {len(payload)} bytes, and at most {most_bytes} are taken there")
    data = b"" if payload is None else payload.to_bytes()
    schema = "" if encoding is None else str(encoding).partition(";")[2]
    return data if kind is None or not data else received(kind, data, schema)


def _answer_once(kind: type[Message] | None, on_answer: OnAnswer) -> Any:
    """A reply handler that calls back exactly once: with the first reply, or at the end with the reason for none."""
    answered = threading.Event()

    def receive(reply: zenoh.Reply) -> None:
        if answered.is_set():
            return
        answered.set()
        if reply.ok is not None:
            on_answer(Answer(_payload(kind, reply.ok.payload, reply.ok.encoding)))
        else:
            reason = reply.err.payload.to_string() if reply.err is not None else NOBODY
            on_answer(Answer(None, "timeout" if reason == "Timeout" else reason))

    def finish() -> None:
        if not answered.is_set():
            answered.set()
            on_answer(Answer(None, NOBODY))

    return zenoh.handlers.Callback(receive, finish)

"""The bus every service talks through, and the same bus inside one process.

Callbacks are called on a foreign thread: they must only enqueue and return.
"""

import itertools
import re
import struct
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from functools import lru_cache
from typing import Any, Protocol

import msgspec

from prior_sg.schemas.codec import DecodeError, decode
from prior_sg.schemas.topics import Topic
from prior_sg.services.errors import PriorSgError

HEADER = struct.Struct("<Qq")
NOBODY = "nobody"  # the reason of a call that found no server
WRITER = re.compile(r"[\w.:-]+(/[\w.:-]+)*")
LONGEST_WRITER = 256  # bytes of a writer's name and its context
TRACEPARENT = re.compile(r"00-(?!0{32})[0-9a-f]{32}-(?!0{16})[0-9a-f]{16}-[0-9a-f]{2}")


class BusError(PriorSgError):
    """The bus cannot do what was asked; the message says what to do."""


class Sample(msgspec.Struct, frozen=True):
    """One received sample, not decoded yet. `writer` is empty when the sender did not say who it is.

    The payload is of this program's version of the message; one that cannot be brought to it is refused when decoded.
    """

    topic: Topic
    key: str
    payload: bytes
    writer: str
    sequence: int
    sent_ns: int
    traceparent: str = ""  # the sender's context, as W3C's Trace Context writes it; empty = it told none


def message_in(sample: Sample) -> Any:
    """The message of the topic's type that a sample holds. Raises DecodeError, also for one of another key."""
    message = decode(sample.topic.type, sample.payload)
    if fault := sample.topic.fault_of(sample.key, message):
        raise DecodeError(fault)
    return message


class Request(Protocol):
    """A question received by a server; it must be answered exactly once, from any thread."""

    payload: bytes
    key: str  # on which it was asked

    def reply(self, payload: bytes) -> None:
        """Answer."""

    def refuse(self, reason: str) -> None:
        """Decline; the caller gets the reason."""


@dataclass(frozen=True)
class Answer:
    """What came back from a call: a payload, or why there is none (`nobody`, `timeout`, or the server's reason)."""

    payload: bytes | None
    reason: str = ""


OnSample = Callable[[Sample], None]
OnRequest = Callable[[Request], None]
OnAnswer = Callable[[Answer], None]
OnMissed = Callable[[Topic, int], None]
OnAlive = Callable[[str, bool], None]


class Bus(Protocol):
    """Publish, subscribe, call, serve, and tell who is alive."""

    def put(self, topic: Topic, key: str, payload: bytes, header: bytes) -> None:
        """Publish one sample with the topic's delivery."""

    def subscribe(self, topic: Topic, pattern: str, on_sample: OnSample, on_missed: OnMissed) -> Callable[[], None]:
        """Receive samples; for `every`, also those published shortly before. Returns what ends it."""

    def serve(self, key: str, on_request: OnRequest) -> Callable[[], None]:
        """Answer calls on a key. Returns what ends it."""

    def call(self, key: str, payload: bytes, timeout_s: float, on_answer: OnAnswer) -> None:
        """Ask whoever serves the key; the answer arrives in the callback, always exactly once."""

    def announce(self, key: str) -> Callable[[], None]:
        """Be seen under this key until closed or dead. Returns what ends it."""

    def watch(self, pattern: str, on_alive: OnAlive) -> None:
        """See announced keys come and go, beginning with those already there."""

    def announced(self, pattern: str, timeout_s: float) -> set[str]:
        """The keys announced now, by anybody. Raises BusError without an answer, which is not the same as nobody."""

    def connected(self) -> bool:
        """Whether others can be reached now."""

    def close(self) -> None:
        """Leave the bus."""


def pack_header(writer: str, sequence: int, sent_ns: int, traceparent: str = "") -> bytes:
    """Who sent a sample and as which of its samples on that key, and in which context if it has one: an older program
    then reads the sample as one of an unknown writer."""
    return HEADER.pack(sequence, sent_ns) + (f"{writer};{traceparent}" if traceparent else writer).encode()


def unpack_header(header: bytes | None) -> tuple[str, int, int, str]:
    """Writer, sequence, time of sending and context; an absent or damaged header gives an unknown writer."""
    if header is None or not HEADER.size < len(header) <= HEADER.size + LONGEST_WRITER:
        return "", -1, 0, ""
    sequence, sent_ns = HEADER.unpack_from(header)
    writer, context = _who(header[HEADER.size :])
    return (writer, sequence, sent_ns, context) if writer else ("", -1, 0, "")


@lru_cache(maxsize=256)  # few write, and each says who it is with every sample
def _who(said: bytes) -> tuple[str, str]:
    """Writer and context, each empty where it is not one."""
    writer, _, context = said.decode(errors="replace").partition(";")
    return writer if WRITER.fullmatch(writer) else "", context if TRACEPARENT.fullmatch(context) else ""


def key_matches(pattern: str, key: str) -> bool:
    """Whether a key matches an expression in which `*` stands for one chunk and a final `**` for any rest."""
    parts, chunks = pattern.split("/"), key.split("/")
    if parts[-1] == "**":
        parts, chunks = parts[:-1], chunks[: len(parts) - 1]
    return len(parts) == len(chunks) and all(map(fnmatchcase, chunks, parts))


@dataclass
class LocalRequest:
    """A request on the local bus."""

    payload: bytes
    key: str
    on_answer: OnAnswer

    def reply(self, payload: bytes) -> None:
        """Answer."""
        self.on_answer(Answer(payload))

    def refuse(self, reason: str) -> None:
        """Decline."""
        self.on_answer(Answer(None, reason))


@dataclass
class Hub:
    """What the local buses of one process share."""

    lock: threading.RLock = field(default_factory=threading.RLock)
    ids: "itertools.count[int]" = field(default_factory=itertools.count)
    subscribers: list[tuple[int, Topic, str, OnSample]] = field(default_factory=list)
    history: dict[str, list[Sample]] = field(default_factory=dict)
    servers: dict[str, tuple[int, OnRequest]] = field(default_factory=dict)
    tokens: dict[str, int] = field(default_factory=dict)
    watchers: list[tuple[int, str, OnAlive]] = field(default_factory=list)


class LocalBus:
    """The bus inside one process, for tests, replay and debugging: one instance per service, joined by a hub."""

    def __init__(self, hub: Hub) -> None:
        self._hub = hub
        self._id = next(hub.ids)

    def put(self, topic: Topic, key: str, payload: bytes, header: bytes) -> None:
        """Deliver to every matching subscriber at once; keep the newest for later ones."""
        sample = Sample(topic, key, payload, *unpack_header(header))
        with self._hub.lock:
            if topic.cache:
                kept = self._hub.history.setdefault(key, [])
                kept.append(sample)
                del kept[: -topic.cache]
            for _, wanted, pattern, on_sample in list(self._hub.subscribers):
                if wanted is topic and key_matches(pattern, key):
                    on_sample(sample)

    def subscribe(self, topic: Topic, pattern: str, on_sample: OnSample, on_missed: OnMissed) -> Callable[[], None]:
        """Receive samples and the kept history."""
        entry = (self._id, topic, pattern, on_sample)
        with self._hub.lock:
            for key, kept in self._hub.history.items():
                for sample in kept:
                    if sample.topic is topic and key_matches(pattern, key):
                        on_sample(sample)
            self._hub.subscribers.append(entry)
        return lambda: self._unsubscribe(entry)

    def _unsubscribe(self, entry: "tuple[int, Topic, str, OnSample]") -> None:
        hub = self._hub
        with hub.lock:
            hub.subscribers = [one for one in hub.subscribers if one is not entry]

    def serve(self, key: str, on_request: OnRequest) -> Callable[[], None]:
        """Answer calls on a key expression."""
        with self._hub.lock:
            self._hub.servers[key] = entry = (self._id, on_request)
        return lambda: self._withdraw_server(key, entry)

    def _withdraw_server(self, key: str, entry: tuple[int, OnRequest]) -> None:
        with self._hub.lock:
            if self._hub.servers.get(key) is entry:
                del self._hub.servers[key]

    def call(self, key: str, payload: bytes, timeout_s: float, on_answer: OnAnswer) -> None:
        """Ask the first server whose expression matches."""
        with self._hub.lock:
            server = next((s for pattern, (_, s) in self._hub.servers.items() if key_matches(pattern, key)), None)
        if server is None:
            on_answer(Answer(None, NOBODY))
        else:
            server(LocalRequest(payload, key, on_answer))

    def announce(self, key: str) -> Callable[[], None]:
        """Be seen."""
        with self._hub.lock:
            self._hub.tokens[key] = self._id
            self._tell(key, True)
        return lambda: self._withdraw(key)

    def _withdraw(self, key: str) -> None:
        with self._hub.lock:
            if self._hub.tokens.get(key) == self._id:
                del self._hub.tokens[key]
                self._tell(key, False)

    def announced(self, pattern: str, timeout_s: float) -> set[str]:
        """The keys announced now."""
        with self._hub.lock:
            return {key for key in self._hub.tokens if key_matches(pattern, key)}

    def connected(self) -> bool:
        """Always."""
        return True

    def watch(self, pattern: str, on_alive: OnAlive) -> None:
        """See who comes and goes."""
        with self._hub.lock:
            self._hub.watchers.append((self._id, pattern, on_alive))
            for key in self._hub.tokens:
                if key_matches(pattern, key):
                    on_alive(key, True)

    def close(self) -> None:
        """Leave the hub."""
        hub = self._hub
        with hub.lock:
            hub.subscribers = [entry for entry in hub.subscribers if entry[0] != self._id]
            hub.watchers = [entry for entry in hub.watchers if entry[0] != self._id]
            hub.servers = {key: entry for key, entry in hub.servers.items() if entry[0] != self._id}
            gone = [key for key, owner in hub.tokens.items() if owner == self._id]
            for key in gone:
                del hub.tokens[key]
                self._tell(key, False)

    def _tell(self, key: str, alive: bool) -> None:
        for _, pattern, on_alive in self._hub.watchers:
            if key_matches(pattern, key):
                on_alive(key, alive)

"""One node of ROS 2 on a Zenoh router: publishers, subscriptions, services, and who else is there."""

import hashlib
import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import zenoh
from zenoh import CongestionControl, ConsolidationMode, QueryTarget, SampleKind
from zenoh import ext as zx

from prior_sg.services.runtime.bus import BusError
from prior_sg.services.runtime.endpoints import check_endpoint, check_host, secured
from prior_sg.services.runtime.keys import bundle_in_force
from prior_sg.services.runtime.ros import wire
from prior_sg.services.runtime.ros.wire import Attachment, Channel, Entity, WireError
from prior_sg.services.runtime.zenoh_session import CLOSE_TIMEOUT_S, Presence, client_config, close_within, quietly

log = logging.getLogger(__name__)
ENDPOINT = "tcp/127.0.0.1:7447"  # where rmw_zenohd listens
HEARTBEAT_S = 0.5
ANSWER_S = 2.0


class RosError(BusError):
    """A service of ROS gave no answer; the text is one sentence."""


@dataclass(frozen=True)
class Received:
    """A message as it came."""

    topic: str
    payload: bytes
    attachment: Attachment
    received_ns: int


OnReceived = Callable[[Received], None]  # called on a thread of Zenoh's: only enqueue
OnFault = Callable[[str, str], None]  # topic, and why a message of it cannot be taken
OnEntity = Callable[[Entity, bool], None]  # who, and whether it is there


class Publisher:
    """Of one topic."""

    def __init__(self, publisher: Any, entity: Entity) -> None:
        self._publisher, self._gid, self._sequence = publisher, _gid(entity), 0
        self._lock = threading.Lock()

    def publish(self, payload: bytes) -> None:
        """Send a message of CDR."""
        with self._lock:
            self._sequence += 1
            attachment = Attachment(self._sequence, time.time_ns(), self._gid)
            self._publisher.put(payload, attachment=attachment.written())


class RosSession:
    """A node, declared as long as the session is open."""

    def __init__(self, endpoint: str = ENDPOINT, node: str = "prior_sg", domain: int = 0, wait_s: float = 5.0) -> None:
        """Raises BusError when no router answers within `wait_s`, and WireError for names that cannot be."""
        wire.check_domain(domain)
        self.endpoint, self.domain, self._node = endpoint, domain, node
        self._session = _open(endpoint, wait_s)
        self._presence = Presence(self._session, lambda: _open(endpoint, ANSWER_S))
        self._zid = str(self._session.info.zid())
        self._entities: list[Any] = []
        self._number = 0
        self._declare(wire.NODE)

    def publisher(self, channel: Channel) -> Publisher:
        """Declare a publisher; of a latched topic late subscribers get the last `depth` messages. Raises WireError."""
        latched: dict[str, Any] = {}
        if channel.quality.latched:
            latched = {
                "cache": zx.CacheConfig(channel.quality.depth),
                "sample_miss_detection": zx.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=HEARTBEAT_S),
                "publisher_detection": True,
            }
        congestion = CongestionControl.BLOCK if channel.quality.latched else CongestionControl.DROP
        key = wire.data_key(self.domain, channel)
        publisher = zx.declare_advanced_publisher(self._session, key, congestion_control=congestion, **latched)
        self._entities.append(publisher)
        return Publisher(publisher, self._declare(wire.PUBLISHER, channel))

    def subscribe(self, channel: Channel, on_received: OnReceived, on_fault: OnFault) -> None:
        """Receive messages by every publisher whose definition has the channel's hash, or that knows no hashes.

        Raises WireError.
        """

        def receive(sample: zenoh.Sample) -> None:
            if sample.kind != SampleKind.PUT:
                return
            try:
                wire.check_hash(str(sample.key_expr), channel.hash)
                attachment = wire.read_attachment(_bytes(sample.attachment))
            except WireError as error:
                on_fault(channel.name, str(error))
                return
            on_received(Received(channel.name, sample.payload.to_bytes(), attachment, time.time_ns()))

        latched: dict[str, Any] = {}
        if channel.quality.latched:
            latched = {
                "history": zx.HistoryConfig(detect_late_publishers=True, max_samples=channel.quality.depth),
                "recovery": zx.RecoveryConfig(periodic_queries=None, heartbeat=True),
                "subscriber_detection": True,
            }
        key = wire.data_key(self.domain, replace(channel, hash="*"))
        self._entities.append(zx.declare_advanced_subscriber(self._session, key, receive, **latched))
        self._declare(wire.SUBSCRIPTION, channel)

    def serve(self, channel: Channel, answer: Callable[[bytes], bytes], on_fault: OnFault) -> None:
        """Answer calls of a service, one at a time; `answer` takes and gives CDR, and may raise ValueError.

        Raises WireError.
        """
        key = wire.data_key(self.domain, channel)

        def reply(query: zenoh.Query) -> None:
            with query:
                try:
                    asked = wire.read_attachment(_bytes(query.attachment))
                    payload = answer(_bytes(query.payload) or b"")
                except ValueError as error:
                    said = str(error)
                    on_fault(channel.name, said)
                    quietly(lambda: query.reply_err(said.encode()))
                    return
                attachment = Attachment(asked.sequence, time.time_ns(), asked.gid)
                quietly(lambda: query.reply(key, payload, attachment=attachment.written()))

        self._entities.append(self._session.declare_queryable(key, reply, complete=True))
        self._declare(wire.SERVER, channel)

    def client(self, channel: Channel) -> "Client":
        """A client of a service. Raises WireError."""
        key = wire.data_key(self.domain, channel)
        return Client(self._session, key, channel.name, _gid(self._declare(wire.CLIENT, channel)))

    def entities(self, timeout_s: float = ANSWER_S) -> list[Entity]:
        """Everybody who is there now, but this node."""
        found = []
        for reply in self._presence.ask(wire.token_pattern(self.domain), timeout_s):
            entity = _read(str(reply.ok.key_expr)) if reply.ok is not None else None
            if entity is not None and entity.session != self._zid:
                found.append(entity)
        return sorted(found, key=Entity.token)

    def watch(self, on_entity: OnEntity) -> None:
        """See who is there, comes and goes."""

        def seen(sample: zenoh.Sample) -> None:
            entity = _read(str(sample.key_expr))
            if entity is not None and entity.session != self._zid:
                on_entity(entity, sample.kind == SampleKind.PUT)

        self._entities.append(self._presence.watch(wire.token_pattern(self.domain), seen))

    def close(self) -> None:
        """Leave, within a bound; who is no longer there is told first, so that nothing comes for nobody."""
        self._presence.close()
        close_within(self._session, CLOSE_TIMEOUT_S, reversed(self._entities))

    def __enter__(self) -> "RosSession":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _declare(self, kind: str, channel: Channel | None = None) -> Entity:
        """Be seen as an entity of this node."""
        if channel is not None and not channel.name.startswith("/"):
            channel = replace(channel, name=f"/{channel.name}")
        entity = Entity(kind, self.domain, self._zid, 0, self._number, self._node, channel=channel)
        self._number += 1
        self._entities.append(self._session.liveliness().declare_token(entity.token()))
        return entity


class Client:
    """Of one service."""

    def __init__(self, session: zenoh.Session, key: str, service: str, gid: bytes) -> None:
        self._session, self._key, self._service, self._gid, self._sequence = session, key, service, gid, 0

    def call(self, request: bytes, timeout_s: float = ANSWER_S) -> bytes:
        """The reply to a request, both of CDR. Raises RosError."""
        self._sequence += 1
        attachment = Attachment(self._sequence, time.time_ns(), self._gid)
        replies = self._session.get(
            self._key,
            target=QueryTarget.ALL_COMPLETE,
            consolidation=ConsolidationMode.NONE,
            timeout=timeout_s,
            payload=request,
            attachment=attachment.written(),
        )
        said = "nobody serves it"
        for reply in replies:
            if reply.ok is not None:
                return reply.ok.payload.to_bytes()
            said = reply.err.payload.to_string() if reply.err is not None else said
        raise RosError(f"the service {self._service} gives no answer: {said}")


def _open(endpoint: str, wait_s: float) -> zenoh.Session:
    """A session with a router of ROS, which need not be encrypted: that is its owner's choice. Raises BusError."""
    zenoh.init_log_from_env_or("error")
    check_endpoint(endpoint)
    bundle = bundle_in_force() if secured(endpoint) else None
    deadline = time.monotonic() + wait_s
    while True:
        try:
            return zenoh.open(client_config(endpoint, bundle))
        except zenoh.ZError as error:
            if time.monotonic() > deadline:
                check_host(endpoint)
                raise BusError(
                    f"no Zenoh router of ROS answers on {endpoint}: start one (`ros2 run rmw_zenoh_cpp rmw_zenohd`), "
                    "or name another: ros2:/tcp/HOST:PORT, or --ros-router tcp/HOST:PORT of the bridge"
                ) from error
            time.sleep(0.2)


def _read(key: str) -> Entity | None:
    try:
        return wire.read_token(key)
    except WireError as error:
        log.info("token not read", extra={"why": str(error)})
        return None


def _gid(entity: Entity) -> bytes:
    """Sixteen bytes that no other entity has. rmw_zenoh takes another hash of the token, which nobody checks."""
    return hashlib.blake2b(entity.token().encode(), digest_size=wire.GID_BYTES).digest()


def _bytes(data: "zenoh.ZBytes | None") -> bytes | None:
    return None if data is None else data.to_bytes()

"""What all sessions with Zenoh share: how they find their router, what they carry, who is there, how they end."""

import contextlib
import json
import threading
from collections.abc import Callable, Iterable
from itertools import takewhile
from typing import Any

import zenoh

from prior_sg.schemas.topics import LARGEST
from prior_sg.services.runtime.endpoints import secured
from prior_sg.services.runtime.keys import Bundle

CLOSE_TIMEOUT_S = 3.0
LEASE_MS = 2000
CONNECT_MS = 3000
RETRY = {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 1.5}
HEAD_BYTES = 65536  # of key, header and encoding beside a message
LOGGED = "error"
STAMPS = {"enabled": False}  # writers number their samples; a stamp of a clock ahead would be an error at each hop
TRANSPORT: dict[str, Any] = {
    "link": {
        "tx": {"lease": LEASE_MS, "keep_alive": 4},
        "rx": {"buffer_size": 4194304, "max_message_size": LARGEST + HEAD_BYTES},
    },
    "shared_memory": {"enabled": False},  # a reader that was stopped would take other bytes: docs/decisions.md
}


def transport_settings(bundle: Bundle | None) -> dict[str, Any]:
    """Zenoh's settings of links, with certificates where there are keys."""
    if bundle is None:
        return TRANSPORT
    return TRANSPORT | {"link": TRANSPORT["link"] | {"tls": bundle.transport()}}


def client_config(endpoint: str, bundle: Bundle | None = None) -> zenoh.Config:
    """Client of one router; dead neighbours are noticed within two seconds."""
    return zenoh.Config.from_json5(
        json.dumps(
            {
                "mode": "client",
                "connect": {
                    "endpoints": [endpoint],
                    "timeout_ms": CONNECT_MS,
                    "retry": RETRY,
                },
                "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
                "timestamping": STAMPS,
                "transport": transport_settings(bundle if secured(endpoint) else None),
            }
        )
    )


def fixed_part(pattern: str) -> str:
    """The chunks of a key expression before its first wild card."""
    return "/".join(takewhile(lambda chunk: "*" not in chunk, pattern.split("/")))


class Presence:
    """Who is there, seen and asked for by one session.

    What a session watches it must not ask for as well: Zenoh 1.10.2 answers such a question partly from what the
    watcher has been told, and what comes behind the router's last word is left out, at times all of it. Such questions
    go over a session of their own.
    """

    def __init__(self, session: zenoh.Session, open_another: Callable[[], zenoh.Session]) -> None:
        """`open_another` opens a session with the same router."""
        self._session, self._open_another = session, open_another
        self._watched: list[zenoh.KeyExpr] = []
        self._asking: zenoh.Session | None = None
        self._lock = threading.Lock()

    def watch(self, pattern: str, on_sample: Callable[[zenoh.Sample], None]) -> Any:
        """See who is there, comes and goes, until what is returned is undeclared."""
        self._watched.append(zenoh.KeyExpr(pattern))
        return self._session.liveliness().declare_subscriber(pattern, on_sample, history=True)

    def ask(self, pattern: str, timeout_s: float) -> list[zenoh.Reply]:
        """Who is there now, as the router knows. Raises what `open_another` does."""
        return list(self._asked_over(pattern).liveliness().get(pattern, timeout=timeout_s))

    def _asked_over(self, pattern: str) -> zenoh.Session:
        asked = zenoh.KeyExpr(pattern)
        if not any(asked.intersects(watched) for watched in self._watched):
            return self._session
        with self._lock:
            if self._asking is None:
                self._asking = self._open_another()
            return self._asking

    def close(self) -> None:
        """End the session of its own, within a bound."""
        if self._asking is not None:
            close_within(self._asking, CLOSE_TIMEOUT_S)


def close_within(session: zenoh.Session, timeout_s: float, entities: Iterable[Any] = ()) -> None:
    """Close, but not for longer than the timeout: closing over a broken link can take very long. `entities` of the
    session are withdrawn first: what still comes for one while a session closes is an error to Zenoh.
    """

    def close() -> None:
        for entity in entities:
            quietly(entity.undeclare)
        quietly(session.close)

    closer = threading.Thread(target=close, daemon=True)
    closer.start()
    closer.join(timeout_s)


def quietly(action: Callable[[], Any]) -> None:
    """Run what may fail because the other side, or the session, has gone."""
    with contextlib.suppress(zenoh.ZError):
        action()

"""What all sessions with Zenoh share: how they find their router, what they carry, and how they end."""

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

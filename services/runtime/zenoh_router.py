"""A router of Zenoh in this process: for the processes of its host on loopback, and for those with keys beyond."""

import contextlib
import errno
import json
from collections.abc import Callable
from typing import Any

import zenoh

from prior_sg.services.runtime.bus import BusError
from prior_sg.services.runtime.endpoints import (
    KEYS_NEEDED,
    cannot_listen,
    check_endpoint,
    free_endpoint,
    number_in,
    on_loopback,
    secured,
    without_places,
)
from prior_sg.services.runtime.keys import Beyond
from prior_sg.services.runtime.shaping import size_filters, thinned
from prior_sg.services.runtime.zenoh_session import (
    CLOSE_TIMEOUT_S,
    LOGGED,
    RETRY,
    STAMPS,
    close_within,
    transport_settings,
)

ATTEMPTS = 5
LOGGED_BEYOND = (
    f"{LOGGED},zenoh_link_tls::unicast=warn,zenoh::net::routing::interceptor::access_control=info"  # who is not let in
)


class EndpointTakenError(BusError):
    """Somebody else listens there."""


def router_settings(endpoint: str, beyond: Beyond | None = None) -> dict[str, Any]:
    """Zenoh's settings of a router: for the processes of its host on loopback, and `beyond` for those with keys. On
    loopback alone it gossips: nodes of ROS, which are peers, find each other by that.
    """
    settings: dict[str, Any] = {
        "mode": "router",
        "listen": {"endpoints": [endpoint, *(beyond.listen if beyond else ())]},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": beyond is None}},
        "timestamping": STAMPS,
        "transport": transport_settings(beyond.bundle if beyond else None),
        "low_pass_filter": size_filters(),
    }
    if beyond is not None:
        joined = {"endpoints": list(beyond.join), "timeout_ms": 0, "exit_on_failure": False, "retry": RETRY}
        settings |= {"access_control": beyond.access, "connect": joined}
        if beyond.thin_bps:
            settings = thinned(settings, beyond.thin_bps, beyond.bundle.robots)
    return settings


def check_router(endpoint: str, beyond: Beyond | None) -> None:
    """That nobody without keys reaches the router from another host. Raises BusError."""
    check_endpoint(endpoint)
    if secured(endpoint) or not on_loopback(endpoint):
        raise BusError(
            f"{endpoint} is beyond this host: keep --connect on loopback, and let others join by "
            f"`prior-sg router --listen tls/HOST:PORT`; {KEYS_NEEDED}"
        )
    for other in (*beyond.listen, *beyond.join) if beyond else ():
        check_endpoint(other)
        if not secured(other):
            raise BusError(f"{other} is not encrypted; write it as tls/HOST:PORT")
    if beyond is not None and beyond.listen and beyond.bundle.own.role != "edge":
        raise BusError(f"{beyond.bundle.own.name} has no key of an edge, so nobody would join it; leave out --listen")


def open_router(endpoint: str, beyond: Beyond | None = None) -> Callable[[], None]:
    """Start a router in this process; returns the function that stops it. Raises BusError."""
    check_router(endpoint, beyond)
    zenoh.init_log_from_env_or(LOGGED_BEYOND if beyond else LOGGED)
    try:
        session = zenoh.open(zenoh.Config.from_json5(json.dumps(router_settings(endpoint, beyond))))
    except zenoh.ZError as error:
        said = str(error)
        number = number_in(said)
        kind = EndpointTakenError if number == errno.EADDRINUSE else BusError
        where = " and ".join((endpoint, *(beyond.listen if beyond else ())))
        raise kind(cannot_listen(where, number, without_places(said))) from error
    return lambda: close_within(session, CLOSE_TIMEOUT_S)


def open_free_router(wanted: str) -> tuple[str, Callable[[], None]]:
    """A router on the endpoint wanted or on a free port of the same host: where it listens, and the function that stops
    it. Others may take a port between its being found free and being used. Raises BusError."""
    for _ in range(ATTEMPTS - 1):
        endpoint = free_endpoint(wanted)
        with contextlib.suppress(EndpointTakenError):
            return endpoint, open_router(endpoint)
    endpoint = free_endpoint(wanted)
    return endpoint, open_router(endpoint)

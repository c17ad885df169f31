"""Endpoints of the bus: how they are written, which are free here, and why none can listen."""

import errno
import ipaddress
import re
import socket
from dataclasses import dataclass

from prior_sg.services.runtime.bus import BusError

FORM = re.compile(
    r"(?P<protocol>[a-z]+)/(?P<host>\[[0-9A-Fa-f:.%\w]+\]|[^\[\]:/?#\s]+):(?P<port>[0-9]{1,5})(?P<rest>[?#]\S*)?"
)
KINDS = {
    "tcp": socket.SOCK_STREAM,
    "tls": socket.SOCK_STREAM,
    "ws": socket.SOCK_STREAM,
    "udp": socket.SOCK_DGRAM,
    "quic": socket.SOCK_DGRAM,
}
OF_PATHS = ("unixsock-stream", "unixpipe")
WRITTEN = "--connect takes PROTOCOL/HOST:PORT, for example tcp/127.0.0.1:7447 or tcp/[::1]:7447"
KEYS_NEEDED = "make keys with `prior-sg keys init` and `keys add`, and name them with --keys (docs/security.md)"
OTHER = "choose another with --connect"
SECURED = ("tls",)
OS_ERROR = re.compile(r"os error (\d+)", re.IGNORECASE)


@dataclass(frozen=True)
class Endpoint:
    """`host` without the brackets of an IPv6 address; `rest` is what Zenoh takes after the port."""

    protocol: str
    host: str
    port: int
    rest: str = ""

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{self.protocol}/{host}:{self.port}{self.rest}"

    def addresses(self) -> list[tuple]:
        """What `socket.getaddrinfo` knows of the host. Raises BusError."""
        try:
            return socket.getaddrinfo(self.host, self.port, type=KINDS[self.protocol])
        except (OSError, UnicodeError) as error:
            raise BusError(f"the host {self.host!r} of {self} is not known here; {OTHER}") from error


def parse_endpoint(text: str) -> Endpoint:
    """Raises BusError."""
    match = FORM.fullmatch(text)
    if match is None:
        raise BusError(f"{WRITTEN}; got {text!r}")
    protocol, port = match["protocol"], int(match["port"])
    if protocol not in KINDS:
        raise BusError(f"{WRITTEN}; {protocol!r} is none of the protocols {', '.join(KINDS)}")
    if port > 65535:
        raise BusError(f"{WRITTEN}; the port {port} is above 65535")
    return Endpoint(protocol, match["host"].strip("[]"), port, match["rest"] or "")


def check_endpoint(text: str) -> None:
    """That a client can try to connect there. Raises BusError."""
    if not _of_path(text) and parse_endpoint(text).port == 0:
        raise BusError(f"{text} has the port 0, which only `prior-sg run` takes; name the port of the router")


def on_loopback(text: str) -> bool:
    """Whether only this host's processes reach an endpoint. A name other than `localhost` counts as elsewhere. Raises
    BusError.
    """
    if _of_path(text):
        return True
    host = parse_endpoint(text).host
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def secured(text: str) -> bool:
    """Whether an endpoint is encrypted and both ends show certificates."""
    return text.partition("/")[0] in SECURED


def check_reach(text: str, with_keys: bool) -> None:
    """That an endpoint is on loopback, or secured and keys are there. Raises BusError."""
    if secured(text) and not with_keys:
        raise BusError(f"{text} takes those with keys only; {KEYS_NEEDED}")
    if not secured(text) and not on_loopback(text):
        raise BusError(f"{text} is beyond this host, where anybody could write: use tls/HOST:PORT; {KEYS_NEEDED}")


def check_host(text: str) -> None:
    """That the host of an endpoint is known. Raises BusError."""
    if not _of_path(text):
        parse_endpoint(text).addresses()


def _of_path(text: str) -> bool:
    return text.partition("/")[0] in OF_PATHS


def free_endpoint(wanted: str) -> str:
    """The endpoint wanted, or one on a free port of the same host when its port is 0 or taken. Raises BusError."""
    endpoint = parse_endpoint(wanted)
    family, kind, _, _, address = endpoint.addresses()[0]
    for port in dict.fromkeys((endpoint.port, 0)):
        try:
            return str(Endpoint(endpoint.protocol, endpoint.host, _bound(family, kind, address, port), endpoint.rest))
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise BusError(cannot_listen(wanted, error.errno or 0, str(error.strerror))) from error
    raise BusError(f"no port is free on {endpoint.host}; {OTHER}")


def _bound(family: int, kind: int, address: tuple, port: int) -> int:
    """The number of a port that can be bound now."""
    with socket.socket(family, kind) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        probe.bind((address[0], port, *address[2:]))
        if kind == socket.SOCK_STREAM:
            probe.listen(1)
        return int(probe.getsockname()[1])


def cannot_listen(endpoint: str, number: int, detail: str) -> str:
    """One sentence for why no router can listen, from the number of the system's error (0 = none)."""
    causes = {
        errno.EADDRINUSE: f"it is in use (is another `prior-sg up` or `run` running?); {OTHER}",
        errno.EACCES: f"this user may not use that port; {OTHER} (a port above 1023)",
        errno.EPERM: f"the system does not permit it; {OTHER}",
        errno.EADDRNOTAVAIL: f"that is no address of this host; {OTHER}, for example tcp/127.0.0.1:7447",
        errno.EAFNOSUPPORT: f"this host has no such kind of address (is IPv6 switched off?); {OTHER}, for example "
        "tcp/127.0.0.1:7447",
        errno.EMFILE: "too many files are open in this process; raise the limit (`ulimit -n`)",
        errno.EAGAIN: "no more threads can be started; raise the limit (`ulimit -u`)",
        errno.ENOMEM: "there is not enough memory; raise the limit (`ulimit -v`)",
    }
    return f"no router can listen on {endpoint}: {causes.get(number, f'{detail}; {OTHER}')}"


def unanswered(endpoint: str) -> str:
    """One sentence for a router that is not there."""
    return f"no router answers on {endpoint}; start one with `prior-sg up`, or name another with --connect"


def listened_to(text: str, timeout_s: float = 1.0) -> bool:
    """Whether anything takes connections on an endpoint of TCP or TLS; of another kind, nothing is known: True. Raises
    BusError.
    """
    if _of_path(text) or KINDS[(endpoint := parse_endpoint(text)).protocol] != socket.SOCK_STREAM:
        return True
    endpoint.addresses()
    try:
        socket.create_connection((endpoint.host, endpoint.port), timeout_s).close()
    except OSError:
        return False
    return True


def number_in(said: str) -> int:
    """The system's error number that a message of Zenoh names; 0 = none."""
    found = OS_ERROR.search(said)
    return int(found[1]) if found else 0


def without_places(said: str) -> str:
    """What Zenoh says, without the places in its code."""
    return re.sub(r"\.?\s+at /\S+:\d+\.?", "", said).strip().rstrip(".")

"""Who may come in: the names a server goes by, pages of other origins, and the token."""

import asyncio
import hmac
import ipaddress
import json
import re
import socket
from collections.abc import Awaitable, Callable, Iterable, MutableMapping
from dataclasses import dataclass
from http import HTTPStatus
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from prior_sg.deploy.errors import UsageError, UserError
from prior_sg.services.errors import reason_of

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

LOOPBACK_NAMES = ("localhost", "127.0.0.1", "::1")
SHORTEST_TOKEN, LONGEST_TOKEN = 16, 512  # characters
PROBLEM = "application/problem+json"
PIECE_B = 2**16  # of an answer: what a connection that takes nothing holds in memory
BODY_S = 30.0  # in which the body of a request has to arrive
HOST = re.compile(rb"(\[[0-9a-f:.]+\]|[\w.-]+)(:\d{1,5})?", re.IGNORECASE)


@dataclass(frozen=True)
class Entrance:
    """Where a server listens, and the token that every request must bear; without one, none is asked for."""

    host: str = "127.0.0.1"
    token: str = ""

    def names(self) -> frozenset[str]:
        """What the host may be called by those who come in."""
        own = {socket.gethostname().lower()} if is_wildcard(self.host) else {self.host.lower()}
        return frozenset({*LOOPBACK_NAMES, *own})


def entrance(host: str, token_file: Path | None) -> Entrance:
    """How a server may be entered. Raises UserError where it would stand open to others."""
    token = "" if token_file is None else read_token(token_file)
    if not token and not is_loopback(host):
        raise UsageError(
            f"{host} can be reached from other machines: give --token-file FILE with a secret, or leave it"
        )
    return Entrance(host, token)


def read_token(path: Path) -> str:
    """The token in a file. Raises UserError."""
    try:
        token = path.read_text().strip()
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"cannot read the token in {path} ({reason_of(error)})") from error
    if not SHORTEST_TOKEN <= len(token) <= LONGEST_TOKEN or not token.isascii() or not token.isprintable():
        raise UserError(f"the token in {path} must be one line of {SHORTEST_TOKEN} to {LONGEST_TOKEN} ASCII characters")
    return token


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach what listens there."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def is_wildcard(host: str) -> bool:
    """Whether it stands for every address of this machine."""
    return host in ("0.0.0.0", "::", "")


class Gate:
    """Lets in what calls the server by a name of its own, comes from no page of another origin and bears the token.

    A page that a browser loads from elsewhere can reach loopback under a name that its owner points there; the name in
    the request tells (DNS rebinding). Names that are addresses cannot be pointed anywhere.
    """

    def __init__(self, app: App, entrance: Entrance) -> None:
        self._app, self._token = app, entrance.token.encode()
        self._names, self._wildcard = entrance.names(), is_wildcard(entrance.host)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """An ASGI application around another."""
        if scope["type"] == "lifespan":
            return await self._app(scope, receive, send)
        if scope["type"] != "http":
            return await send({"type": "websocket.close", "code": 1008})
        if (fault := self._fault(_headers(scope["headers"]))) is not None:
            return await refuse(send, *fault)
        return await self._app(scope, patiently(receive), in_pieces(send))

    def _fault(self, headers: dict[bytes, list[bytes]]) -> tuple[int, str] | None:
        hosts, origins = headers.get(b"host", []), headers.get(b"origin", [])
        if headers.keys() >= {b"content-length", b"transfer-encoding"}:
            return 400, "the length of the body is given in two ways, which proxies may read differently: give it once"
        if len(hosts) != 1 or not HOST.fullmatch(hosts[0]) or not self._is_ours(b"//" + hosts[0]):
            return 421, "this server does not go by that name: call it by the address that it was started with"
        if not all(map(self._is_ours, origins)) or _from_elsewhere(headers):
            return 403, "pages of other sites may not ask this server"
        if self._token and not self._bears_token(headers.get(b"authorization", [])):
            return 401, "this server asks for a token: send `Authorization: Bearer TOKEN`"
        return None

    def _is_ours(self, url: bytes) -> bool:
        try:
            name = (urlsplit(url.decode("ascii")).hostname or "").lower()
        except ValueError:
            return False
        return name in self._names or (self._wildcard and _is_address(name))

    def _bears_token(self, given: list[bytes]) -> bool:
        scheme, _, token = given[0].partition(b" ") if len(given) == 1 else (b"", b"", b"")
        return hmac.compare_digest(token.strip(), self._token) and scheme.lower() == b"bearer"


async def refuse(send: Send, status: int, detail: str) -> None:
    """Answer with a problem."""
    body = json.dumps(problem(status, detail)).encode()
    headers = [(b"content-type", PROBLEM.encode()), (b"content-length", str(len(body)).encode())]
    headers += [(b"connection", b"close")]  # whatever follows was meant for somebody else
    headers += [(b"www-authenticate", b"Bearer")] if status == 401 else []
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": body})


def patiently(receive: Receive) -> Receive:
    """What waits for a body until it is over, and then for the end of a connection: as if one whose body does not
    arrive in time had left."""
    end_s = asyncio.get_running_loop().time() + BODY_S
    whole = False

    async def received() -> MutableMapping[str, Any]:
        nonlocal whole
        try:
            async with asyncio.timeout_at(None if whole else end_s):
                message = await receive()
        except TimeoutError:
            return {"type": "http.disconnect"}
        whole = not message.get("more_body", False)
        return message

    return received


def in_pieces(send: Send) -> Send:
    """What sends a large body piece by piece, so that the next one waits until the connection has taken the last."""

    async def sent(message: MutableMapping[str, Any]) -> None:
        rest = memoryview(message.get("body", b""))
        while len(rest) > PIECE_B:
            await send({"type": message["type"], "body": bytes(rest[:PIECE_B]), "more_body": True})
            rest = rest[PIECE_B:]
            message = {**message, "body": rest}
        await send({**message, "body": bytes(rest)} if "body" in message else message)

    return sent


def problem(status: int, detail: str) -> dict[str, Any]:
    """What went wrong, as RFC 9457 has it."""
    return {"status": status, "title": HTTPStatus(status).phrase, "detail": detail}


def _headers(pairs: Iterable[tuple[bytes, bytes]]) -> dict[bytes, list[bytes]]:
    found: dict[bytes, list[bytes]] = {}
    for name, value in pairs:
        found.setdefault(name.lower(), []).append(value)
    return found


def _from_elsewhere(headers: dict[bytes, list[bytes]]) -> bool:
    """Whether a page of another site loads this into itself, as browsers say; a link that was followed is none."""
    sites, uses = headers.get(b"sec-fetch-site", []), headers.get(b"sec-fetch-dest", [])
    return b"cross-site" in sites and uses != [b"document"]


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True

"""Language models over HTTP: one turn in, its text or the reason for none out.

Around the dialects time-outs, retries with back-off and jitter, a pace, a budget and a circuit breaker. The key is read
from the environment or a file, sent in a header to the configured host alone, and taken out of what the server says.
"""

import asyncio
import email.utils
import ipaddress
import logging
import os
import random
import re
import time
from collections.abc import Awaitable, Callable
from datetime import UTC, datetime
from typing import Any
from urllib.parse import urlsplit

import httpx

from prior_sg.schemas.priors import ModelReply, ModelRequest
from prior_sg.services.folders import expanded
from prior_sg.services.prior_gateway.core.config import Config
from prior_sg.services.prior_gateway.outside.dialects import (
    DIALECTS,
    RETRIED,
    Dialect,
    Failed,
    Said,
    excerpt,
    read_said,
)
from prior_sg.services.runtime.service import ServiceError

log = logging.getLogger(__name__)
NEAR = (".local", ".lan", ".internal", ".home.arpa")  # ends of names that no public network has
MOST_REDIRECTS = 3


def is_here(host: str) -> bool:
    """Whether a host is this machine."""
    address = _address(host)
    return host == "localhost" or host.endswith(".localhost") or (address is not None and address.is_loopback)


def is_near(host: str) -> bool:
    """Whether a host is this machine or one of this network, which no proxy has to be asked for."""
    address = _address(host)
    if address is not None:
        return address.is_private or address.is_link_local
    return is_here(host) or "." not in host or host.endswith(NEAR)


def _address(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(host.split("%", maxsplit=1)[0])
    except ValueError:
        return None


class Endpoint:
    """One model behind one URL. Clock, sleep and randomness are arguments, for tests."""

    def __init__(
        self,
        cfg: Config,
        key: str,
        now: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], Awaitable[None]] = asyncio.sleep,
        rng: random.Random | None = None,
    ) -> None:
        self.cfg, self._calls, self._key = cfg, cfg.calls, key
        self._dialect: Dialect = DIALECTS[cfg.provider](cfg)
        self._now, self._sleep, self._rng = now, sleep, rng or random.Random()
        self._next_s = 0.0
        self._failures, self._closed_until_s = 0, 0.0
        self._asked, self._spent_usd = 0, 0.0

    async def ask(self, request: ModelRequest) -> ModelReply:
        """One turn. What can go wrong comes back as `failure` and `reason`, never as an exception."""
        attempts = 0
        end_s = self._now() + self._calls.deadline_s
        while True:
            attempts += 1
            try:
                self._admit()
                await self._pace()
                said = await self._once(request)
            except Failed as error:
                wait_s = max(error.wait_s, self._backoff_s(attempts))
                if error.again and attempts < self._calls.attempts and self._now() + wait_s < end_s:
                    log.info("the model is asked again", extra={"why": str(error), "wait_s": round(wait_s, 1)})
                    await self._sleep(wait_s)
                    continue
                self._note(failed=error.kind not in ("budget", "paused"))
                log.warning("the model gave no answer", extra={"kind": error.kind, "why": str(error)})
                return self._reply(request, attempts, failure=error.kind, reason=str(error))
            self._note(failed=False)
            self._spent_usd += (
                said.tokens_in * self._calls.usd_per_million_in + said.tokens_out * self._calls.usd_per_million_out
            ) / 1e6
            return self._reply(
                request, attempts, text=self._clean(said.text), tokens_in=said.tokens_in, tokens_out=said.tokens_out
            )

    def _reply(self, request: ModelRequest, attempts: int, **fields: Any) -> ModelReply:
        return ModelReply(conversation=request.conversation, turn=request.turn, attempts=attempts, **fields)

    def _clean(self, text: str) -> str:
        return text.replace(self._key, "***") if self._key else text

    def _admit(self) -> None:
        """Raise Failed when the circuit is open or the budget is spent."""
        calls = self._calls
        if (left_s := self._closed_until_s - self._now()) > 0:
            reason = f"the endpoint failed {self._failures} times in a row and is left alone for another {left_s:.0f} s"
            raise Failed("paused", reason, again=False)
        if calls.most_calls and self._asked >= calls.most_calls:
            raise Failed("budget", f"all {calls.most_calls} calls of this process are spent", again=False)
        if calls.most_usd and self._spent_usd >= calls.most_usd:
            raise Failed("budget", f"the budget of {calls.most_usd:g} USD of this process is spent", again=False)
        self._asked += 1

    async def _pace(self) -> None:
        """At most so many requests a minute, evenly spaced."""
        start_s = max(self._now(), self._next_s)
        self._next_s = start_s + 60.0 / self._calls.requests_per_minute
        if (wait_s := start_s - self._now()) > 0:
            await self._sleep(wait_s)

    def _backoff_s(self, attempts: int) -> float:
        """Exponential, with full jitter (never less than half)."""
        most_s = min(self._calls.backoff_s * 2 ** (attempts - 1), self._calls.most_backoff_s)
        return most_s * self._rng.uniform(0.5, 1.0)

    def _note(self, failed: bool) -> None:
        """The circuit opens after several failures in a row; the first call after the pause is a trial."""
        self._failures = self._failures + 1 if failed else 0
        if self._failures >= self._calls.breaker_failures:
            self._closed_until_s = self._now() + self._calls.breaker_s

    async def _once(self, request: ModelRequest) -> Said:
        timeout_s = self._calls.timeout_s
        try:
            async with asyncio.timeout(timeout_s):
                status, headers, content = await self._post(request)
        except (TimeoutError, httpx.TimeoutException) as error:
            raise Failed("timeout", f"no complete answer within {timeout_s:g} s", again=True) from error
        except (httpx.HTTPError, httpx.InvalidURL, httpx.StreamError, OSError, ValueError) as error:
            reason = self._clean(f"{urlsplit(self.cfg.base_url).netloc} cannot be reached ({type(error).__name__})")
            raise Failed("unreachable", reason, again=isinstance(error, httpx.TransportError)) from error
        if status != 200:
            raise self._refused(status, headers, content)
        try:
            return read_said(self._dialect, content, request.max_tokens)
        except Failed as error:
            raise Failed(error.kind, self._clean(str(error)), error.again) from error

    async def _post(self, request: ModelRequest) -> tuple[int, httpx.Headers, bytes]:
        """Status, headers and at most the allowed number of bytes of the answer. A redirect is followed where it leads
        to the same scheme, host and port only: nobody else is sent the key or the question."""
        url = httpx.URL(self.cfg.base_url.rstrip("/") + self._dialect.path)
        async with self._client(url) as client:
            for _ in range(MOST_REDIRECTS + 1):
                status, headers, content = await self._post_to(client, url, request)
                if status not in (307, 308):
                    break
                further = url.join(headers.get("location", ""))
                if (further.scheme, further.host, further.port) != (url.scheme, url.host, url.port):
                    break
                url = further
        return status, headers, content

    def _client(self, url: httpx.URL) -> httpx.AsyncClient:
        """Variables that name a proxy count for far hosts only; the ones for certificates always do."""
        timeout = httpx.Timeout(self._calls.timeout_s, connect=self._calls.connect_s)
        transport = httpx.AsyncHTTPTransport() if is_near(url.host) else None
        return httpx.AsyncClient(timeout=timeout, transport=transport, follow_redirects=False)

    async def _post_to(
        self, client: httpx.AsyncClient, url: httpx.URL, request: ModelRequest
    ) -> tuple[int, httpx.Headers, bytes]:
        most = self._calls.most_answer_bytes
        headers, body = self._dialect.headers(self._key), self._dialect.body(request)
        async with client.stream("POST", url, headers=headers, json=body) as response:
            content = b""
            async for piece in response.aiter_bytes():
                content += piece
                if len(content) > most:
                    raise Failed("too large", f"the answer is larger than {most / 1e6:g} MB", again=False)
            return response.status_code, response.headers, content

    def _refused(self, status: int, headers: httpx.Headers, content: bytes) -> Failed:
        said = excerpt(self._clean(content.decode(errors="replace")))
        reason = f"the server answered {status}" + (f": {said}" if said else "")
        if 300 <= status < 400:
            where = excerpt(self._clean(headers.get("location", "")))
            reason = f"the server answered {status} and sends to {where!r}; set prior_gateway.endpoint to where it is"
        wait_s = retry_after_s(headers.get("retry-after", ""), datetime.now(UTC))
        if wait_s > self._calls.most_backoff_s:
            return Failed("busy", f"the server asks to wait {wait_s:.0f} s ({status})", again=False)
        kind = "busy" if status == 429 else "server" if status >= 500 else "rejected"
        return Failed(kind, reason, again=status in RETRIED, wait_s=wait_s)


def retry_after_s(header: str, now: datetime) -> float:
    """Seconds that a Retry-After header asks for, in either of its forms; 0 when it says nothing sensible."""
    if re.fullmatch(r"\d{1,9}(\.\d+)?", header.strip()):
        return float(header)
    try:
        return max((email.utils.parsedate_to_datetime(header) - now).total_seconds(), 0.0)
    except (TypeError, ValueError):
        return 0.0


def read_key(cfg: Config) -> str:
    """The key, from the file or the variable that the config names. Raises ServiceError, which never shows a key."""
    if cfg.key_file:
        path = expanded(cfg.key_file)
        try:
            key = path.read_text(encoding="utf-8").strip()
        except (OSError, UnicodeDecodeError) as error:
            raise ServiceError(f"prior_gateway.key_file: {path} cannot be read") from error
        where = str(path)
    elif cfg.key_variable:
        where = f"the environment variable {cfg.key_variable}"
        key = os.environ.get(cfg.key_variable, "").strip()
    else:
        return ""
    if not key:
        raise ServiceError(
            f"{where} holds no key for {cfg.provider}; set it, name another with prior_gateway.key_env or "
            "prior_gateway.key_file, or use prior_gateway.provider=library"
        )
    if not key.isascii() or any(c.isspace() for c in key):
        raise ServiceError(f"{where} holds something that is no key: it must be one word of ASCII characters")
    parts = urlsplit(cfg.base_url)
    if parts.scheme != "https" and not is_here(parts.hostname or ""):
        raise ServiceError("prior_gateway.endpoint: a key is sent over https only, or to this machine")
    return key

"""A process's way to the router, through us: it can be cut, be slow, or carry little."""

import asyncio
import contextlib
import threading
from collections.abc import Coroutine
from dataclasses import dataclass, field
from typing import Any

CHUNK_B = 65_536


@dataclass
class Link:
    """One process's way. Change its fields from any thread."""

    held: bool = False  # nothing passes, nobody is told: a cable is out
    refused: bool = False  # connections are refused
    delay_s: float = 0.0  # of each piece
    rate_b_s: float = 0.0  # 0 = as much as there is
    port: int = 0
    transports: set[asyncio.Transport] = field(default_factory=set)


class Proxies:
    """All links of a system to one router's port, served by one thread."""

    def __init__(self, router_port: int) -> None:
        self._router_port = router_port
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="proxies", daemon=True)
        self._thread.start()
        self.links: dict[str, Link] = {}

    def link(self, name: str) -> Link:
        """The link of a process, opened when first asked for."""
        if name not in self.links:
            self.links[name] = self._do(self._open())
        return self.links[name]

    def reset(self, name: str) -> None:
        """Break the connections of a link; what was under way is lost."""
        link = self.links[name]
        self._loop.call_soon_threadsafe(lambda: [transport.abort() for transport in tuple(link.transports)])

    def close(self) -> None:
        """End all."""
        for name in self.links:
            self.reset(name)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(5.0)

    def _do(self, work: Coroutine[Any, Any, Link]) -> Link:
        return asyncio.run_coroutine_threadsafe(work, self._loop).result(5.0)

    async def _open(self) -> Link:
        link = Link()
        server = await asyncio.start_server(lambda *ends: self._join(link, *ends), "127.0.0.1", 0)
        link.port = server.sockets[0].getsockname()[1]
        return link

    async def _join(self, link: Link, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if link.refused:
            writer.transport.abort()
            return
        while link.held:
            await asyncio.sleep(0.05)
        try:
            far_reader, far_writer = await asyncio.open_connection("127.0.0.1", self._router_port)
        except OSError:
            writer.transport.abort()
            return
        link.transports |= {writer.transport, far_writer.transport}
        try:
            await asyncio.gather(_carry(link, reader, far_writer), _carry(link, far_reader, writer))
        finally:
            link.transports -= {writer.transport, far_writer.transport}


async def _carry(link: Link, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    with contextlib.suppress(OSError, asyncio.IncompleteReadError):
        while data := await reader.read(CHUNK_B):
            pause_s = link.delay_s + (len(data) / link.rate_b_s if link.rate_b_s else 0.0)
            if pause_s:
                await asyncio.sleep(pause_s)
            while link.held:
                await asyncio.sleep(0.02)
            writer.write(data)
            await writer.drain()
    writer.transport.abort()

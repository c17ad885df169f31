"""Serves an application over HTTP until it is asked to end."""

import asyncio
import contextlib
import errno
import socket
from collections.abc import Callable, Iterator
from typing import Any

import uvicorn

from prior_sg.deploy.errors import UserError
from prior_sg.deploy.running.serve import parent_gone
from prior_sg.deploy.serving.gate import App

BACKLOG = 128
GRACE_S = 2.0  # for answers that are under way at the end; then their connections are cut
FORCE_S = 2  # for what goes on without a connection; then it is cancelled
IDLE_CHECK_S, LONGEST_IDLE_S = 1.0, 30.0  # in which a connection has to ask for something, or to have asked
MOST_CONNECTIONS = 1000
STUCK_MS = 30_000  # after which a connection is given up whose other end takes nothing


@contextlib.contextmanager
def listening(host: str, port: int) -> Iterator[socket.socket]:
    """A socket that waits for connections; port 0 is any free one. Raises UserError."""
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, socket.SOCK_STREAM) as listener:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            if hasattr(socket, "TCP_USER_TIMEOUT"):  # Linux; connections inherit it
                listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, STUCK_MS)
            listener.bind(address)
            listener.listen(BACKLOG)
            yield listener
    except OSError as error:
        if isinstance(error, socket.gaierror):
            raise UserError(f"{host} is no address of this machine: give another --host") from error
        if error.errno in (errno.EADDRINUSE, errno.EACCES, errno.EADDRNOTAVAIL):
            raise UserError(f"cannot listen on {host} port {port} ({error.strerror}): give another --port") from error
        raise


def address_of(listener: socket.socket) -> str:
    """Where to reach it."""
    host, port = listener.getsockname()[:2]
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"


class Server(uvicorn.Server):
    """Sends away those who wait for news before it waits for all others; ends with its parent where it has one."""

    def __init__(self, app: App, closing: Callable[[], Any], parent: int = 0) -> None:
        config = uvicorn.Config(
            app,  # type: ignore[arg-type]
            access_log=False,
            log_config=None,
            server_header=False,
            proxy_headers=False,
            timeout_graceful_shutdown=int(GRACE_S + FORCE_S),
            limit_concurrency=MOST_CONNECTIONS,
            ws="none",
        )
        super().__init__(config)
        self._closing, self._parent = closing, parent

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """As its base, which waits for open connections."""
        self._closing()
        cutting = asyncio.create_task(self._cut())
        await super().shutdown(sockets)
        cutting.cancel()

    async def main_loop(self) -> None:
        """As its base."""
        watchers = [asyncio.create_task(watch) for watch in (self._stop_with_parent(), self._drop_the_idle())]
        try:
            await super().main_loop()
        finally:
            for watcher in watchers:
                watcher.cancel()

    async def _drop_the_idle(self) -> None:
        """Close connections that have asked for nothing for long, or are as long about their first lines."""
        now, since_s = asyncio.get_running_loop().time, dict[tuple[Any, Any], float]()
        while True:
            await asyncio.sleep(IDLE_CHECK_S)
            connections = [(one, one.cycle) for one in self.server_state.connections]  # type: ignore[union-attr]
            idle = [one for one in connections if one[1] is None or one[1].response_complete]
            since_s = {one: since_s.get(one, now()) for one in idle}
            for (connection, _), begun_s in since_s.items():
                if now() - begun_s > LONGEST_IDLE_S and connection.transport is not None:
                    connection.transport.close()

    async def _cut(self) -> None:
        """Cut the connections whose other end takes nothing."""
        await asyncio.sleep(GRACE_S)
        for connection in list(self.server_state.connections):
            if connection.transport is not None:
                connection.transport.abort()

    async def _stop_with_parent(self) -> None:
        await parent_gone(self._parent)
        self.should_exit = True


def serve(app: App, listener: socket.socket, closing: Callable[[], Any] = lambda: None, parent: int = 0) -> None:
    """Serve until a signal. Raises KeyboardInterrupt at Ctrl-C, after everything has come to its end."""
    Server(app, closing, parent).run([listener])

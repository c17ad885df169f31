"""Serves an application over HTTP until it is asked to end."""

import asyncio
import contextlib
import errno
import os
import socket
from collections.abc import Callable, Iterator
from typing import Any

import uvicorn

from prior_sg.deploy.errors import UserError
from prior_sg.deploy.serving.gate import App

BACKLOG = 128
GRACE_S = 2  # for answers that are under way at the end
PARENT_CHECK_S = 1.0


@contextlib.contextmanager
def listening(host: str, port: int) -> Iterator[socket.socket]:
    """A socket that waits for connections; port 0 is any free one. Raises UserError."""
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, socket.SOCK_STREAM) as listener:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
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
            timeout_graceful_shutdown=GRACE_S,
            ws="none",
        )
        super().__init__(config)
        self._closing, self._parent = closing, parent

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """As its base, which waits for open connections."""
        self._closing()
        await super().shutdown(sockets)

    async def main_loop(self) -> None:
        """As its base."""
        watcher = asyncio.create_task(self._stop_with_parent())
        try:
            await super().main_loop()
        finally:
            watcher.cancel()

    async def _stop_with_parent(self) -> None:
        while not self._parent or os.getppid() == self._parent:
            await asyncio.sleep(PARENT_CHECK_S)
        self.should_exit = True


def serve(app: App, listener: socket.socket, closing: Callable[[], Any] = lambda: None, parent: int = 0) -> None:
    """Serve until a signal. Raises KeyboardInterrupt at Ctrl-C, after everything has come to its end."""
    Server(app, closing, parent).run([listener])

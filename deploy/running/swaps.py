"""Where a supervisor is asked to exchange one of its processes, or its router, in mid-run."""

import math
import queue
import time
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path

from prior_sg.deploy.running.supervisor import Child, Supervisor
from prior_sg.deploy.settings import check_settings
from prior_sg.schemas.codec import DecodeError, decode, encode
from prior_sg.schemas.succession import Swapped, SwapRequest
from prior_sg.schemas.topics import swap_key
from prior_sg.services.errors import PriorSgError
from prior_sg.services.runtime.bus import Bus, Request
from prior_sg.services.runtime.keys import Beyond
from prior_sg.services.runtime.zenoh_router import EndpointTakenError, open_router

ROUTER = "router"
RESTARTED = "the router was started again in its place"
MOST_ASKED = 16  # exchanges that wait to be begun
REOPEN_S = 10.0  # in which the port of a router that has ended can be had again
REOPEN_POLL_S = 0.05
ANSWERED_S = 0.5  # in which an answer passes the router that is asked to be started again


class RouterHere:
    """The router of this process, which can be started again in its place. `beyond` tells who may join it, anew at each
    start. Raises BusError.
    """

    def __init__(self, endpoint: str, beyond: Callable[[], Beyond | None]) -> None:
        self._endpoint, self._beyond = endpoint, beyond
        self._stop = open_router(endpoint, beyond())

    def restart(self) -> None:
        """End it and start another at the same endpoints: clients come back within a second."""
        beyond = self._beyond()
        self._stop()
        end_s = time.monotonic() + REOPEN_S
        while True:
            try:
                self._stop = open_router(self._endpoint, beyond)
            except EndpointTakenError:
                if time.monotonic() > end_s:
                    raise
                time.sleep(REOPEN_POLL_S)
            else:
                return

    def stop(self) -> None:
        """End it."""
        self._stop()


class Swaps:
    """Of one supervisor; requests come on foreign threads and are done by `check`."""

    def __init__(self, bus: Bus, supervisor: Supervisor, folder: Path, router: RouterHere | None) -> None:
        self._bus, self._supervisor, self._folder, self._router = bus, supervisor, folder, router
        self._asked: queue.Queue[tuple[str, Request]] = queue.Queue(MOST_ASKED)
        self._served: dict[str, Callable[[], None]] = {}
        self._router_at_s = math.inf  # when it is to be started again
        if router is not None:
            bus.serve(swap_key(ROUTER, ROUTER), partial(self._ask, ROUTER))

    def check(self) -> list[str]:
        """Do what was asked; returns what happened, for the user."""
        self._serve(self._supervisor.children)
        events = []
        while not self._asked.empty():
            name, request = self._asked.get()
            try:
                events.append(self._swap(name, decode(SwapRequest, request.payload), request))
            except DecodeError:
                request.refuse("the request is not a valid SwapRequest")
            except (PriorSgError, OSError) as error:
                request.reply(encode(Swapped(error=str(error))))
        if self._router is not None and time.monotonic() >= self._router_at_s:
            self._router_at_s = math.inf
            self._router.restart()
            events.append(RESTARTED)
        return events

    def _swap(self, name: str, asked: SwapRequest, request: Request) -> str:
        if name == ROUTER:
            request.reply(encode(Swapped(successor=ROUTER)))
            self._router_at_s = time.monotonic() + ANSWERED_S
            return "the router is to be started again in its place"
        config = ""
        if asked.config:
            path = self._folder / f"{name}.toml"
            path.write_text(asked.config)
            config = str(path)
        check_settings(config or self._supervisor.config, [*self._supervisor.settings, *asked.settings])
        return self._supervisor.exchange(name, config, asked.settings, partial(_tell, request))

    def _serve(self, children: Iterable[Child]) -> None:
        """One place to ask for each process that runs."""
        running = {child.unique: child for child in children if child.runs and child.module.endswith(".serve")}
        for name in running.keys() - self._served.keys():
            key = swap_key(running[name].service, name)
            self._served[name] = self._bus.serve(key, partial(self._ask, name))
        for name in self._served.keys() - running.keys():
            self._served.pop(name)()

    def _ask(self, name: str, request: Request) -> None:
        try:
            self._asked.put_nowait((name, request))
        except queue.Full:
            request.refuse("too many exchanges are asked for at once")


def _tell(request: Request, successor: str, error: str) -> None:
    request.reply(encode(Swapped(successor=successor, error=error)))

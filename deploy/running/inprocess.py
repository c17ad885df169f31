"""All services in this process on the local bus: for debuggers and profilers. Same hosts, same messages."""

import asyncio
import os
import threading
import time
from concurrent.futures import Future
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from prior_sg.deploy.running.supervisor import ChildFailed
from prior_sg.deploy.settings import resolved_config
from prior_sg.services.registry import BY_NAME
from prior_sg.services.runtime.bus import Hub, LocalBus
from prior_sg.services.runtime.host.host import Host
from prior_sg.services.runtime.service import Identity, Service

STOP_TIMEOUT_S = 10.0


@dataclass
class InProcess:
    """What `Supervisor` does with processes, done with hosts on one event loop in a thread."""

    robot: str
    log_folder: Path
    settings: list[str] = field(default_factory=list)
    config: str = ""
    connect: str = "this process"

    def __post_init__(self) -> None:
        self.hub = Hub()
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="services", daemon=True)
        self._thread.start()
        self._running: dict[str, tuple[Host, Future]] = {}

    def prepare(self, service: str) -> None:
        """Nothing: what there is to load is loaded here once for all."""

    def start(self, service: str, copies: int = 1) -> None:
        """Start one service, or several workers of it."""
        known = BY_NAME[service]
        for number in range(copies):
            self.host(known, resolved_config(known, self.config, self.settings), f"{service}-{number + 1}")

    def host(self, service: Service, cfg: Any, instance: str) -> None:
        """Start a service that is none of the registry's, or one with settings of its own."""
        host = asyncio.run_coroutine_threadsafe(self._host(service, cfg, instance), self._loop).result()
        self._running[instance] = host, asyncio.run_coroutine_threadsafe(host.run(), self._loop)

    async def _host(self, service: Service, cfg: Any, instance: str) -> Host:
        robot = self.robot if service.scope == "robot" else "*"
        return Host(service, LocalBus(self.hub), cfg, Identity(robot, instance, time.time_ns()))

    def pids(self) -> dict[str, int]:
        """This process, for every instance."""
        return dict.fromkeys(self._running, os.getpid())

    def check(self) -> list[str]:
        """Nothing is restarted here: a service that fails ends the run. Raises ChildFailed."""
        for instance, (_, running) in self._running.items():
            if running.done() and (error := running.exception()) is not None:
                raise ChildFailed(f"{instance} failed: {error!r}") from error
        return []

    def stop(self) -> None:
        """Ask every service to end, and wait."""
        for host, _ in self._running.values():
            self._loop.call_soon_threadsafe(host.stop)
        for _, running in self._running.values():
            running.exception(STOP_TIMEOUT_S)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(STOP_TIMEOUT_S)

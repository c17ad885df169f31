"""A whole system under test: a router, the six services under the product's supervisor, and a recorder, each process
with a link of its own to the router."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import psutil

from prior_sg.deploy.running.roll import Roll
from prior_sg.deploy.running.supervisor import Child, ChildFailed, Supervisor
from prior_sg.schemas.priors import Task
from prior_sg.services.runtime.client import BusClient
from prior_sg.services.runtime.endpoints import free_endpoint, parse_endpoint
from prior_sg.services.runtime.zenoh_bus import ZenohBus
from tests.chaos import painted, serve
from tests.chaos.proxy import Proxies
from tests.chaos.schedule import RECORDER, ROUTER, SERVICES
from tests.chaos.streams import ROBOT, Stream
from tests.help.paths import ROOT

START_S = 120.0
CHECK_S = 0.1
KEPT_DELAY_S = 0.5  # before the router or the recorder is started again
TASK = "look around"
MARK = "CHAOS_MARK"  # in the environment of every process of one system
SETTINGS = (
    f"feature_pyramid.space={painted.SPACE}",
    f"segmenter.space={painted.SPACE}",
    "feature_pyramid.smallest_crop_px=48",
    "ingest.every_frame=true",
    "prior_gateway.archive=",
)


class Kept:
    """A process that is started again when it has ended, as a service manager does it; not while it is `away`."""

    def __init__(self, name: str, command: list[str], log_path: Path) -> None:
        self.name, self.log_path, self._command = name, log_path, command
        self.away = False
        self.starts = 0
        self._ended_s = 0.0
        self.process: subprocess.Popen | None = None

    @property
    def pid(self) -> int:
        """Of the process, 0 where there is none."""
        return 0 if self.process is None else self.process.pid

    def check(self) -> list[str]:
        """Start it where it is to run; what happened."""
        code = None if self.process is None else self.process.poll()
        if self.away or (self.process is not None and code is None):
            self._ended_s = 0.0
            return []
        now_s = time.monotonic()
        self._ended_s = self._ended_s or now_s
        if self.process is not None and now_s - self._ended_s < KEPT_DELAY_S:
            return []
        said = [] if self.process is None else [f"{self.name} ended (exit status {code}); started again"]
        command = [part.format(start=self.starts) for part in self._command]
        with self.log_path.open("ab") as log:
            self.process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True
            )
        self.starts += 1
        return said

    def end(self) -> None:
        """For good."""
        self.away = True
        if self.process is not None:
            for number, patience_s in ((signal.SIGCONT, 0.0), (signal.SIGTERM, 8.0), (signal.SIGKILL, 5.0)):
                self.process.send_signal(number)
                with contextlib.suppress(subprocess.TimeoutExpired):
                    if patience_s:
                        self.process.wait(patience_s)


class Linked(Supervisor):
    """The product's supervisor, whose children reach the router through links and run as `tests.chaos.serve`."""

    proxies: Proxies

    def start(self, service: str, copies: int = 1) -> None:
        """One process."""
        child = self.child(service, f"{service}-1")
        child.start()
        self.children.append(child)  # only now: `check`, on another thread, starts what has no process

    def child(self, service: str, instance: str) -> Child:
        """A process that is not started yet."""
        endpoint = f"tcp/127.0.0.1:{self.proxies.link(service).port}"
        arguments = ["--robot", self.robot, "--connect", endpoint]
        for setting in self.settings:
            arguments += ["--set", setting]
        self.log_folder.mkdir(parents=True, exist_ok=True)
        return Child(service, instance, arguments, self.log_folder / f"{instance}.log", 1, "tests.chaos.serve")


class System:
    """Use as a context manager: everything stands at its beginning, and has gone at its end."""

    def __init__(self, stream: Stream, folder: Path, disk: Path | None = None, settings: tuple[str, ...] = ()) -> None:
        self.stream, self.folder, self.disk = stream, folder, disk or folder
        self.mark = f"{os.getpid()}-{time.time_ns()}"
        self.endpoint = free_endpoint("tcp/127.0.0.1:0")
        self.proxies = Proxies(parse_endpoint(self.endpoint).port)
        self.said: list[str] = []  # by supervisor and service manager
        self.failed = ""  # why the supervisor has given up
        self.expected: list[str] = []  # instances whose end is a fault of ours
        self._command = [sys.executable, "-P", "-m", "prior_sg.deploy.cli.main"]
        kept = [f"ingest.archive_path={self.disk / 'keyframes.sqlite'}", f"scene_store.path={self.database}"]
        self._settings = [*SETTINGS, *settings, f"ingest.source={stream.path}", *kept]
        self._stopping = threading.Event()
        self._keeper = threading.Thread(target=self._keep, name="keeper", daemon=True)
        self._lock = threading.Lock()
        self._ending = contextlib.ExitStack()

    @property
    def database(self) -> Path:
        """Of the store."""
        return self.disk / "scene.sqlite"

    def __enter__(self) -> "System":
        self.folder.mkdir(parents=True, exist_ok=True)
        self.open_gate(0)
        told = {
            MARK: self.mark,
            serve.FOLDER: str(self.folder),
            "PYTHONDONTWRITEBYTECODE": "",  # they are started by the hundred
            painted.LABELS: json.dumps(self.stream.labels),
            "PYTHONPATH": os.pathsep.join(
                filter(None, (str(ROOT), str(ROOT / "src"), os.environ.get("PYTHONPATH", "")))
            ),
        }
        before = {name: os.environ.get(name) for name in told}
        os.environ |= told
        with contextlib.ExitStack() as ending:
            ending.callback(_restore, before)
            ending.callback(self.proxies.close)
            self.router = Kept(
                ROUTER, [*self._command, "router", "--connect", self.endpoint], self.folder / "router.log"
            )
            ending.callback(self.router.end)
            self.router.check()
            self.client = BusClient(ZenohBus(self.endpoint, START_S))
            ending.callback(self.client.bus.close)
            self.roll = Roll(self.client.bus)
            through = f"tcp/127.0.0.1:{self.proxies.link(RECORDER).port}"
            log = str(self.disk / "log-{start}.mcap")
            recording = [*self._command, "record", log, "--connect", through]
            self.recorder = Kept(RECORDER, recording, self.folder / "recorder.log")
            ending.callback(self.recorder.end)
            self.supervisor = Linked(self.endpoint, ROBOT, self.folder / "logs", self._settings)
            self.supervisor.proxies = self.proxies
            ending.callback(self.supervisor.stop)
            ending.callback(self._end_keeper)
            self._keeper.start()
            self._start()
            self._ending = ending.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._ending.close()

    def _start(self) -> None:
        for name in SERVICES[:-1]:
            self.supervisor.start(name)
        self.wait_for(lambda: set(SERVICES[:-1]) <= set(self.client.alive().values()), "the services did not start")
        regions = list(self.stream.labels)
        task = Task(
            robot=ROBOT,
            stamp_ns=time.time_ns(),
            environment=self.stream.environment,
            task=TASK,
            regions=regions,
        )
        self.client.give_task(task, START_S)
        self.supervisor.start("ingest")
        self.wait_for(self.complete, "ingest did not start")

    def complete(self) -> bool:
        """Whether every service is there."""
        return set(SERVICES) <= set(self.client.alive().values())

    def wait_for(self, is_so, otherwise: str, patience_s: float = START_S) -> None:
        """Raises TimeoutError with what went wrong."""
        end_s = time.monotonic() + patience_s
        while not is_so():
            if self.failed or time.monotonic() > end_s:
                raise TimeoutError(self.failed or f"{otherwise} within {patience_s:.0f} s")
            time.sleep(0.05)

    def open_gate(self, frames: int) -> None:
        """Let so many frames through, counted from the first."""
        partial = self.folder / "gate.partial"
        partial.write_text(str(frames))
        partial.replace(self.folder / "gate")

    def pid(self, name: str) -> int:
        """Of a service, the router or the recorder; 0 while it has none."""
        if name in (ROUTER, RECORDER):
            return (self.router if name == ROUTER else self.recorder).pid
        return self.child(name).pid

    def child(self, service: str) -> Child:
        """The supervised process of a service."""
        return next(child for child in self.supervisor.children if child.service == service)

    def set_mode(self, service: str, mode: serve.Mode) -> None:
        """How a service's process is disturbed."""
        file = serve.mode_file(self.folder, service)
        partial = file.with_suffix(".partial")
        partial.write_bytes(serve.msgspec.json.encode(mode))
        partial.replace(file)

    def signal(self, name: str, number: int) -> int:
        """Send a signal to whoever runs under a name now; its process id, 0 where nobody does."""
        pid = self.pid(name)
        if pid:
            if number in (signal.SIGKILL, signal.SIGTERM):
                self.expected.append(name)
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, number)
        return pid

    def processes(self) -> list[psutil.Process]:
        """Every process of this system, whoever started it, but this one."""
        found = []
        for process in psutil.process_iter():
            with contextlib.suppress(psutil.Error):
                if process.pid != os.getpid() and process.environ().get(MARK) == self.mark:
                    found.append(process)
        return found

    def resident_mb(self) -> dict[str, float]:
        """Memory of each process that runs, by name."""
        found = {}
        for name in (*SERVICES, ROUTER, RECORDER):
            with contextlib.suppress(psutil.Error, StopIteration):
                if pid := self.pid(name):
                    found[name] = psutil.Process(pid).memory_info().rss / 1e6
        return found

    def _keep(self) -> None:
        while not self._stopping.wait(CHECK_S):
            self.said += [*self.router.check(), *self.recorder.check()]
            if self.failed:
                continue
            try:
                said, hung = self.roll.check(self.supervisor.children)
                for child in hung:
                    self.expected.append(child.service)
                    child.kill()
                self.said += [*said, *self.supervisor.check()]
            except ChildFailed as error:
                self.failed = str(error)

    def _end_keeper(self) -> None:
        self._stopping.set()
        self._keeper.join()


def _restore(environment: dict[str, str | None]) -> None:
    for name, value in environment.items():
        if value is None:
            del os.environ[name]
        else:
            os.environ[name] = value

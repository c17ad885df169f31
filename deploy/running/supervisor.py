"""Child processes: one per service instance, restarted when they die, stopped in order."""

import contextlib
import itertools
import json
import os
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from prior_sg.deploy.errors import UserError
from prior_sg.deploy.running.crashes import crashes
from prior_sg.deploy.running.logfiles import bound
from prior_sg.deploy.running.serve import EXIT_HOPELESS, EXIT_LATER, EXIT_SUPERSEDED
from prior_sg.services.registry import BY_NAME

RESTART_DELAY_S = 0.5
MAX_RESTART_DELAY_S = 10.0
LATER_DELAY_S = 3.0  # of one that lacks what can come back
STABLE_AFTER_S = 20.0
GIVE_UP_AFTER = 5
STOP_TIMEOUT_S = 10.0
BOUND_LOGS_EVERY_S = 10.0
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class ChildFailed(UserError):
    """A service keeps dying; the message says where its log is."""


class ChildHopeless(ChildFailed):
    """A service that would fail again: whoever starts this program again gains nothing."""

    exit_status = EXIT_HOPELESS


@dataclass
class Child:
    """One service process and its history."""

    service: str
    instance: str
    arguments: list[str]
    log_path: Path
    threads: int
    module: str = "prior_sg.deploy.running.serve"
    process: subprocess.Popen | None = None
    started_s: float = 0.0
    deaths: int = 0
    restarts: int = 0
    restart_at_s: float = 0.0
    later: bool = False  # it ran, and lacks what can come back
    unique: str = ""  # its name on the bus
    succeeds: str = ""  # the instance that it is to take over from, until it has
    held: bool = False  # it loads what it needs and waits for its release

    def start(self) -> None:
        """Start the process; its log is appended to."""
        command = [
            sys.executable,
            "-P",  # nothing in the working directory is taken for a module of ours
            "-m",
            self.module,
            self.service,
            "--parent",
            str(os.getpid()),
            *self.arguments,
            *(("--succeeds", self.succeeds) if self.succeeds else ()),
            *(("--held",) if self.held else ()),
        ]
        # Unique on the bus: another robot, host or run may have a process of the same short name.
        self.unique = f"{self.instance}-{uuid.uuid4().hex[:6]}"
        environment = os.environ | {name: str(self.threads) for name in THREAD_VARIABLES}
        with self.log_path.open("ab") as log:
            self.process = subprocess.Popen(
                [*command, "--instance", self.unique],
                stdin=subprocess.PIPE if self.held else subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
                env=environment | {"OMP_WAIT_POLICY": "PASSIVE"},
            )
        self.started_s = time.monotonic()

    def release(self) -> None:
        """Let a held process begin; one that is not there now will not be held any more."""
        self.held = False
        if self.process is not None and self.process.stdin is not None:
            with contextlib.suppress(BrokenPipeError), self.process.stdin as told:
                told.write(b"go\n")
        self.started_s = time.monotonic()

    @property
    def code(self) -> int | None:
        """Exit status; None while it runs, and where it is not started."""
        return None if self.process is None else self.process.poll()

    @property
    def runs(self) -> bool:
        """Whether the process exists."""
        return self.process is not None and self.process.poll() is None

    @property
    def pid(self) -> int:
        """Of the process, 0 where there is none."""
        return 0 if self.process is None else self.process.pid

    def kill(self) -> None:
        """End the process at once, also one that was stopped."""
        if self.process is not None:
            self.process.kill()

    def last_words(self) -> str:
        """The end of its log, for an error message."""
        try:
            lines = self.log_path.read_text(errors="replace").strip().splitlines() or ["(empty log)"]
            entry = json.loads(lines[-1])
            return str(entry.get("error", entry["event"])).splitlines()[-1]
        except OSError as error:
            return f"(no log: {error.strerror})"
        except (ValueError, LookupError, AttributeError):  # not a line of ours
            return lines[-1][-400:]


@dataclass
class Exchange:
    """A child that is to take over from another; `told` gets its name, or why it does not."""

    former: Child
    heir: Child
    told: Callable[[str, str], None]


@dataclass
class Supervisor:
    """Starts services in the order given and stops them in the same order."""

    connect: str
    robot: str
    log_folder: Path
    settings: list[str] = field(default_factory=list)
    config: str = ""
    children: list[Child] = field(default_factory=list)
    hears: Callable[[str], bool] = lambda unique: True  # whether a process is seen on the bus
    exchanges: list[Exchange] = field(default_factory=list)
    logs_bound_s: float = 0.0  # when logs were last looked at

    @property
    def crash_folder(self) -> Path:
        """Where services leave how they died: beside the logs."""
        return self.log_folder.parent / "crashes"

    def prepare(self, service: str) -> None:
        """Begin a process of a service that loads what it needs and waits for `start`."""
        self.log_folder.mkdir(parents=True, exist_ok=True)
        self._start(service, f"{service}-1", 1, self.config, settings=self.settings, held=True)

    def start(self, service: str, copies: int = 1) -> None:
        """Start one service, or several workers of it; what was prepared is let go."""
        prepared = [child for child in self.children if child.service == service and child.held]
        for child in prepared:
            child.release()
        if prepared:
            return
        self.log_folder.mkdir(parents=True, exist_ok=True)
        # Workers share the cores; the others do much with little and would only get in each other's way.
        threads = max(1, (os.cpu_count() or 1) // copies) if BY_NAME[service].job is not None else 1
        for number in range(copies):
            self._start(service, f"{service}-{number + 1}", threads, self.config, settings=self.settings)

    def _start(
        self,
        service: str,
        instance: str,
        threads: int,
        config: str,
        *,
        settings: Sequence[str],
        succeeds: str = "",
        held: bool = False,
    ) -> Child:
        arguments = ["--robot", self.robot, "--connect", self.connect, "--crashes", str(self.crash_folder)]
        arguments += ["--config", config] if config else []
        for setting in settings:
            arguments += ["--set", setting]
        log_path = self.log_folder / f"{instance}.log"
        log_path.unlink(missing_ok=True)
        child = Child(service, instance, arguments, log_path, threads, succeeds=succeeds, held=held)
        child.start()
        self.children.append(child)
        return child

    def exchange(self, unique: str, config: str, settings: Sequence[str], told: Callable[[str, str], None]) -> str:
        """Start a successor of the child of this name on the bus; `config` replaces that of the others, `settings` come
        after theirs. Returns what happened, for the user. Raises UserError where there is nothing to exchange.
        """
        former = next((child for child in self.children if child.unique == unique and child.runs), None)
        if former is None:
            raise UserError(f"{unique} does not run here any more; see `prior-sg health`")
        if any(former in (one.former, one.heir) for one in self.exchanges):
            raise UserError(f"{former.instance} is being exchanged already; wait for the end of that")
        names = {child.instance for child in self.children}
        instance = next(name for n in itertools.count(1) if (name := f"{former.service}-{n}") not in names)
        settings = [*self.settings, *settings]
        heir = self._start(
            former.service, instance, former.threads, config or self.config, settings=settings, succeeds=unique
        )
        self.exchanges.append(Exchange(former, heir, told))
        return f"{instance} is to take over from {former.instance}"

    def start_door(self, name: str, module: str, arguments: list[str]) -> None:
        """Start a process that is no service but serves others, such as the HTTP interface."""
        self.log_folder.mkdir(parents=True, exist_ok=True)
        log_path = self.log_folder / f"{name}.log"
        log_path.unlink(missing_ok=True)
        arguments = ["--robot", self.robot, "--connect", self.connect, *arguments]
        child = Child(name, name, arguments, log_path, 1, module)
        child.start()
        self.children.append(child)

    def pids(self) -> dict[str, int]:
        """Process id of each running instance."""
        return {
            child.instance: child.process.pid
            for child in self.children
            if child.process is not None and child.process.poll() is None
        }

    def check(self) -> list[str]:
        """Restart what has died; returns what happened, for the user. Raises ChildFailed when it keeps dying."""
        events = self._exchanged()
        now_s = time.monotonic()
        self._bound_logs(now_s)
        exchanged = [child for one in self.exchanges for child in (one.former, one.heir)]
        for child in self.children:
            if child in exchanged:
                continue
            if child.process is None:
                if now_s >= child.restart_at_s:
                    child.restarts += 1
                    child.start()
                    events.append(f"{child.instance} restarted")
            elif (code := child.process.poll()) is not None:
                child.later = code == EXIT_LATER or (code == EXIT_HOPELESS and child.later)
                stable = now_s - child.started_s > STABLE_AFTER_S or code == EXIT_SUPERSEDED or child.later
                child.deaths = 1 if stable else child.deaths + 1
                if (code == EXIT_HOPELESS and not child.later) or child.deaths >= GIVE_UP_AFTER:
                    died = child.last_words() if code >= 0 else f"it was ended by {_reason(code)}"
                    failed = ChildHopeless if code == EXIT_HOPELESS else ChildFailed
                    raise failed(f"{child.instance} does not run: {died} (log: {child.log_path})")
                growing_s = min(RESTART_DELAY_S * 2 ** (child.deaths - 1), MAX_RESTART_DELAY_S)
                delay_s = LATER_DELAY_S if child.later else growing_s
                child.process, child.restart_at_s = None, now_s + delay_s
                why = f": {child.last_words()}" if code > 0 else ""
                events.append(f"{child.instance} ended ({_reason(code)}){why}{self._report_of(child)}; restarting")
        return events

    def _bound_logs(self, now_s: float) -> None:
        """No log fills the disk, whoever writes to it."""
        if now_s - self.logs_bound_s >= BOUND_LOGS_EVERY_S:
            self.logs_bound_s = now_s
            for child in self.children:
                bound(child.log_path)

    def _exchanged(self) -> list[str]:
        """What became of the exchanges. A successor that fails is given up; then the former serves on, or again."""
        events = []
        for one in list(self.exchanges):
            former, heir = one.former, one.heir
            if heir.code is not None:
                why = heir.last_words()
                self.children.remove(heir)
                events.append(f"{former.instance} stays: {heir.instance} ended ({_reason(heir.code)}): {why}")
                if not former.runs:
                    former.process, former.restart_at_s = None, time.monotonic()
                one.told("", f"{former.instance} stays: {why}")
            elif not former.runs and self.hears(heir.unique):
                heir.succeeds = ""
                self.children.remove(former)
                events.append(f"{heir.instance} has taken over from {former.instance}")
                one.told(heir.unique, "")
            else:
                continue
            self.exchanges.remove(one)
        return events

    def _report_of(self, child: Child) -> str:
        written = crashes(self.crash_folder, time.time())
        return next((f"; report: {one.path}" for one in written if one.instance == child.unique), "")

    def stop(self) -> None:
        """Ask every process to end, in order; kill what does not, and all of them when this is interrupted."""
        for child in self.children:
            if child.process is not None and child.process.poll() is None:
                child.process.send_signal(signal.SIGTERM)
        deadline_s = time.monotonic() + STOP_TIMEOUT_S
        try:
            for child in self.children:
                if child.process is not None:
                    _wait(child.process, max(0.1, deadline_s - time.monotonic()))
        except KeyboardInterrupt:
            for child in self.children:
                child.kill()
            raise


def _wait(process: subprocess.Popen, timeout_s: float) -> None:
    """Wait for an end; kill what has not ended by then."""
    try:
        process.wait(timeout_s)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _reason(code: int) -> str:
    if code >= 0:
        return f"exit status {code}"
    known = {member.value: member.name for member in signal.Signals}
    return f"signal {known.get(-code, -code)}" + ("; too little memory?" if -code == signal.SIGKILL else "")

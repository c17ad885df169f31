"""The main job: start everything, stream a source, wait until all is settled, write the results."""

import contextlib
import fcntl
import logging
import os
import resource
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TaskID, TimeElapsedColumn

from prior_sg.deploy.edge import check_robot, check_task
from prior_sg.deploy.errors import UserError
from prior_sg.deploy.interrupts import came
from prior_sg.deploy.limits import fault_of_files, files_allowed
from prior_sg.deploy.running.inprocess import InProcess
from prior_sg.deploy.running.recorder import Recorder, Settling
from prior_sg.deploy.running.standstill import STALL_AFTER_S, Standstill
from prior_sg.deploy.running.supervisor import Supervisor
from prior_sg.deploy.settings import DEFAULT_CONNECT, DEFAULT_ROBOT, check_settings
from prior_sg.deploy.terminal import Description, Terminal
from prior_sg.schemas.codec import DecodeError, Message, encode
from prior_sg.schemas.features import Pyramid
from prior_sg.schemas.frames import IngestState, Keyframe
from prior_sg.schemas.objects import Detections
from prior_sg.schemas.places import MapRequest, VoxelMap
from prior_sg.schemas.priors import Prior, Task
from prior_sg.schemas.regions import RegionDelta
from prior_sg.schemas.scene import Scene, SceneRequest
from prior_sg.schemas.status import Loss
from prior_sg.schemas.topics import INGEST_STATE, KEYFRAME, PLACE_DELTA, PYRAMID, REGION_DELTA, SCENE, VOXEL_MAP
from prior_sg.services.losses import line, merged
from prior_sg.services.registry import SERVICES
from prior_sg.services.runtime.bus import Bus, BusError, LocalBus, Sample, message_in
from prior_sg.services.runtime.client import BusClient, NoPriorError
from prior_sg.services.runtime.endpoints import parse_endpoint
from prior_sg.services.runtime.zenoh_bus import ZenohBus
from prior_sg.services.runtime.zenoh_router import open_free_router

log = logging.getLogger(__name__)
QUIET_S = 1.5
START_TIMEOUT_S = 180.0
PRIOR_TIMEOUT_S = 900.0  # a model may need minutes
POLL_S = 0.1
KEYFRAMES = "keyframes.sqlite"  # below the output folder: what ingest needs to go on where it was


class RunError(UserError):
    """The run cannot go on; the message says what to do."""


@dataclass
class Job:
    """What to run."""

    source: str
    out: Path
    environment: str
    task: str
    regions: list[str] = field(default_factory=list)
    robot: str = DEFAULT_ROBOT
    connect: str = DEFAULT_CONNECT
    workers: int = 1
    speed: float = 0.0  # 0 = as fast as the pipeline drains
    settings: list[str] = field(default_factory=list)
    config: str = ""
    in_process: bool = False  # all services in this process on the local bus
    log_mb: float = 0.0  # to which log.mcap may grow; 0 = without limit
    on_started: Callable[[str, dict[str, int]], None] = lambda endpoint, pids: None

    def __post_init__(self) -> None:
        """Raises UserError for names and texts that no service would take."""
        check_robot(self.robot)
        check_task(self.environment, self.task, self.regions)


@dataclass
class Result:
    """What came out."""

    scene: Scene
    voxels: VoxelMap
    log_path: Path
    counts: "Counts"
    seconds: float
    prior: Prior  # that the task got when it was given
    losses: list[Loss]  # what could not be used, of all services, most frequent first
    interrupted: bool = False  # by the user, before the end of the source or while the rest was being encoded

    @property
    def loss_lines(self) -> list[str]:
        """A sentence about each."""
        ingest = self.counts.ingest
        totals = {"frames": 0 if ingest is None else ingest.frames_read, "keyframes": len(self.counts.keyframes)}
        return [line(loss, totals.get(loss.what.split()[0], 0)) for loss in self.losses]


@dataclass
class Counts:
    """A tap on the recorded samples: what was made, by frame."""

    keyframes: set[int] = field(default_factory=set)
    pyramids: dict[int, int] = field(default_factory=dict)
    crops: int = 0
    crops_total: int = 0
    ingest: IngestState | None = None
    regions: RegionDelta | None = None
    detectors: set[str] = field(default_factory=set)

    def __call__(self, sample: Sample, message: Message) -> None:
        """See one message."""
        match message:
            case Keyframe():
                self.keyframes.add(message.frame_id)
            case Pyramid():
                self.pyramids[message.frame_id] = self.pyramids.get(message.frame_id, 0) + 1
                self.crops += len(message.embeddings)
                self.crops_total += message.crops_total
            case Detections():
                self.detectors.add(message.detector)
            case RegionDelta():
                self.regions = message

    @property
    def not_encoded(self) -> int:
        """Keyframes without a pyramid."""
        return len(self.keyframes - set(self.pyramids))

    def encoded_summary(self) -> str:
        """One line about exactly-once encoding."""
        repeated = sum(count - 1 for count in self.pyramids.values())
        made = f"{len(self.keyframes)} keyframes, {len(self.pyramids)} encoded"
        return f"{made}, {repeated} repeated, {self.not_encoded} missing"


def make_folder(path: Path) -> None:
    """Create the output folder. Raises RunError."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunError(f"cannot write to {path} ({error.strerror}); choose another folder with --out") from error


def require_files() -> None:
    """Raise the limit of open files as far as this user may. Raises RunError where that is too few for a router."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = files_allowed()
    if soft < wanted and soft != resource.RLIM_INFINITY:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
    if fault := fault_of_files(wanted):
        raise RunError(fault)


@contextmanager
def claimed_folder(path: Path) -> Iterator[None]:
    """The output folder, created and nobody else's until the end. Raises RunError."""
    make_folder(path)
    folder = os.open(path, os.O_RDONLY)
    try:
        fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(folder)
        raise RunError(f"another run is writing to {path}; wait for it, or choose another folder with --out") from error
    except OSError:  # a file system without locks
        log.debug("%s cannot be locked", path)
    try:
        yield
    finally:
        os.close(folder)


def run(job: Job, console: Terminal) -> Result:
    """Run one source to its end. Raises RunError, BusError, ChildFailed; KeyboardInterrupt ends it early, cleanly."""
    with claimed_folder(job.out):
        return _run_in_folder(job, console)


def _run_in_folder(job: Job, console: Terminal) -> Result:
    database = job.out / "scene.sqlite"
    for leftover in (*job.out.glob("scene.sqlite*"), *job.out.glob(f"{KEYFRAMES}*")):
        leftover.unlink()
    settings = [
        f"scene_store.path={database}",
        f"ingest.archive_path={job.out / KEYFRAMES}",
        f"ingest.source={job.source}",
        f"ingest.speed={job.speed}",
        *job.settings,
    ]
    check_settings(job.config, settings)
    logs = job.out / "logs"
    if job.in_process:
        services = InProcess(job.robot, logs, settings, job.config)
        return _run_on(LocalBus(services.hub), services, job, console)
    require_files()
    endpoint, stop_router = open_free_router(job.connect)
    if endpoint != job.connect:
        taken = "" if parse_endpoint(job.connect).port == 0 else f"{job.connect} is in use; "
        console.print(f"{taken}this run's router listens on {endpoint} (--connect {endpoint})")
    try:
        supervisor = Supervisor(endpoint, job.robot, logs, settings, job.config)
        return _run_on(ZenohBus(endpoint), supervisor, job, console)
    finally:
        stop_router()


def _run_on(bus: Bus, supervisor: "Supervisor | InProcess", job: Job, console: Terminal) -> Result:
    started_s = time.monotonic()
    with BusClient(bus) as client:
        recorder = Recorder(client, job.out / "log.mcap", job.log_mb)
        with contextlib.ExitStack() as ending:  # all of it, whatever fails or is interrupted on the way
            ending.callback(recorder.close)
            ending.callback(supervisor.stop)
            return Run(job, console, client, recorder, supervisor).stream(started_s)


class Run:
    """One run under way: its services, its bus, and what it has seen."""

    def __init__(
        self,
        job: Job,
        console: Terminal,
        client: BusClient,
        recorder: Recorder,
        supervisor: "Supervisor | InProcess",
    ) -> None:
        self.job, self.console, self.client, self.recorder, self.supervisor = job, console, client, recorder, supervisor
        self.counts = Counts()
        self.settling = Settling((KEYFRAME, PLACE_DELTA, PYRAMID, REGION_DELTA))
        self.interrupted = threading.Event()
        recorder.taps += [self.counts, self.settling]
        client.listen(INGEST_STATE, job.robot, self._saw_ingest)

    def _saw_ingest(self, sample: Sample) -> None:
        with contextlib.suppress(DecodeError):
            self.counts.ingest = message_in(sample)

    def stream(self, started_s: float) -> Result:
        """Start everything, follow the stream to its end, read the result."""
        with _progress(self.console) as progress, _interrupt_sets(self.interrupted):
            bar = progress.add_task("starting services", total=None)
            names = [service.name for service in SERVICES if service.name != "ingest"]
            self._start(names, "ingest")
            progress.update(bar, description="asking for the prior")
            prior = self._task(lambda reason: self._waiting(progress, bar, reason))
            progress.console.print(f"prior: {prior.provenance.source}, {prior.provenance.note}")
            self._start(["ingest"])  # last: the stream must not begin before its readers stand
            self.job.on_started(self.supervisor.connect, self.supervisor.pids())
            interrupted = self._follow(progress, bar)
            progress.update(bar, description="reading the scene")
            scene = self.client.ask(SCENE, SceneRequest(robot=self.job.robot), 30.0)
            voxels = self.client.ask(VOXEL_MAP, MapRequest(robot=self.job.robot), 30.0)
            losses = self._losses()
        self.recorder.attachments["scene.msgpack"] = ("application/msgpack", encode(scene))
        self.recorder.attachments["voxels.msgpack"] = ("application/msgpack", encode(voxels))
        self.recorder.attachments["losses.json"] = ("application/json", msgspec.json.encode(losses))
        if lacks := self.recorder.lacks:
            self.console.print(lacks)
        seconds = time.monotonic() - started_s
        return Result(scene, voxels, self.job.out / "log.mcap", self.counts, seconds, prior, losses, interrupted)

    def _losses(self) -> list[Loss]:
        """What the services of this run could not use; one that does not answer says nothing, and that is said."""
        found: list[Loss] = []
        for instance, service in sorted(self.client.alive().items()):
            if not any(f"{instance}-".startswith(f"{name}-") for name in self.supervisor.pids()):
                continue  # of another run on this router
            try:
                status = self.client.status(service, instance)
            except BusError as error:
                found.append(
                    Loss(what="services silent", reason="their losses are unknown", count=1, example=str(error))
                )
                continue
            found += status.losses
            for topic in status.topics:
                for count, reason in ((topic.malformed, "cannot be decoded"), (topic.missed, "never arrived")):
                    if count:
                        where = f"{topic.topic} at {service}"
                        found.append(Loss(what=f"{where} messages lost", reason=reason, count=count, example=""))
        return merged(found)

    def _start(self, names: list[str], then: str = "") -> None:
        """Start services and wait until they are seen; meanwhile what comes then loads what it needs."""
        wanted = {name: self.job.workers if name == "feature_pyramid" else 1 for name in names}
        for name, copies in wanted.items():
            self.supervisor.start(name, copies)
        if then:
            self.supervisor.prepare(then)
        deadline_s = time.monotonic() + START_TIMEOUT_S
        while True:
            alive = list(self.client.alive().values())
            missing = [name for name, copies in wanted.items() if alive.count(name) < copies]
            if not missing:
                return
            if self.interrupted.is_set():
                raise KeyboardInterrupt
            self.supervisor.check()
            if time.monotonic() > deadline_s:
                where = self.supervisor.log_folder
                raise RunError(f"not started within {START_TIMEOUT_S:.0f} s: {', '.join(missing)}; see {where}")
            time.sleep(POLL_S)

    def _waiting(self, progress: Progress, bar: TaskID, reason: str) -> None:
        """Show why there is no prior yet. Raises KeyboardInterrupt."""
        if self.interrupted.is_set():
            raise KeyboardInterrupt
        progress.update(bar, description=reason or "asking for the prior")

    def _task(self, say: Callable[[str], None]) -> Prior:
        """Give the task; returns the prior it gets. Raises RunError with the gateway's reason when there is none."""
        job = self.job
        task = Task(
            robot=job.robot,
            stamp_ns=self.client.task_stamp_ns(job.robot),
            environment=job.environment,
            task=job.task,
            regions=job.regions,
        )
        try:
            return self.client.give_task(task, PRIOR_TIMEOUT_S, say)
        except NoPriorError as error:
            raise RunError(str(error)) from error

    def _follow(self, progress: Progress, bar: TaskID) -> bool:
        """Show progress until the source has ended and everything has settled; True when the user interrupts that."""
        finished = False
        standstill = Standstill(lambda: self.client.statuses()[0], progress.console.print)
        while not (finished and self.settling.settled(QUIET_S)):
            for event in self.supervisor.check():
                progress.console.print(event)
            if (state := self.counts.ingest) is not None:
                finished = state.finished
                progress.update(bar, total=state.frames_total or None, completed=state.frames_read)
                standstill.see((state.frames_read, state.encoded))
            progress.update(bar, description=_description(self.counts, finished))
            if self.interrupted.is_set():
                progress.console.print("interrupted: writing what there is; Ctrl-C again ends at once")
                return True
            if standstill.reached(self.settling.changed_s):
                said = f"nothing has moved for {STALL_AFTER_S:.0f} s; see the logs in {self.supervisor.log_folder}"
                if not finished:
                    raise RunError(said)
                progress.console.print(f"{said}; writing what there is")
                return False
            self.recorder.check()
            time.sleep(POLL_S)
        return False


def _description(counts: Counts, finished: bool) -> str:
    encoded = f"{len(counts.pyramids)}/{len(counts.keyframes)} keyframes encoded"
    regions = f", {len(counts.regions.labels)} labels" if counts.regions is not None else ""
    refused = 0 if counts.ingest is None else counts.ingest.rejected
    lost = f", {refused} frames refused" if refused else ""
    return ("settling: " if finished else "streaming: ") + encoded + regions + lost


def _progress(console: Terminal) -> Progress:
    return Progress(
        SpinnerColumn(),
        Description(),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        console=console,
    )


@contextmanager
def _interrupt_sets(event: threading.Event) -> Iterator[None]:
    """Ctrl-C or SIGTERM sets the event the first time and raises KeyboardInterrupt the second; one that came before and
    was swallowed counts as the first."""

    def handle(number: int, frame: object) -> None:
        if event.is_set():
            raise KeyboardInterrupt
        event.set()

    if threading.current_thread() is not threading.main_thread():  # only the main thread may handle signals
        yield
        return
    previous = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    if came():
        event.set()
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)

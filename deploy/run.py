"""The main job: start everything, stream a source, wait until all is settled, write the results."""

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from schemas.codec import DecodeError, Message, decode, encode
from schemas.frames import IngestState
from schemas.places import MapRequest, VoxelMap
from schemas.priors import Prior, PriorList, PriorRequest, Task
from schemas.regions import RegionDelta
from schemas.scene import Scene, SceneRequest
from schemas.topics import (
    INGEST_STATE,
    KEYFRAME,
    PLACE_DELTA,
    PRIOR,
    PRIORS,
    PYRAMID,
    REGION_DELTA,
    SCENE,
    TASK,
    VOXEL_MAP,
)
from services.registry import SERVICES
from services.runtime.bus import BusError, Sample
from services.runtime.zenoh_bus import ZenohBus, free_endpoint, open_router

from deploy.client import Client
from deploy.recorder import Recorder, Settling
from deploy.supervisor import Supervisor

QUIET_S = 1.5
START_TIMEOUT_S = 180.0
PRIOR_TIMEOUT_S = 20.0
POLL_S = 0.1
STALL_AFTER_S = 120.0


class RunError(Exception):
    """The run cannot go on; the message says what to do."""


@dataclass
class Job:
    """What to run."""

    source: str
    out: Path
    environment: str
    task: str
    regions: list[str] = field(default_factory=list)
    robot: str = "robot1"
    connect: str = "tcp/127.0.0.1:7447"
    workers: int = 1
    speed: float = 0.0  # 0 = as fast as the pipeline drains
    settings: list[str] = field(default_factory=list)
    config: str = ""
    on_pids: Callable[[dict[str, int]], None] = lambda pids: None


@dataclass
class Result:
    """What came out."""

    scene: Scene
    voxels: VoxelMap
    prior: Prior
    log_path: Path
    counts: "Counts"
    seconds: float


@dataclass
class Counts:
    """A tap on the recorded samples: what was made, by frame."""

    keyframes: set[int] = field(default_factory=set)
    pyramids: dict[int, int] = field(default_factory=dict)
    crops: int = 0
    crops_total: int = 0
    tasks: int = 0
    task: Task | None = None
    ingest: IngestState | None = None
    regions: RegionDelta | None = None
    priors: dict[str, Prior] = field(default_factory=dict)
    places: int = 0

    def __call__(self, sample: Sample) -> None:
        """See one sample."""
        try:
            message = decode(sample.topic.type, sample.payload)
        except DecodeError:
            return
        if sample.topic is KEYFRAME:
            self.keyframes.add(message.frame_id)
        elif sample.topic is PYRAMID:
            self.pyramids[message.frame_id] = self.pyramids.get(message.frame_id, 0) + 1
            self.crops += len(message.embeddings)
            self.crops_total += message.crops_total
        elif sample.topic is INGEST_STATE:
            self.ingest = message
        elif sample.topic is REGION_DELTA:
            self.regions = message
        elif sample.topic is TASK:
            self.tasks, self.task = self.tasks + 1, message
        elif sample.topic is PRIOR:
            self.priors[message.digest()] = message

    def encoded_summary(self) -> str:
        """One line about exactly-once encoding."""
        repeated = sum(count - 1 for count in self.pyramids.values())
        missing = len(self.keyframes - set(self.pyramids))
        return f"{len(self.keyframes)} keyframes, {len(self.pyramids)} encoded, {repeated} repeated, {missing} missing"


def run(job: Job, console: Console) -> Result:
    """Run one source to its end. Raises RunError, BusError, ChildFailed; KeyboardInterrupt ends it early, cleanly."""
    started_s = time.monotonic()
    endpoint = free_endpoint(job.connect)
    if endpoint != job.connect:
        console.print(f"{job.connect} is in use; this run's router listens on {endpoint} (--connect {endpoint})")
    job.out.mkdir(parents=True, exist_ok=True)
    database = job.out / "scene.sqlite"
    for leftover in job.out.glob("scene.sqlite*"):
        leftover.unlink()
    stop_router = open_router(endpoint)
    settings = [
        *job.settings,
        f"scene_store.path={database}",
        f"ingest.source={job.source}",
        f"ingest.speed={job.speed}",
    ]
    supervisor = Supervisor(endpoint, job.robot, job.out / "logs", settings, job.config)
    try:
        with Client(ZenohBus(endpoint)) as client, _interruptible() as interrupted:
            recorder = Recorder(client, job.out / "log.mcap")
            try:
                return _stream(job, console, client, recorder, supervisor, interrupted, started_s)
            finally:
                supervisor.stop()
                recorder.close()
    finally:
        stop_router()


def _stream(
    job: Job,
    console: Console,
    client: Client,
    recorder: Recorder,
    supervisor: Supervisor,
    interrupted: threading.Event,
    started_s: float,
) -> Result:
    counts, settling = Counts(), Settling((KEYFRAME, PLACE_DELTA, PYRAMID, REGION_DELTA))
    recorder.taps += [counts, settling]
    client.listen(INGEST_STATE, job.robot, counts)
    with _progress(console) as progress:
        bar = progress.add_task("starting services", total=None)
        _start_services(job, client, supervisor, interrupted)
        progress.update(bar, description="asking for the prior")
        task = Task(
            robot=job.robot,
            stamp_ns=time.time_ns(),
            environment=job.environment,
            task=job.task,
            regions=job.regions,
        )
        client.publish(TASK, task)
        prior = _prior_for(client, task)
        if prior.provenance.note:
            progress.console.print(f"prior: {prior.provenance.note}")
        supervisor.start("ingest")
        _wait_alive(client, supervisor, {"ingest"}, interrupted)
        job.on_pids(supervisor.pids())
        _follow(job, progress, bar, counts, settling, supervisor, interrupted)
        progress.update(bar, description="reading the scene")
        scene = client.ask(SCENE, SceneRequest(robot=job.robot), 30.0)
        voxels = client.ask(VOXEL_MAP, MapRequest(robot=job.robot), 30.0)
    recorder.log.attach("scene.msgpack", "application/msgpack", encode(scene))
    prior = counts.priors.get(scene.prior_digest, prior)
    return Result(scene, voxels, prior, job.out / "log.mcap", counts, time.monotonic() - started_s)


def _start_services(job: Job, client: Client, supervisor: Supervisor, interrupted: threading.Event) -> None:
    """Everything but the source, which must not begin before its readers stand."""
    for service in SERVICES:
        if service.name != "ingest":
            supervisor.start(service.name, job.workers if service.job is not None else 1)
    _wait_alive(client, supervisor, {s.name for s in SERVICES if s.name != "ingest"}, interrupted, job.workers)


def _wait_alive(
    client: Client, supervisor: Supervisor, services: set[str], interrupted: threading.Event, workers: int = 1
) -> None:
    deadline_s = time.monotonic() + START_TIMEOUT_S
    while True:
        alive = list(client.alive().values())
        missing = [name for name in sorted(services) if name not in alive]
        if not missing and alive.count("feature_pyramid") >= workers:
            return
        if interrupted.is_set():
            raise KeyboardInterrupt
        supervisor.check()
        if time.monotonic() > deadline_s:
            raise RunError(
                f"not started within {START_TIMEOUT_S:.0f} s: {', '.join(missing)}; see {supervisor.log_folder}"
            )
        time.sleep(POLL_S)


def _prior_for(client: Client, task: Task) -> Prior:
    """The gateway's answer to the task. Raises RunError with its reason when it has none."""
    request = PriorRequest(environment=task.environment, task=task.task, regions=task.regions)
    reply = client.ask(PRIORS, request, PRIOR_TIMEOUT_S)
    assert isinstance(reply, PriorList)
    if not reply.priors:
        raise RunError(reply.reason)
    return reply.priors[0]


def _follow(
    job: Job,
    progress: Progress,
    bar: int,
    counts: Counts,
    settling: Settling,
    supervisor: Supervisor,
    interrupted: threading.Event,
) -> None:
    """Show progress until the source has ended and everything has settled, or the user interrupts."""
    finished, said_interrupt, changed_s, last = False, False, time.monotonic(), (0, 0)
    while not (finished and settling.settled(QUIET_S)):
        for event in supervisor.check():
            progress.console.print(event)
        state = counts.ingest
        if state is not None:
            finished = state.finished
            progress.update(bar, total=state.frames_total or None, completed=state.frames_read)
            if (state.frames_read, state.encoded) != last:
                last, changed_s = (state.frames_read, state.encoded), time.monotonic()
        progress.update(bar, description=_description(counts, finished))
        if interrupted.is_set() and not said_interrupt:
            said_interrupt = finished = True
            progress.console.print("interrupted: writing what there is")
            return
        if time.monotonic() - max(changed_s, settling.changed_s) > STALL_AFTER_S:
            raise RunError(f"nothing has moved for {STALL_AFTER_S:.0f} s; see the logs in {supervisor.log_folder}")
        time.sleep(POLL_S)


def _description(counts: Counts, finished: bool) -> str:
    encoded = f"{len(counts.pyramids)}/{len(counts.keyframes)} keyframes encoded"
    regions = f", {len(counts.regions.labels)} labels" if counts.regions is not None else ""
    return ("settling: " if finished else "streaming: ") + encoded + regions


def _progress(console: Console) -> Progress:
    return Progress(
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        console=console,
    )


@contextmanager
def _interruptible() -> Iterator[threading.Event]:
    """Ctrl-C sets the event the first time and raises KeyboardInterrupt the second."""
    event = threading.Event()

    def handle(number: int, frame: object) -> None:
        if event.is_set():
            raise KeyboardInterrupt
        event.set()

    try:
        previous = signal.signal(signal.SIGINT, handle)
    except ValueError:  # not in the main thread: the caller handles signals
        yield event
        return
    try:
        yield event
    finally:
        signal.signal(signal.SIGINT, previous)

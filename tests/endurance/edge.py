"""Robots and the edge that serves them, on this machine: a router, shared workers, gateway and store, and of each robot
an ingest, a place graph and a segmenter."""

import contextlib
import json
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from prior_sg.deploy.running.recorder import Recorder
from prior_sg.deploy.running.supervisor import Child, Supervisor
from prior_sg.schemas.frames import IngestState
from prior_sg.schemas.priors import Task
from prior_sg.schemas.topics import INGEST_STATE
from prior_sg.services.runtime.bus import Sample, message_in
from prior_sg.services.runtime.client import BusClient
from prior_sg.services.runtime.zenoh_bus import ZenohBus
from prior_sg.services.runtime.zenoh_router import open_free_router
from tests.chaos import painted
from tests.chaos.streams import STEP_NS, Stream
from tests.help.paths import ROOT

START_S = 240.0  # loops may have to be compiled
TASK = "look around"
SHARED = ("feature_pyramid", "prior_gateway", "scene_store")
OWN = ("place_graph", "segmenter", "ingest")
PAINTED = (
    f"feature_pyramid.space={painted.SPACE}",
    f"segmenter.space={painted.SPACE}",
    "feature_pyramid.smallest_crop_px=48",
)


class Plan(NamedTuple):
    """What is to run: how many keyframes a second each robot gives, and how many workers serve all."""

    robots: int
    rate_hz: float
    workers: int = 1
    settings: tuple[str, ...] = PAINTED


class Painting(Supervisor):
    """The product's supervisor, whose children run as `tests.endurance.serve`."""

    def start(self, service: str, copies: int = 1) -> None:
        """One service, or several workers of it."""
        self.log_folder.mkdir(parents=True, exist_ok=True)
        for number in range(copies):
            name = f"{service}-{self.robot}-{number + 1}"
            arguments = ["--robot", self.robot, "--connect", self.connect, "--crashes", str(self.crash_folder)]
            for setting in self.settings:
                arguments += ["--set", setting]
            child = Child(service, name, arguments, self.log_folder / f"{name}.log", 1, "tests.endurance.serve")
            child.start()
            self.children.append(child)


class Edge:
    """Use as a context manager: all robots are read from its beginning on, and all has ended at its end."""

    def __init__(self, stream: Stream, plan: Plan, folder: Path, *, record: bool = False) -> None:
        self.stream, self.plan, self.folder, self.record = stream, plan, folder, record
        self.robots = [f"robot{number + 1}" for number in range(plan.robots)]
        self.ingest: dict[str, IngestState] = {}
        self.supervisors: list[Painting] = []
        self._ending = contextlib.ExitStack()

    def __enter__(self) -> "Edge":
        self.folder.mkdir(parents=True, exist_ok=True)
        path = os.pathsep.join(filter(None, (str(ROOT), str(ROOT / "src"), os.environ.get("PYTHONPATH", ""))))
        os.environ |= {painted.LABELS: json.dumps(self.stream.labels), "PYTHONPATH": path}
        with contextlib.ExitStack() as ending:
            self.endpoint, stop_router = open_free_router("tcp/127.0.0.1:0")
            ending.callback(stop_router)
            self.client = BusClient(ZenohBus(self.endpoint))
            ending.callback(self.client.bus.close)
            if self.record:
                self.recorder = Recorder(self.client, self.folder / "log.mcap")
                ending.callback(self.recorder.close)
            self.client.listen(INGEST_STATE, "*", self._saw_ingest)
            ending.callback(self._stop)
            self._start(SHARED, self.robots[:1])
            self._start(OWN[:-1], self.robots)
            for robot in self.robots:
                task = Task(
                    robot=robot,
                    stamp_ns=time.time_ns(),
                    environment=self.stream.environment,
                    task=TASK,
                    regions=list(self.stream.labels),
                )
                self.client.give_task(task, START_S)
            self._ending = ending.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._ending.close()

    def stream_now(self) -> None:
        """All robots begin."""
        self._start(OWN[-1:], self.robots)

    def children(self) -> list[Child]:
        """All processes but the router and the recorder, which are threads of this one."""
        return [child for supervisor in self.supervisors for child in supervisor.children]

    def check(self) -> list[str]:
        """What ended and was started again; on a healthy machine nothing."""
        return [event for supervisor in self.supervisors for event in supervisor.check()]

    def _start(self, services: Sequence[str], robots: Sequence[str]) -> None:
        before = len(self.client.alive())
        for robot in robots:
            kept = [f"ingest.archive_path={self.folder / f'{robot}.sqlite'}"]
            if "scene_store" in services:
                kept.append(f"scene_store.path={self.folder / 'scene.sqlite'}")
            speed = self.plan.rate_hz * STEP_NS / 1e9
            source = [f"ingest.source={self.stream.path}", f"ingest.speed={speed}", "ingest.every_frame=true"]
            settings = [*self.plan.settings, *source, "ingest.when_behind=skip", "prior_gateway.archive=", *kept]
            supervisor = Painting(self.endpoint, robot, self.folder / "logs", settings)
            self.supervisors.append(supervisor)
            for service in services:
                supervisor.start(service, self.plan.workers if service == "feature_pyramid" else 1)
        wanted = before + sum(len(one.children) for one in self.supervisors[-len(robots) :])
        end_s = time.monotonic() + START_S
        while len(self.client.alive()) < wanted:
            if time.monotonic() > end_s:
                raise TimeoutError(f"{wanted} processes were not there within {START_S:.0f} s; see {self.folder}/logs")
            self.check()
            time.sleep(0.1)

    def _stop(self) -> None:
        for supervisor in self.supervisors:
            supervisor.children.sort(key=lambda child: child.service != "ingest")
        for supervisor in reversed(self.supervisors):
            supervisor.stop()

    def _saw_ingest(self, sample: Sample) -> None:
        state = message_in(sample)
        assert isinstance(state, IngestState)
        self.ingest[state.robot] = state

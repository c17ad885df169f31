"""Each service and the router exchanged in mid-run: how long readers wait, what is lost, whether the scene is the same.

All services as processes of a supervisor, the sample paced by its stamps; once undisturbed twice, which says how far
two runs of one stream are the same anyway, then once for each row with that one exchanged at half of the stream.
"""

import itertools
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from prior_sg.deploy.benches.same_scene import Same, same
from prior_sg.deploy.running.roll import Roll
from prior_sg.deploy.running.supervisor import Supervisor
from prior_sg.deploy.running.swaps import RESTARTED, ROUTER, RouterHere, Swaps
from prior_sg.deploy.settings import DEMO_ENVIRONMENT, DEMO_TASK
from prior_sg.schemas.frames import IngestState
from prior_sg.schemas.priors import PriorRequest, Task
from prior_sg.schemas.scene import Scene, SceneRequest
from prior_sg.schemas.succession import SwapRequest
from prior_sg.schemas.topics import (
    INGEST_STATE,
    KEYFRAME,
    PLACE_DELTA,
    PRIORS,
    PYRAMID,
    REGION_DELTA,
    SCENE,
    SCENE_REVISION,
    Topic,
)
from prior_sg.services.registry import SERVICES
from prior_sg.services.runtime.bus import BusError, Sample, message_in
from prior_sg.services.runtime.client import BusClient
from prior_sg.services.runtime.endpoints import free_endpoint
from prior_sg.services.runtime.zenoh_bus import ZenohBus

ROBOT = "bench"
SPEED = 0.5  # of the source: the successor wants a share of two cores, too
AT = 0.5  # share of the frames after which the exchange begins
TIMEOUT_S = 300.0
ANSWER_S = 30.0  # of who holds the router
QUIET_S = 3.0
POLL_S = 0.02
SLACK = 0.02  # by which a share may lie below that of two undisturbed runs
SHOWN_BY: dict[str, Topic] = {  # what readers of each wait for; of the gateway, answers
    "ingest": KEYFRAME,
    "place_graph": PLACE_DELTA,
    "feature_pyramid": PYRAMID,
    "segmenter": REGION_DELTA,
    "scene_store": SCENE_REVISION,
    ROUTER: PLACE_DELTA,
}
ROWS = (*(service.name for service in SERVICES), ROUTER)


@dataclass
class Heard:
    """What a client of the bus hears, and when (seconds of the monotonic clock)."""

    times_s: dict[str, list[float]] = field(default_factory=dict)  # by topic; `answers` are the gateway's
    frames: dict[str, list[int]] = field(default_factory=dict)  # numbers of keyframes and pyramids, by topic
    ingest: IngestState | None = None
    samples: set[tuple[str, str, int]] = field(default_factory=set)  # heard: caches may tell one again

    def __call__(self, sample: Sample) -> None:
        """See one message."""
        name = (sample.writer, sample.key, sample.sequence)
        if name in self.samples:
            return
        self.samples.add(name)
        message = message_in(sample)
        if isinstance(message, IngestState):
            self.ingest = message
            return
        self.times_s.setdefault(sample.topic.name, []).append(time.monotonic())
        if sample.topic in {KEYFRAME, PYRAMID}:
            self.frames.setdefault(sample.topic.name, []).append(message.frame_id)

    @property
    def share(self) -> float:
        """How much of the source has been read."""
        return 0.0 if self.ingest is None else self.ingest.frames_read / max(self.ingest.frames_total, 1)

    @property
    def finished(self) -> bool:
        """Whether the source has been read to its end."""
        return self.ingest is not None and self.ingest.finished

    def quiet_s(self) -> float:
        """Since anything but answers was heard."""
        return time.monotonic() - max((times[-1] for name, times in self.times_s.items() if name != "answers"))

    def longest_s(self, name: str, start_s: float, end_s: float) -> float:
        """The longest time without what `name` stands for, as far as it lies between two times."""
        times_s = [start_s, *(at_s for at_s in self.times_s.get(name, ()) if start_s < at_s < end_s), end_s]
        return max(later - earlier for earlier, later in itertools.pairwise(times_s))


class Exchanged(NamedTuple):
    """One exchange in mid-run."""

    stall_s: float  # longest time without what its readers wait for, from the request on
    usual_s: float  # the same before it
    took_s: float  # from the request until the successor was in charge
    kept_place_ids: float  # shares of the places, and objects, there before and after that have the same names
    kept_region_ids: float
    kept_object_ids: float


class Streamed(NamedTuple):
    """One run."""

    scene: Scene
    exchanged: dict[str, Exchanged]
    keyframes: int
    lost: int  # keyframes without a pyramid or without a place in the trajectory
    twice: int  # keyframes encoded more than once


def exchange_bench(rows: Sequence[str], source: Path, speed: float = SPEED) -> tuple[dict, dict]:
    """The table as figures, and how far two undisturbed runs are the same."""
    before, again = (streamed(source, (), speed) for _ in range(2))
    usual = same(before.scene, again.scene)
    metrics: dict[str, float] = {f"undisturbed_same_{name}": value for name, value in usual._asdict().items()}
    metrics |= {"undisturbed_lost": before.lost + again.lost, "undisturbed_twice": before.twice + again.twice}
    for row in rows:
        run = streamed(source, (row,), speed)
        metrics |= figures(row, run, same(before.scene, run.scene), usual)
    return metrics, {"speed": speed, "at": AT, "slack": SLACK, "keyframes": before.keyframes}


def figures(row: str, run: Streamed, alike: Same, usual: Same) -> dict[str, float]:
    """One row of the table."""
    found = {f"{row}_{name}": value for name, value in run.exchanged[row]._asdict().items()}
    found |= {f"{row}_lost": run.lost, f"{row}_twice": run.twice}
    found |= {f"{row}_same_{name}": value for name, value in alike._asdict().items()}
    return found | {f"{row}_scene_equal": float(alike.at_least(usual, SLACK))}


def streamed(source: Path, rows: Sequence[str], speed: float, settings: Sequence[str] = ()) -> Streamed:
    """The whole source, with these exchanged one after the other from `AT` of it on."""
    with Running(source, speed, settings).up() as running:
        running.start()
        running.until(lambda: running.heard.share >= AT, "the middle of the stream")
        exchanged = {row: running.exchange(row) for row in rows}
        running.until(lambda: running.heard.finished and running.heard.quiet_s() > QUIET_S, "the end of the stream")
        scene = running.scene()
        keyframes = set(running.heard.frames["KEYFRAME"])
        encoded = running.heard.frames["PYRAMID"]
        lost = len(keyframes - set(encoded)) + max(len(keyframes) - len(scene.trajectory), 0)
        return Streamed(scene, exchanged, len(keyframes), lost, len(encoded) - len(set(encoded)))


class Running:
    """All services under a supervisor that exchanges them when asked on the bus, as `prior-sg up` does."""

    def __init__(self, source: Path, speed: float, settings: Sequence[str] = ()) -> None:
        self._source, self._speed, self._settings = source, speed, list(settings)
        self.heard = Heard()
        self.events: list[str] = []
        self._ends = threading.Event()

    @contextmanager
    def up(self) -> Iterator["Running"]:
        """Router, supervisor and a client, until the end of the block."""
        self.endpoint = free_endpoint("tcp/127.0.0.1:0")
        router = RouterHere(self.endpoint, lambda: None)
        with tempfile.TemporaryDirectory() as folder:
            self.out = Path(folder)
            settings = [f"ingest.source={self._source}", f"ingest.speed={self._speed}", *self._settings]
            settings.append(f"scene_store.path={self.out / 'scene.sqlite'}")
            self.supervisor = Supervisor(self.endpoint, ROBOT, self.out / "logs", settings)
            host = BusClient(ZenohBus(self.endpoint))
            roll = Roll(host.bus)
            self.supervisor.hears = roll.hears
            self._swaps = Swaps(host.bus, self.supervisor, self.out, router)
            try:
                with BusClient(ZenohBus(self.endpoint)) as self.client:
                    yield self
            finally:
                self._ends.set()
                self.supervisor.stop()
                host.bus.close()
                router.stop()

    def start(self) -> None:
        """All services, the source last: the stream must not begin before its readers stand."""
        for topic in {*SHOWN_BY.values(), INGEST_STATE}:
            self.client.listen(topic, ROBOT, self.heard)
        names = [service.name for service in SERVICES if service.name != "ingest"]
        for name in names:
            self.supervisor.start(name)
        self.until(lambda: set(names) <= set(self.client.alive().values()), "the start")
        self.client.give_task(Task(robot=ROBOT, stamp_ns=1, environment=DEMO_ENVIRONMENT, task=DEMO_TASK), TIMEOUT_S)
        self.supervisor.start("ingest")

    def until(self, condition: Callable[[], bool], what: str) -> None:
        """Look after the processes until something is so. Raises RuntimeError."""
        end_s = time.monotonic() + TIMEOUT_S
        while not condition():
            if time.monotonic() > end_s:
                raise RuntimeError(f"{what} did not happen within {TIMEOUT_S:.0f} s: {self.events}")
            self.events += [*self._swaps.check(), *self.supervisor.check()]
            time.sleep(POLL_S)

    def exchange(self, row: str, settings: Sequence[str] = ()) -> Exchanged:
        """Exchange one service, or the router. Raises RuntimeError where the former stays."""
        name = next((child.unique for child in self.supervisor.children if child.service == row), row)
        scene = self.scene()
        asked_s, began_s = time.monotonic(), self.heard.times_s["PLACE_DELTA"][0]
        done: list[str] = []
        asking = threading.Thread(target=self._ask, args=(row, name, settings, done.append), daemon=True)
        asking.start()
        polling = threading.Thread(target=self._poll_answers, daemon=True)
        if row == "prior_gateway":
            polling.start()
        self.until(lambda: bool(done), f"the exchange of {row}")
        if done[0]:
            raise RuntimeError(f"{row}: {done[0]}")
        if row == ROUTER:  # it answers first
            self.until(lambda: RESTARTED in self.events, "the router's start")
        told_s = time.monotonic()
        shown = "answers" if row == "prior_gateway" else SHOWN_BY[row].name
        before = len(self.heard.times_s.get(shown, ()))
        self.until(
            lambda: self.heard.finished or len(self.heard.times_s.get(shown, ())) > before + 1, f"what follows {row}"
        )
        times_s = self.heard.times_s.get(shown, [told_s])
        end_s = max(told_s, times_s[-1])
        usual_s = self.heard.longest_s(shown, began_s, asked_s) if row != "prior_gateway" else 0.0
        kept = same(scene, self.scene())
        ids = kept.place_ids, kept.region_ids, kept.object_ids
        return Exchanged(self.heard.longest_s(shown, asked_s, end_s), usual_s, told_s - asked_s, *ids)

    def scene(self) -> Scene:
        """As the store has it now."""
        found: Scene = self.client.ask(SCENE, SceneRequest(robot=ROBOT), 30.0)
        return found

    def _ask(self, row: str, name: str, settings: Sequence[str], done: Callable[[str], None]) -> None:
        try:
            timeout_s = ANSWER_S if row == ROUTER else TIMEOUT_S
            done(self.client.swap(row, name, SwapRequest(settings=list(settings)), timeout_s).error)
        except BusError as error:
            done(str(error))

    def _poll_answers(self) -> None:
        request = PriorRequest(environment=DEMO_ENVIRONMENT, task=DEMO_TASK)
        while not self._ends.is_set():
            try:
                self.client.ask(PRIORS, request, 1.0)
            except BusError:
                continue
            self.heard.times_s.setdefault("answers", []).append(time.monotonic())
            self._ends.wait(POLL_S)

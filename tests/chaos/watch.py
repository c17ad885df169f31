"""What a system says while it is disturbed, heard by a client with a session of its own."""

import contextlib
import math
import threading
import time
from collections import defaultdict, deque

from prior_sg.deploy.running.recorder import TICKS_AFTER
from prior_sg.schemas.codec import DecodeError
from prior_sg.schemas.features import Pyramid
from prior_sg.schemas.places import PlaceDelta
from prior_sg.schemas.regions import RegionDelta
from prior_sg.schemas.scene import HistoryRequest, Scene, SceneRequest, SceneRevision, StoredRevision
from prior_sg.schemas.status import Consumed, ServiceStatus
from prior_sg.schemas.topics import (
    DETECTIONS,
    HISTORY,
    JOURNAL,
    KEYFRAME,
    OBJECT_DELTA,
    PLACE_DELTA,
    PYRAMID,
    REGION_DELTA,
    SCENE,
    SCENE_REVISION,
)
from prior_sg.services.runtime.bus import BusError, Sample, message_in
from prior_sg.services.runtime.client import BusClient
from prior_sg.services.runtime.zenoh_bus import ZenohBus
from tests.chaos.schedule import SERVICES
from tests.chaos.streams import ROBOT

HEARD = (KEYFRAME, PLACE_DELTA, PYRAMID, DETECTIONS, REGION_DELTA, OBJECT_DELTA, JOURNAL, SCENE_REVISION)
STREAM = frozenset(topic.name for topic in HEARD[:6])
REST_S = 0.7  # after the last delta, beside the segmenter's ticks
KEPT = 300  # samples that a fault may send again
PAGE = 1000
Figures = tuple[int, int, int]  # places, edges, regions


class Watch:
    """Follows the stream through the system. Use as a context manager."""

    def __init__(self, endpoint: str) -> None:
        self.client = BusClient(ZenohBus(endpoint, 60.0))
        self.recent: deque[Sample] = deque(maxlen=KEPT)
        self.announced: dict[int, set[Figures]] = defaultdict(set)  # by revision
        self.mapped = self.seen = -1  # the newest frame in a place delta, and in an input of the segmenter
        self.encoded: set[int] = set()  # frames with a pyramid
        self.regions_s = self.stored_s = self.changed_s = time.monotonic()
        self._rested: dict[str, int] = {}  # of services that work on ticks: how many since their last input
        self._lock = threading.Lock()
        for topic in HEARD:
            self.client.listen(topic, "*", self._saw)

    def __enter__(self) -> "Watch":
        return self

    def __exit__(self, *_: object) -> None:
        self.client.bus.close()

    def follows(self, frame: int, since_s: float) -> bool:
        """Whether places, regions and the store have moved on to a frame, after a moment."""
        with self._lock:
            return min(self.mapped, self.seen) >= frame and min(self.regions_s, self.stored_s) > since_s

    def quiet(self, frames: int) -> str:
        """Why the system is not at rest with so many frames; empty when it is."""
        with self._lock:
            waits_s = REST_S - (time.monotonic() - self.changed_s)
            ticks = {name: TICKS_AFTER[name] - self._rested.get(name, 0) for name in ("segmenter",)}
            told = f"mapped {self.mapped}, segmented {self.seen}, encoded {len(self.encoded)} of {frames}"
        if min(self.mapped, self.seen) < frames - 1 or len(self.encoded) < frames:
            return told
        if waits_s > 0 or max(ticks.values()) > 0:
            return "it still changes"
        return self._busy() or self._lacks(frames)

    def _busy(self) -> str:
        try:
            for status in self.statuses().values():
                if status.backlog or status.waiting_for:
                    return f"{status.service} has {status.backlog} inputs and waits for {', '.join(status.waiting_for)}"
        except BusError as error:
            return str(error)
        return ""

    def _lacks(self, frames: int) -> str:
        try:
            stored = len(self.scene().trajectory)
        except BusError as error:
            return str(error)
        return "" if stored >= frames else f"the store has {stored} of {frames} keyframes"

    def statuses(self) -> dict[str, ServiceStatus]:
        """Of each service. Raises BusError where one is missing or silent."""
        alive = {service: instance for instance, service in self.client.alive().items()}
        if missing := set(SERVICES) - set(alive):
            raise BusError(f"not there: {', '.join(sorted(missing))}")
        return {service: self.client.status(service, alive[service]) for service in SERVICES}

    def scene(self) -> Scene:
        """As it is stored. Raises BusError."""
        found: Scene = self.client.ask(SCENE, SceneRequest(robot=ROBOT), 10.0)
        return found

    def lost(self) -> list[str]:
        """Revisions that the store announced and does not have, or has otherwise. Raises BusError."""
        with self._lock:
            announced = {revision: set(figures) for revision, figures in self.announced.items()}
        kept = self._history()
        found = []
        for revision, figures in sorted(announced.items()):
            one = kept.get(revision)
            if one is None:
                found.append(f"revision {revision} was announced and is not kept")
            elif figures != {(one.places, one.edges, one.regions)}:
                found.append(f"revision {revision} was announced with {sorted(figures)} and is kept otherwise: {one}")
        return found

    def _history(self) -> dict[int, StoredRevision]:
        kept: dict[int, StoredRevision] = {}
        before: int | None = None
        while True:
            page = self.client.ask(HISTORY, HistoryRequest(robot=ROBOT, limit=PAGE, before=before), 10.0).revisions
            kept |= {one.revision: one for one in page}
            if len(page) < PAGE:
                return kept
            before = page[0].revision

    def _saw(self, sample: Sample) -> None:
        with contextlib.suppress(DecodeError):
            message = message_in(sample)
            now_s = time.monotonic()
            with self._lock:
                self._note(sample, message, now_s)

    def _note(self, sample: Sample, message: object, now_s: float) -> None:
        if sample.topic.name in STREAM:
            self.changed_s = now_s
            self.recent.append(sample)
        match message:
            case PlaceDelta():
                self.mapped = max(self.mapped, message.frame_id)
            case RegionDelta():
                self.regions_s = now_s
            case SceneRevision():
                self.stored_s = now_s
                self.announced[message.revision].add((message.places, message.edges, message.regions))
            case Pyramid():
                self.encoded.add(message.frame_id)
            case Consumed(topic="Tick"):
                self._rested[message.service] = self._rested.get(message.service, 0) + 1
            case Consumed() if message.writer:
                self._rested[message.service] = 0
                if message.service == "segmenter" and message.topic == PYRAMID.name:
                    self.seen = max(self.seen, message.frame_id)


def waited(is_so, patience_s: float = math.inf, pause_s: float = 0.02) -> float | None:
    """Seconds until something is so; None where it is not within one's patience."""
    began_s = time.monotonic()
    while not is_so():
        if time.monotonic() - began_s > patience_s:
            return None
        time.sleep(pause_s)
    return time.monotonic() - began_s

"""An encoder is exchanged in mid-run: all services as processes, the sample at half the pace of its recording, and a
worker of another embedding space that joins when a third of the keyframes is encoded."""

import itertools
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from prior_sg.deploy.running.supervisor import Supervisor
from prior_sg.deploy.settings import DEMO_ENVIRONMENT, DEMO_TASK
from prior_sg.schemas.codec import decode
from prior_sg.schemas.features import Pyramid
from prior_sg.schemas.frames import IngestState, Keyframe
from prior_sg.schemas.places import PlaceDelta
from prior_sg.schemas.priors import Task
from prior_sg.schemas.regions import RegionDelta
from prior_sg.schemas.topics import INGEST_STATE, KEYFRAME, PLACE_DELTA, PYRAMID, REGION_DELTA
from prior_sg.services.registry import SERVICES
from prior_sg.services.runtime.bus import Sample
from prior_sg.services.runtime.client import BusClient
from prior_sg.services.runtime.endpoints import free_endpoint
from prior_sg.services.runtime.zenoh_bus import ZenohBus
from prior_sg.services.runtime.zenoh_router import open_router

ROBOT = "bench"
OLD, NEW = (f"conse/efficientnet-lite{size}/minilm-l6-v2" for size in (2, 1))
JOINS_AFTER = 1 / 3  # share of the keyframes
SPEED = 0.5  # of the source: two pools side by side want more than two cores at the pace of the recording
TIMEOUT_S = 300.0
POLL_S = 0.02
LATE_S = 3.0  # for answers that nobody waits for any more


@dataclass
class Watch:
    """What a client hears, with the time at which it was sent (seconds) where that matters."""

    keyframes_s: dict[int, float] = field(default_factory=dict)  # by frame id
    pyramids: dict[str, list[tuple[int, float]]] = field(default_factory=dict)  # (frame id, time) by space
    removed_s: dict[int, list[float]] = field(default_factory=dict)  # when a place left the place graph; it may return
    deltas: list[tuple[float, RegionDelta]] = field(default_factory=list)
    ingest: IngestState | None = None

    def __call__(self, sample: Sample) -> None:
        """See one message."""
        message, at_s = decode(sample.topic.type, sample.payload), sample.sent_ns / 1e9
        match message:
            case Keyframe():
                self.keyframes_s[message.frame_id] = at_s
            case Pyramid():
                self.pyramids.setdefault(message.space, []).append((message.frame_id, at_s))
            case PlaceDelta():
                for place in (*message.removed_ids.tolist(), *message.merged_ids[:, 0].tolist()):
                    self.removed_s.setdefault(place, []).append(at_s)
            case RegionDelta():
                self.deltas.append((at_s, message))
            case IngestState():
                self.ingest = message

    @property
    def switched_s(self) -> float | None:
        """When the first regions of the new space were sent."""
        return next((at_s for at_s, delta in self.deltas if delta.space == NEW), None)

    @property
    def share(self) -> float:
        """How much of the source has been encoded in the old space."""
        total = self.ingest.frames_total if self.ingest else 0
        return len(self.pyramids.get(OLD, ())) / total if total else 0.0


def encoder_swap(source: Path) -> tuple[dict, dict]:
    """A newcomer joins in mid-run → the whole map rests on its space; what was encoded for that, and what followers of
    the regions saw meanwhile."""
    with _running(source) as (supervisor, newcomer, client):
        watch = Watch()
        for topic in (KEYFRAME, PYRAMID, PLACE_DELTA, REGION_DELTA, INGEST_STATE):
            client.listen(topic, ROBOT, watch)
        _start(supervisor, client)

        def until(condition: Callable[[], bool], what: str) -> None:
            end_s = time.monotonic() + TIMEOUT_S
            while not condition():
                if time.monotonic() > end_s:
                    raise RuntimeError(f"{what} did not happen within {TIMEOUT_S:.0f} s")
                if died := supervisor.check() + newcomer.check():
                    raise RuntimeError("; ".join(died))
                time.sleep(POLL_S)

        until(lambda: watch.share >= JOINS_AFTER, "the first third")
        started_s = time.time()
        newcomer.start("feature_pyramid")
        until(lambda: list(client.alive().values()).count("feature_pyramid") == 2, "the newcomer's start")
        joined_s = time.time()
        until(lambda: watch.switched_s is not None, "the change of the space")
        until(lambda: watch.ingest is not None and watch.ingest.finished, "the end of the source")
        time.sleep(LATE_S)
    return metrics_of(watch, started_s, joined_s), {
        "old": OLD, "new": NEW, "keyframes": len(watch.keyframes_s), "joins_after": JOINS_AFTER, "speed": SPEED,
    }  # fmt: skip


def metrics_of(watch: Watch, started_s: float, joined_s: float) -> dict[str, float]:
    """The figures; `started_s` is when the newcomer's process was started, `joined_s` when it stood."""
    switched_s = watch.switched_s
    assert switched_s is not None
    fresh = watch.pyramids[NEW]
    ids = {space: [frame for frame, _ in made] for space, made in watch.pyramids.items()}
    sent_s = [at_s for at_s, _ in watch.deltas]
    return {
        "seconds_from_start": switched_s - started_s,
        "seconds_from_joining": switched_s - joined_s,
        "seconds_from_first_pyramid": switched_s - min(at_s for _, at_s in fresh),
        "frames_backfilled": len({frame for frame, _ in fresh if watch.keyframes_s[frame] < joined_s}),
        "frames_before_switch": len({frame for frame, at_s in fresh if at_s <= switched_s}),
        "keyframes_after_switch": sum(at_s > switched_s for at_s in watch.keyframes_s.values()),
        "frames_twice": sum(len(made) - len(set(made)) for made in ids.values()),
        "frames_missing": len(set(watch.keyframes_s) - set(ids[NEW])),
        "deltas": len(watch.deltas),
        "deltas_with_unlabelled": unlabelled(watch),
        "longest_gap_s_before": _longest_gap(sent_s, sent_s[0], started_s),
        "longest_gap_s_streaming": _longest_gap(sent_s, started_s, min(switched_s, max(watch.keyframes_s.values()))),
        "longest_gap_s": _longest_gap(sent_s, started_s, switched_s),  # also when nothing is new after the stream
    }


def unlabelled(watch: Watch) -> int:
    """Deltas after which a place that had a label, and that has not left the place graph since, has none."""
    names: dict[int, str] = {}
    region_of: dict[int, int] = {}
    removed_s = {place: list(times) for place, times in watch.removed_s.items()}
    count = 0
    for sent_s, delta in watch.deltas:
        before = set(region_of)
        if delta.snapshot:
            names, region_of = {}, {}
        for place in delta.removed_place_ids.tolist():
            region_of.pop(place, None)
        for region in delta.removed_ids.tolist():
            names.pop(region, None)
        names |= {region.id: region.label for region in delta.regions}
        region_of |= dict(zip(delta.place_ids.tolist(), delta.place_regions.tolist(), strict=True))
        lost = [place for place in before - set(region_of) if not _left(removed_s.get(place, []), sent_s)]
        count += bool(lost) or not all(names.get(region) for region in region_of.values())
    return count


def _left(removed_s: list[float], now_s: float) -> bool:
    """Whether the place graph took a place out before now; that one time explains one loss of the label."""
    if removed_s and removed_s[0] <= now_s:
        del removed_s[0]
        return True
    return False


def _longest_gap(sent_s: list[float], start_s: float, end_s: float) -> float:
    """Longest time between two deltas that follow each other, as far as it lies in a window."""
    times_s = [start_s, *(at_s for at_s in sent_s if start_s < at_s < end_s), end_s]
    return max(later - earlier for earlier, later in itertools.pairwise(times_s))


@contextmanager
def _running(source: Path) -> Iterator[tuple[Supervisor, Supervisor, BusClient]]:
    """A router, supervisors of the services and of the newcomer, and a client; all end with the block."""
    endpoint = free_endpoint("tcp/127.0.0.1:0")
    stop_router = open_router(endpoint)
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        settings = [
            f"ingest.source={source}",
            f"ingest.speed={SPEED}",
            f"scene_store.path={out / 'scene.sqlite'}",
            f"feature_pyramid.space={OLD}",
            f"segmenter.space={OLD}",
        ]
        supervisors = (
            Supervisor(endpoint, ROBOT, out / "old", settings),
            Supervisor(endpoint, ROBOT, out / "new", [f"feature_pyramid.space={NEW}"]),
        )
        try:
            with BusClient(ZenohBus(endpoint)) as client:
                yield (*supervisors, client)
        finally:
            for supervisor in supervisors:
                supervisor.stop()
            stop_router()


def _start(supervisor: Supervisor, client: BusClient) -> None:
    """All services, the source last: the stream must not begin before its readers stand."""
    names = [service.name for service in SERVICES if service.name != "ingest"]
    for name in names:
        supervisor.start(name)
    end_s = time.monotonic() + TIMEOUT_S
    while not set(names) <= set(client.alive().values()):
        supervisor.check()
        if time.monotonic() > end_s:
            raise RuntimeError(f"the services did not start within {TIMEOUT_S:.0f} s")
        time.sleep(POLL_S)
    client.give_task(Task(robot=ROBOT, stamp_ns=1, environment=DEMO_ENVIRONMENT, task=DEMO_TASK), TIMEOUT_S)
    supervisor.start("ingest")

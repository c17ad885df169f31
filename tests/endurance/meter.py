"""What a system needs and how late it is, heard and read from outside while it runs."""

import contextlib
import threading
import time
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import psutil

from prior_sg.schemas.features import Pyramid
from prior_sg.schemas.frames import Keyframe
from prior_sg.schemas.places import PlaceDelta
from prior_sg.schemas.status import Consumed
from prior_sg.schemas.topics import JOURNAL, KEYFRAME, PLACE_DELTA, PYRAMID
from prior_sg.services.runtime.bus import Sample, message_in
from tests.endurance.edge import Edge

AROUND = "around"  # this process: the router, the recorder and the meter


class Process(msgspec.Struct, frozen=True, kw_only=True):
    """One process at one time."""

    resident_mb: float
    handles: int
    threads: int
    worked_s: float


class Look(msgspec.Struct, frozen=True, kw_only=True):
    """All processes at one time, and what the disk holds."""

    at_s: float
    keyframes: int
    disk_mb: float
    processes: dict[str, Process]


class Late(msgspec.Struct, frozen=True, kw_only=True):
    """How long after a keyframe was published others followed, in seconds; at_s is when it was published."""

    at_s: float
    place_s: float | None = None
    pyramid_s: float | None = None
    segmented_s: float | None = None  # the segmenter has done with the pyramid; it tells regions where that is news


class Meter:
    """Listens to an edge from its making on."""

    def __init__(self, edge: Edge) -> None:
        self.edge, self.began_s = edge, time.time()
        self.looks: list[Look] = []
        self._sent_s: dict[tuple[str, int], float] = {}
        self._after: dict[str, dict[tuple[str, int], float]] = {"place": {}, "pyramid": {}, "segmented": {}}
        self._lock = threading.Lock()
        for topic in (KEYFRAME, PLACE_DELTA, PYRAMID, JOURNAL):
            edge.client.listen(topic, "*", self._saw)

    def look(self) -> Look:
        """Read all processes."""
        folder = self.edge.folder
        disk_bytes = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
        pids = {child.instance: child.pid for child in self.edge.children() if child.pid} | {
            AROUND: psutil.Process().pid
        }
        processes = {}
        for name, pid in pids.items():
            with contextlib.suppress(psutil.Error):
                processes[name] = _read(psutil.Process(pid))
        with self._lock:
            keyframes = len(self._sent_s)
        found = Look(
            at_s=time.time() - self.began_s, keyframes=keyframes, disk_mb=disk_bytes / 1e6, processes=processes
        )
        self.looks.append(found)
        return found

    def lateness(self) -> list[Late]:
        """Of each keyframe, in the order in which they were published."""
        with self._lock:
            return [
                Late(
                    at_s=sent_s - self.began_s,
                    **{f"{kind}_s": _difference(known.get(keyframe), sent_s) for kind, known in self._after.items()},
                )
                for keyframe, sent_s in self._sent_s.items()
            ]

    def _saw(self, sample: Sample) -> None:
        message, at_s = message_in(sample), sample.sent_ns / 1e9
        with self._lock:
            match message:
                case Keyframe():
                    self._sent_s.setdefault((message.robot, message.frame_id), at_s)
                case PlaceDelta():
                    self._after["place"].setdefault((message.robot, message.frame_id), at_s)
                case Pyramid():
                    self._after["pyramid"].setdefault((message.robot, message.frame_id), at_s)
                case Consumed(service="segmenter", topic=PYRAMID.name):
                    self._after["segmented"].setdefault((message.robot, message.frame_id), at_s)


def slope_per_hour(looks: list[Look], value: Callable[[Look], float | None]) -> float:
    """By how much a value rises in an hour: the median slope of pairs (Theil and Sen), which single steps do not move.

    0 with fewer than two looks that have the value.
    """
    points = [(look.at_s / 3600, found) for look in looks if (found := value(look)) is not None]
    x, y = np.array(points).reshape(-1, 2).T
    later, earlier = np.triu_indices(len(x), 1)[::-1]
    return float(np.median((y[later] - y[earlier]) / (x[later] - x[earlier]))) if len(later) else 0.0


def percentiles(seconds: list[float | None]) -> dict[str, float]:
    """Median and 99th percentile of what came, and how many did not."""
    came = [one for one in seconds if one is not None]
    p50, p99 = np.percentile(came, [50, 99]).tolist() if came else (float("nan"), float("nan"))
    return {"p50_s": p50, "p99_s": p99, "count": len(came), "never": len(seconds) - len(came)}


def kept(path: Path, rows: list) -> None:
    """Rows as lines of JSON."""
    path.write_bytes(b"".join(msgspec.json.encode(row) + b"\n" for row in rows))


def _difference(later_s: float | None, earlier_s: float) -> float | None:
    return None if later_s is None else max(later_s - earlier_s, 0.0)


def _read(process: psutil.Process) -> Process:
    with process.oneshot():
        times = process.cpu_times()
        return Process(
            resident_mb=process.memory_info().rss / 1e6,
            handles=process.num_fds(),
            threads=process.num_threads(),
            worked_s=times.user + times.system,
        )

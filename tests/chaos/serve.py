"""One service as `deploy/running/serve.py` runs it, with three things of the tests: painted pictures are encoded by
reading the paint, a source gives only the frames that it is let give, and what is sent and heard can be disturbed.

`CHAOS_FOLDER` holds how: `gate` has the number of frames let through, `mode-SERVICE.json` a `Mode`.
"""

import os
import random
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import msgspec

from prior_sg.deploy.running import serve
from prior_sg.schemas.topics import DELTAS, Topic
from prior_sg.services.feature_pyramid.encoders.base import FAMILIES
from prior_sg.services.ingest import sources
from prior_sg.services.ingest.core.frames import BadFrame, RawFrame
from prior_sg.services.runtime.bus import OnMissed, OnSample, Sample
from prior_sg.services.runtime.zenoh_bus import ZenohBus
from tests.chaos.dialects import spoken
from tests.chaos.faketime import LIBRARY

FOLDER = "CHAOS_FOLDER"
POLL_S = 0.02
HELD_S = 0.4  # longest for which a topic is held back


class Mode(msgspec.Struct, frozen=True, kw_only=True):
    """How a process is disturbed. The first two hold from its start, the others while they stand there."""

    dialect: str = ""  # of what it sends: older, newer
    faketime: str = ""  # the file that says how its clock is off
    lost: float = 0.0  # share of the deltas that it does not hear
    repeated: float = 0.0  # share of the samples that it hears twice
    held: float = 0.0  # chance of each sample that its topic is held back for a while, so that others overtake it


def mode_file(folder: Path, service: str) -> Path:
    """Where a process finds its mode."""
    return folder / f"mode-{service}.json"


class ModeNow:
    """The mode of this process, read again when its file has changed."""

    def __init__(self, path: Path) -> None:
        self._path, self._read, self._mode = path, -1, Mode()

    def __call__(self) -> Mode:
        """As it stands now."""
        try:
            changed = self._path.stat().st_mtime_ns
            if changed != self._read:
                self._read, self._mode = changed, msgspec.json.decode(self._path.read_bytes(), type=Mode)
        except (OSError, msgspec.DecodeError):  # none, or being written
            return Mode()
        return self._mode


class Ear:
    """A reader's callback that hears some samples twice, some deltas never, and some topics late. What one writer says
    on one key stays in order, as it does over TCP."""

    def __init__(self, mode: ModeNow, topic: Topic, on_sample: OnSample) -> None:
        self._mode, self._topic, self._on_sample = mode, topic, on_sample
        self._random = random.Random(topic.name)
        self._lock = threading.Lock()
        self._waiting: list[Sample] = []
        self._until_s = 0.0

    def __call__(self, sample: Sample) -> None:
        """Hear one."""
        mode = self._mode()
        with self._lock:
            chances = [self._random.random() for _ in range(3)]
            if self._topic in DELTAS and chances[0] < mode.lost:
                return
            self._waiting += [sample] * (2 if chances[1] < mode.repeated else 1)
            if time.monotonic() < self._until_s:
                return
            if chances[2] < mode.held:
                held_s = HELD_S * self._random.random()
                self._until_s = time.monotonic() + held_s
                threading.Timer(held_s, self._pass_on).start()
                return
        self._pass_on()

    def _pass_on(self) -> None:
        with self._lock:
            waiting, self._waiting, self._until_s = self._waiting, [], 0.0
            for sample in waiting:
                self._on_sample(sample)


def disturbed(mode: ModeNow) -> type[ZenohBus]:
    """The bus of a process with a mode."""
    dialect = mode().dialect

    class Disturbed(ZenohBus):
        def put(self, topic: Topic, key: str, payload: bytes, header: bytes) -> None:
            super().put(topic, key, spoken(topic.type, payload, dialect), header)

        def subscribe(self, topic: Topic, pattern: str, on_sample: OnSample, on_missed: OnMissed) -> Callable[[], None]:
            return super().subscribe(topic, pattern, Ear(mode, topic, on_sample), on_missed)

    return Disturbed


class Gate:
    """Lets as many frames of a source through as the file says."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._closed = threading.Event()

    def around(self, source: sources.Source) -> sources.Source:
        """The source behind this gate."""
        bare = source.thinned
        thinned = None if bare is None else lambda wanted: self._through(bare(wanted))
        return replace(source, frames=lambda: self._through(source.frames()), thinned=thinned, close=self._closed.set)

    def _through(self, frames: Iterator[RawFrame | BadFrame]) -> Iterator[RawFrame | BadFrame]:
        for frame in frames:
            while int(self._path.read_text() or 0) <= frame.index:
                if self._closed.wait(POLL_S):
                    return
            yield frame


def main() -> int:
    """As the module that it stands for."""
    folder, service = Path(os.environ[FOLDER]), sys.argv[1]
    mode = ModeNow(mode_file(folder, service))
    if (file := mode().faketime) and "LD_PRELOAD" not in os.environ:
        told = {"LD_PRELOAD": LIBRARY, "FAKETIME_TIMESTAMP_FILE": file, "FAKETIME_CACHE_DURATION": "1"}
        clock = {"FAKETIME_DONT_FAKE_MONOTONIC": "1", "DONT_FAKE_MONOTONIC": "1", "NO_FAKE_STAT": "1"}
        os.execve(
            sys.executable, [sys.executable, "-P", "-m", "tests.chaos.serve", *sys.argv[1:]], os.environ | told | clock
        )
    FAMILIES["painted/"] = "tests.chaos.painted"
    loaded = sources.recording.load
    sources.recording.load = lambda *arguments: Gate(folder / "gate").around(loaded(*arguments))
    serve.ZenohBus = disturbed(mode)
    return serve.main()


if __name__ == "__main__":
    sys.exit(main())

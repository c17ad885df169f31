"""One system, one stream, a sequence of faults: after each, the scene must be that of the undisturbed system there."""

import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import msgspec

from prior_sg.schemas.codec import decode, encode
from prior_sg.schemas.scene import Scene
from prior_sg.services.runtime.bus import BusError
from prior_sg.services.runtime.record import LogError, summary
from tests.chaos.faults import done
from tests.chaos.oracle import ASPECTS, differences, kept_ids, likeness, worst
from tests.chaos.schedule import Phase, Planned
from tests.chaos.streams import Stream
from tests.chaos.system import System
from tests.chaos.watch import Watch, waited

GRID = 8  # frames between two points of comparison
FRAME_S = 0.25  # between two frames of the stream
AHEAD = 4  # frames let through beyond the newest that is mapped and segmented
PATIENCE_S = 90.0  # until the stream is followed again, and until the system rests
FIRST_PATIENCE_S = 400.0  # of an undisturbed one, which may have to compile its loops
LATE_S = 20.0  # in which what seemed at rest may still become equal: what is missing is asked for again
LEFT_MB = 150.0  # more than undisturbed that a process may hold
ID_TOLERANCE = 0.02  # of the share of ids kept


class Hit(msgspec.Struct, frozen=True, kw_only=True):
    """One fault that was done."""

    fault: str
    target: str
    lasted_s: float
    recovered_s: float | None  # from its end until places, regions and store follow the stream; None = not in time


class Outcome(msgspec.Struct, frozen=True, kw_only=True):
    """What came of one phase."""

    voyage: int
    phase: int
    stream: str
    frames: int
    hits: list[Hit]
    likeness: dict[str, float]
    problems: list[str]  # empty = the scene is equal, all live, nothing was lost
    late_s: float = 0.0  # after it seemed at rest until the scene was equal
    beside: list[str] = []  # who ended without being hit
    resident_mb: dict[str, float] = {}


class Reference(msgspec.Struct, frozen=True, kw_only=True):
    """Undisturbed scenes of a stream by number of frames, and how alike two undisturbed runs are."""

    scenes: dict[int, bytes]
    tolerance: dict[str, float]
    resident_mb: dict[str, float]

    def scene(self, frames: int) -> Scene:
        """The scene after so many frames."""
        return decode(Scene, self.scenes[frames])


def reference(stream: Stream, folder: Path, say: Callable[[str], None] = lambda text: None) -> Reference:
    """Two undisturbed runs: one rests at every point, the other, paced as a disturbed one is, at every third."""
    file = folder / f"reference-{stream.path.stem}.msgpack"
    if file.exists():
        return msgspec.msgpack.decode(file.read_bytes(), type=Reference)
    points = range(GRID, stream.frames + 1, GRID)
    say(f"{stream.name}: the first undisturbed run")
    scenes, resident_mb = _undisturbed(stream, folder / "undisturbed-1", points)
    say(f"{stream.name}: the second undisturbed run")
    again, _ = _undisturbed(stream, folder / "undisturbed-2", points[2::3])
    tolerance = worst(likeness(scenes[point], again[point]) for point in again)
    found = Reference(
        scenes={point: encode(scene) for point, scene in scenes.items()}, tolerance=tolerance, resident_mb=resident_mb
    )
    file.write_bytes(msgspec.msgpack.encode(found))
    return found


def _undisturbed(stream: Stream, folder: Path, points: Sequence[int]) -> tuple[dict[int, Scene], dict[str, float]]:
    scenes: dict[int, Scene] = {}
    with System(stream, folder) as system, Watch(system.endpoint) as watch:
        for point in points:
            system.open_gate(point)
            _rest(watch, point, FIRST_PATIENCE_S)
            scenes[point] = watch.scene()
        if lost := watch.lost():
            raise AssertionError(f"an undisturbed store lost something: {lost[:3]}")
        return scenes, system.resident_mb()


def _rest(watch: Watch, frames: int, patience_s: float = PATIENCE_S) -> None:
    why = [""]

    def rests() -> bool:
        why[0] = watch.quiet(frames)
        return not why[0]

    if waited(rests, patience_s, 0.1) is None:
        raise TimeoutError(f"the system did not come to rest within {patience_s:.0f} s: {why[0]}")


class Voyage:
    """Runs the phases of one system. Iterate `outcomes`; a system that cannot go on ends them early."""

    def __init__(self, number: int, system: System, watch: Watch, known: Reference, *, lasting: bool = False) -> None:
        self.number, self.stream, self.known, self.lasting = number, system.stream, known, lasting
        self.system, self.watch = system, watch
        self._gate = 0
        self._before: tuple[int, Scene] | None = None  # the scene at the last quiet point

    def outcomes(self, phases: Sequence[Phase]) -> Iterator[Outcome]:
        """What came of each phase, while there is stream left."""
        self._to(GRID)
        _rest(self.watch, GRID)
        for number, phase in enumerate(phases):
            if self._gate + 2 * GRID > self.stream.frames or self.system.failed:
                return
            yield self._phase(number, phase)

    def _phase(self, number: int, phase: Phase) -> Outcome:
        said_before, expected_before = len(self.system.said), len(self.system.expected)
        problems: list[str] = []
        hits = self._disturbed(phase, problems)
        point = min(frames for frames in self.known.scenes if frames >= self._gate)
        self._to(point)
        alike: Mapping[str, float] = {}
        late_s = 0.0
        try:
            _rest(self.watch, point)
            rested_s = time.monotonic()
            while True:
                scene = self.watch.scene()
                alike = likeness(self.known.scene(point), scene)
                differs = [*differences(alike, self.known.tolerance, self.lasting), *self._ids_lost(point, scene)]
                late_s = time.monotonic() - rested_s
                if not differs or late_s > LATE_S:
                    break
                time.sleep(0.5)
            if differs:
                (self.system.folder / f"unequal-{number}.msgpack").write_bytes(encode(scene))
            problems += [*differs, *self.watch.lost()[:3]]
            self._before = point, scene
        except (TimeoutError, BusError) as error:
            problems.append(str(error))
        resident_mb = self.system.resident_mb()
        problems += [
            f"{name} holds {now_mb:.0f} MB (undisturbed {self.known.resident_mb[name]:.0f})"
            for name, now_mb in resident_mb.items()
            if now_mb > self.known.resident_mb.get(name, now_mb) + LEFT_MB
        ]
        if self.system.failed:
            problems.append(self.system.failed)
        expected = {*self.system.expected[expected_before:], *(plan.target for plan in phase)}
        ended = [text for text in self.system.said[said_before:] if " ended " in text]
        return Outcome(
            voyage=self.number,
            phase=number,
            stream=self.stream.name,
            frames=point,
            hits=hits,
            likeness=dict(alike) or dict.fromkeys(ASPECTS, 0.0),
            problems=problems,
            late_s=round(late_s, 1),
            beside=[text for text in ended if text.split()[0].rsplit("-", 1)[0] not in expected],
            resident_mb=resident_mb,
        )

    def _ids_lost(self, point: int, scene: Scene) -> list[str]:
        """Whether places that stand where they stood at the last quiet point have other ids, but for what changes in an
        undisturbed run as well."""
        if self._before is None:
            return []
        frames, before = self._before
        usual, kept = kept_ids(self.known.scene(frames), self.known.scene(point)), kept_ids(before, scene)
        return [f"{kept:.3f} of the place ids kept (undisturbed {usual:.3f})"] if kept < usual - ID_TOLERANCE else []

    def _disturbed(self, phase: Phase, problems: list[str]) -> list[Hit]:
        """Let the stream run until every fault is over and the system follows the stream again."""
        over: dict[Planned, tuple[float, int]] = {}  # when, and how many frames had been let through

        def do(plan: Planned) -> None:
            began_s = time.monotonic()
            try:
                done(self.system, self.watch, plan, lambda: over.update({plan: (time.monotonic(), self._gate)}))
            except Exception as error:
                problems.append(f"{plan.fault} of {plan.target} could not be done: {error!r}")
            over.setdefault(plan, (time.monotonic(), self._gate))
            lasted_s[plan] = time.monotonic() - began_s - plan.delay_s

        lasted_s: dict[Planned, float] = {}
        threads = [threading.Thread(target=do, args=(plan,), daemon=True) for plan in phase]
        for thread in threads:
            thread.start()
        recovered_s: dict[Planned, float] = {}
        end_s = time.monotonic() + PATIENCE_S
        while len(recovered_s) < len(phase) and time.monotonic() < end_s and not self.system.failed:
            self._flow()
            for plan, (at_s, frames) in tuple(over.items()):
                if plan not in recovered_s and self._follows(min(frames, self.stream.frames - 1), at_s):
                    recovered_s[plan] = time.monotonic() - at_s
            time.sleep(0.02)
        for thread in threads:
            thread.join(PATIENCE_S)
        for plan in phase:
            if plan not in recovered_s:
                problems.append(f"after {plan.fault} of {plan.target}, the stream was not followed")
        return [
            Hit(
                fault=plan.fault,
                target=plan.target,
                lasted_s=round(lasted_s.get(plan, 0.0), 2),
                recovered_s=round(recovered_s[plan], 2) if plan in recovered_s else None,
            )
            for plan in phase
        ]

    def _follows(self, frame: int, since_s: float) -> bool:
        """Whether the system has moved on to a frame after a moment; at the stream's end nothing need move."""
        at_end = self._gate >= self.stream.frames
        return self.watch.follows(frame, since_s) or (at_end and not self.watch.quiet(self._gate))

    _flowed_s = 0.0

    def _flow(self) -> None:
        """Let one more frame through when its time has come."""
        now_s = time.monotonic()
        if now_s - self._flowed_s >= FRAME_S and self._gate < min(
            self.stream.frames, min(self.watch.mapped, self.watch.seen) + 1 + AHEAD
        ):
            self._flowed_s = now_s
            self._to(self._gate + 1)

    def _to(self, frames: int) -> None:
        self._gate = frames
        self.system.open_gate(frames)


def sailed(
    number: int,
    stream: Stream,
    known: Reference,
    phases: Sequence[Phase],
    folder: Path,
    *,
    disk: Path | None = None,
    lasting: bool = False,
) -> Iterator[Outcome]:
    """The outcomes of one voyage, and one without hits where it could not go on, left something behind or left a log
    that cannot be read."""
    system = System(stream, folder, disk)
    faults = []
    try:
        with system, Watch(system.endpoint) as watch:
            yield from Voyage(number, system, watch, known, lasting=lasting).outcomes(phases)
    except (TimeoutError, BusError) as error:
        faults.append(f"the voyage ended early: {error}")
    faults += [f"left behind: {process.pid}" for process in system.processes()]
    for log in sorted(system.disk.glob("log-*.mcap")):
        try:
            summary(log)
        except LogError as error:
            faults.append(f"{log.name} cannot be read: {error}")
    if faults:
        alike = dict.fromkeys(ASPECTS, 1.0)
        yield Outcome(voyage=number, phase=-1, stream=stream.name, frames=0, hits=[], likeness=alike, problems=faults)

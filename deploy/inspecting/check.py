"""Looks at a source before it is mapped: reads a sample of it and says what was found."""

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import msgspec
import numpy as np

from prior_sg.deploy.inspecting.beside import Beside, truth_beside
from prior_sg.deploy.inspecting.following import Following
from prior_sg.schemas.frames import Keyframe
from prior_sg.services.ingest.core import selection
from prior_sg.services.ingest.core.config import Config
from prior_sg.services.ingest.core.frames import BadFrame, RawFrame
from prior_sg.services.ingest.core.inspection import Finding, Picker, Reading, Recording, Shot, inspect, problems
from prior_sg.services.ingest.core.inspection.conventions import FROM_CAMERA
from prior_sg.services.ingest.core.inspection.findings import note, ok, problem
from prior_sg.services.ingest.sources import Source
from prior_sg.services.losses import kind_of
from prior_sg.services.place_graph.core.config import Config as PlaceGraphConfig

PAIRS, LIMIT_S = 40, 3.5
BRIEF_PAIRS, BRIEF_FRAMES, BRIEF_LIMIT_S = 6, 60, 0.8
LIVE_FRAMES = 100  # of a running robot
COLORS = 12  # colour images decoded at most
Progress = Callable[[int, int], None]  # frames read, of how many


@dataclass(frozen=True)
class Report:
    """What a check found."""

    source: str
    layout: str
    summary: str  # one line
    findings: list[Finding]
    beside: Beside
    seconds: float

    @property
    def problems(self) -> list[Finding]:
        """Those that will spoil the map, hopeless ones first."""
        return problems(self.findings)

    @property
    def verdict(self) -> str:
        """The worst of all."""
        verdicts = {finding.verdict for finding in self.findings}
        return next(verdict for verdict in ("problem", "note", "ok") if verdict in verdicts | {"ok"})


def check(
    source: Source,
    cfg: Config,
    *,
    mapping: PlaceGraphConfig | None = None,
    brief: bool = False,
    progress: Progress = lambda done, total: None,
) -> Report:
    """Everything that a sample of the source tells; `brief` looks at its beginning only, in about a second.
    `mapping` is how the place graph will map it, None = as it does by itself."""
    started_s = time.monotonic()
    following = Following(mapping or PlaceGraphConfig())
    recording = look(source, cfg, following, brief=brief, progress=progress)
    beside = truth_beside(source)
    findings = [
        *_read_as(source),
        *inspect(recording, reading_of(source), thorough=not brief),
        *following.findings(),
        *beside.findings,
    ]
    return Report(
        source=str(source.path),
        layout=source.layout,
        summary=summary(source, recording),
        findings=findings,
        beside=beside,
        seconds=time.monotonic() - started_s,
    )


def unreadable(path: str, reason: str) -> Report:
    """The report on a source that cannot even be opened."""
    found = problem("source", reason, hopeless=True)
    return Report(source=path, layout="", summary="", findings=[found], beside=Beside(), seconds=0.0)


def unseen(path: str) -> Report:
    """The report on a source that can be read only once."""
    return Report(source=path, layout="", summary="", findings=[], beside=Beside(), seconds=0.0)


def look(
    source: Source,
    cfg: Config,
    following: Following,
    *,
    brief: bool = False,
    progress: Progress = lambda done, total: None,
) -> Recording:
    """Read a source: every stamp and pose, and some images; what the time does not suffice for is left out.
    `following` sees the keyframes."""
    end_s = time.monotonic() + (BRIEF_LIMIT_S if brief else LIMIT_S)
    recording = Recording(source.total, source.depth_unit_m)
    state = selection.State(robot="sample")  # nobody reads what it would publish
    total = source.total or LIVE_FRAMES
    frames = min(total, BRIEF_FRAMES) if brief else total
    wants = Picker(frames, BRIEF_PAIRS if brief else PAIRS).wants
    color_every = max(1, min(frames, 2 * PAIRS) // COLORS)
    for frame in source if source.thinned is None else source.thinned(wants):
        recording.read += 1
        if isinstance(frame, BadFrame):
            recording.unreadable[kind_of(frame.reason)] += 1
        else:
            _remember(recording, frame)
            _select(recording, state, frame, cfg, following)
            if frame.depth if source.thinned else wants(frame.index, recording.world_from_camera[-1]):
                _decode(recording, frame, with_color=not brief and len(recording.shots) % color_every == 0)
        progress(recording.read, frames)
        if time.monotonic() > end_s or (recording.read >= frames and (brief or not source.total)):
            break
    if source.live is not None:
        source.close()
    for held in state.continuity.release():
        recording.refused[kind_of(held.refusal.text)] += 1
    return recording


def reading_of(source: Source) -> Reading:
    """How the layout's loader read the written poses."""
    world = np.eye(4) if source.world_from_source is None else source.world_from_source
    said = source.convention
    if said is None:
        return Reading(world_from_source=world, fixed=True)
    return Reading(
        said.poses, said.quaternion, said.axes, FROM_CAMERA[said.axes], world, position_scale_m=said.position_scale_m
    )


def _read_as(source: Source) -> list[Finding]:
    """The layout and why it was recognised, and what the loader changed or assumed."""
    why = f": {'; '.join(source.why)}" if source.why else ""
    return [ok("layout", f"{source.layout}{why}"), *(note("reading", text) for text in source.notes)]


def summary(source: Source, recording: Recording) -> str:
    """One line: layout, frames, size, rate and depth."""
    camera = source.intrinsics
    stamps_s = np.diff(np.array(recording.stamps_ns, float)) / 1e9
    rising_s = stamps_s[stamps_s > 0]
    rate = f", {1 / float(np.median(rising_s)):.3g} Hz" if len(rising_s) else ""
    depths_m = [shot.depth[shot.depth > 0] * shot.depth_scale_m for shot in recording.shots]
    depth = ""
    if any(map(len, depths_m)):
        low_m, high_m = np.percentile(np.concatenate(depths_m), (1, 99), method="nearest")
        depth = f", depth {low_m:.3g} to {high_m:.3g} m"
    frames = f"{source.total} frames" if source.total else "live"
    return f"{source.layout}: {frames}, {camera.width_px} x {camera.height_px} pixels{rate}{depth}"


def _remember(recording: Recording, frame: RawFrame) -> None:
    recording.frame_ids.append(frame.frame_id)
    recording.cameras.append(frame.camera)
    recording.stamps_ns.append(frame.stamp_ns)
    recording.world_from_camera.append(np.array(frame.world_from_camera))


def _select(recording: Recording, state: selection.State, frame: RawFrame, cfg: Config, following: Following) -> None:
    """Let the selection see the frame, as it will in the run."""
    bare = msgspec.structs.replace(frame, color=b"", depth=b"", mask=b"")
    verdict = selection.judge(state, bare, cfg)
    for held in verdict.refused:
        recording.refused[kind_of(held.refusal.text)] += 1
        deque(selection.refuse(state, held), 0)
    for accepted in verdict.accepted:
        for _, message in selection.accept(state, accepted, cfg):
            if isinstance(message, Keyframe):
                following.see(message)
    recording.keyframes = state.keyframes


def _decode(recording: Recording, frame: RawFrame, *, with_color: bool) -> None:
    """Add the frame's images to the sample."""
    depth = _image(frame.depth, cv2.IMREAD_UNCHANGED)
    if depth is None or depth.ndim != 2:
        recording.damaged["the depth image is not one channel of numbers"] += 1
        return
    grey = _image(frame.color, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION) if with_color else None
    if with_color and grey is None:
        recording.damaged["the colour image is damaged"] += 1
    pose = recording.world_from_camera[-1]
    recording.shots.append(Shot(frame.index, frame.intrinsics, pose, depth, frame.depth_scale_m, grey, frame.camera))


def _image(data: bytes, flags: int) -> np.ndarray | None:
    try:
        return cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:  # empty, or a header that promises an absurd size
        return None

"""A camera at this computer as a source: pictures of a device, and poses of somebody else, joined by their stamps.

Pictures are drawn together and encoded only of frames that may become keyframes. The source ends --end-after seconds
after its last frame, or with the recording that is played back.
"""

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np

from prior_sg.services.geometry import pose_from_quaternion
from prior_sg.services.ingest.core.config import Config
from prior_sg.services.ingest.core.due import Due
from prior_sg.services.ingest.core.frames import BadFrame, RawFrame, View
from prior_sg.services.ingest.core.options import ReadOptions, check_posed
from prior_sg.services.ingest.core.pixels import encoded
from prior_sg.services.ingest.core.poses import FROM_CAMERA, Convention
from prior_sg.services.ingest.sources.base import Event, Found, Images, Source, SourceError
from prior_sg.services.ingest.sources.devices.device import Capture
from prior_sg.services.ingest.sources.devices.rig import Posed, Rig, first
from prior_sg.services.ingest.sources.normalise import prepare
from prior_sg.services.ingest.sources.normaliser import UNUSABLE, Normaliser

NAME = "camera"
SAMPLES, LOOK_S = 3, 10.0
NO_IMAGES = Images(b"", b"")


@dataclass(frozen=True)
class Mounting:
    """What the poses that are said mean for the camera."""

    convention: Convention
    body_from_camera: np.ndarray  # (4, 4), in the body's kind of axes

    @staticmethod
    def of(options: ReadOptions) -> "Mounting":
        """As the options say."""
        told = np.array(options.body_from_camera or (0.0, 0, 0, 0, 0, 0, 1))
        mount = pose_from_quaternion(told[:3], told[3:] / np.linalg.norm(told[3:]))
        return Mounting(Convention().changed(options), mount)

    def pose(self, posed: Posed) -> np.ndarray:
        """source_from_camera (4, 4). Raises PoseError."""
        written = replace(self.convention, axes="opencv").of_matrix(posed.source_from_body)
        return written @ self.body_from_camera @ FROM_CAMERA[self.convention.axes]


def load(path: Path, options: ReadOptions) -> Source:
    """A camera as a source. Raises SourceError, and ExtraMissing where its package is not installed."""
    source = str(path)
    try:
        check_posed(source, options.pose_source)
    except ValueError as error:
        raise SourceError(str(error)) from error
    if options.rate_hz:
        raise SourceError("a camera has stamps: leave out --rate")
    rig, mounting = Rig(source, options), Mounting.of(options)
    try:
        normaliser, notes = _looked_at(rig, source, mounting, options)
    except BaseException:
        rig.close()
        raise
    stop = threading.Event()
    held = [rig]  # open already: the first who reads goes on with it, so that nothing is lost in between

    def stream(wanted: Callable[[View], bool]) -> Iterator[Event]:
        with Stream(held.pop() if held else Rig(source, options), normaliser, mounting, wanted) as one:
            yield from one.events(stop, options.end_after_s)

    def frames() -> Iterator[RawFrame | BadFrame]:
        return (event for event in stream(lambda view: True) if isinstance(event, RawFrame | BadFrame))

    def close() -> None:
        stop.set()
        while held:
            held.pop().close()

    return Source(
        layout=NAME,
        path=path,
        intrinsics=normaliser.intrinsics,
        total=0,
        frames=frames,
        live=lambda: stream(Due(options) if isinstance(options, Config) else lambda view: True),
        close=close,
        why=(f"{rig.feed.device.name} is open",),
        notes=notes,
        origin_m=normaliser.origin_m,
        convention=mounting.convention,
        depth_unit_m=normaliser.depth.unit_m,
        world_from_source=normaliser.world_from_source,
    )


def _looked_at(rig: Rig, source: str, mounting: Mounting, options: ReadOptions) -> tuple[Normaliser, tuple[str, ...]]:
    """What the first frames say. Raises SourceError."""
    device = rig.feed.device
    found = Found(NAME, Path(source), device.camera, device.depth_scale_m, (), convention=mounting.convention)
    try:
        samples = [(mounting.pose(one), images_of(one.capture)) for one in first(rig, source, SAMPLES, LOOK_S)]
        normaliser, notes = prepare(found, options, samples)
    except UNUSABLE as error:
        raise SourceError(f"{source}: {error}") from error
    return normaliser, (rig.poses.said, *filter(None, (device.note,)), *notes)


def images_of(capture: Capture) -> Images:
    """The pictures of a frame as files. Raises FrameError."""
    color, depth = capture.images()
    return Images(encoded(color, ".png"), encoded(depth, ".png"))


class Stream:
    """What a camera gives from now on; closes it in the end."""

    def __init__(self, rig: Rig, normaliser: Normaliser, mounting: Mounting, wanted: Callable[[View], bool]) -> None:
        self._rig, self._normaliser, self._mounting, self._wanted = rig, normaliser, mounting, wanted
        self._frames = 0

    def __enter__(self) -> "Stream":
        return self

    def __exit__(self, *_: object) -> None:
        self._rig.close()

    def events(self, stop: threading.Event, quiet_s: float) -> Iterator[Event]:
        """Until nothing has come for a while, the recording is over or the source is closed."""
        heard_s = time.monotonic()
        while not (stop.is_set() or self._rig.ended or 0 < quiet_s < time.monotonic() - heard_s):
            for posed in self._rig.ready():
                heard_s = time.monotonic()
                yield self._frame(posed)
            yield from self._rig.tally.words()
        yield from self._rig.tally.words(ended=True)

    def _frame(self, posed: Posed) -> RawFrame | BadFrame:
        """A frame, its images only where it may become a keyframe."""
        number, stamp_ns = self._frames, posed.capture.stamp_ns
        self._frames += 1
        try:
            pose = self._mounting.pose(posed)
            if not self._wanted(View(number, stamp_ns, self._normaliser.pose(pose))):
                bare = self._normaliser.bare(number, 0, number, stamp_ns, pose, NO_IMAGES)
                return msgspec.structs.replace(bare, pose_only=True)
            return self._normaliser.frame(number, 0, number, stamp_ns, pose, images_of(posed.capture))
        except UNUSABLE as error:
            return BadFrame(frame_id=number, reason=str(error), index=number, total=0)

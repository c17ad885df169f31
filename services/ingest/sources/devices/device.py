"""What a camera is to us, whoever makes it."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from prior_sg.services.ingest.sources.base import Camera


class DeviceGone(Exception):
    """A camera gives no more pictures; the text is one sentence."""


@dataclass(frozen=True)
class Capture:
    """Colour and depth of one moment."""

    number: int  # by the camera's count, which tells what was lost
    stamp_ns: int
    received_ns: int
    images: Callable[[], tuple[np.ndarray, np.ndarray]] = field(repr=False)
    """Blue green red (h, w, 3) uint8, and depth (h, w) uint16 in the camera's units in the same pixels. Raises
    FrameError."""


class Device(Protocol):
    """An open camera. Not for use by several threads."""

    name: str  # such as "Intel RealSense D455 (serial number 1234)"
    camera: Camera  # of colour
    depth_scale_m: float
    note: str  # on its stamps

    def capture(self, timeout_s: float) -> Capture | None:
        """The next one; None when none comes in time, or at the end of a recording. Raises DeviceGone."""
        ...

    @property
    def ended(self) -> bool:
        """Whether a recording is over; never of a camera."""
        ...

    def close(self) -> None:
        """Let go of the camera."""
        ...

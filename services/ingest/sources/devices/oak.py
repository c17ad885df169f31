"""Cameras of Luxonis (OAK), by depthai 3.

oak:          the only camera, or any
oak:SERIAL    the camera with this serial number (its device id)

Colour of 640 x 400 pixels at 30 Hz, straightened by the camera, and depth in the same pixels, as depthai's node RGBD
joins them on every kind of these cameras. Stamps are those of this computer's clock that depthai gives, as since 1970.
What depthai itself says of the camera's movement (its node BasaltVIO) is not read. Source: docs.luxonis.com,
software-v3.
"""

import time
from datetime import timedelta
from functools import partial
from typing import Any

import numpy as np

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.ingest.sources.base import MILLIMETRE, Camera, SourceError
from prior_sg.services.ingest.sources.devices.device import Capture, DeviceGone
from prior_sg.services.runtime import extras

SCHEME = "oak:"
SIZE_PX, RATE_HZ = (640, 400), 30.0
WAITING = 8  # frames that depthai keeps; of more the oldest are lost
FIRST_S, GONE_S = 10.0, 3.0  # for the first picture, and without a further one


def open_camera(serial: str) -> "Oak":
    """A camera by its serial number. Raises SourceError, and ExtraMissing without depthai."""
    extras.require_module("depthai", f"{SCHEME}{serial}")
    import depthai as dai

    found = {info.getDeviceId(): info for info in dai.Device.getAllAvailableDevices()}
    if serial and serial not in found:
        raise SourceError(f"{SCHEME}{serial} is not there: {', '.join(sorted(found)) or 'no OAK camera'} is")
    if not found:
        raise SourceError(
            f"{SCHEME} no OAK camera is there: plug it in, and see that this user may use it (udev rules)"
        )
    try:
        device = dai.Device(found[serial] if serial else next(iter(found.values())))
        pipeline = dai.Pipeline(device)
        node = pipeline.create(dai.node.RGBD).build(True, dai.node.StereoDepth.PresetMode.DEFAULT, SIZE_PX, RATE_HZ)
        queue = node.rgbd.createOutputQueue(maxSize=WAITING, blocking=False)
        pipeline.start()
        return Oak(pipeline, queue, f"OAK (serial number {device.getDeviceId()})")
    except RuntimeError as error:
        raise SourceError(f"{SCHEME}{serial} cannot be opened: {' '.join(str(error).split())[:150]}") from error


class Oak:
    """An open camera."""

    depth_scale_m = MILLIMETRE
    ended = False
    note = ""

    def __init__(self, pipeline: Any, queue: Any, name: str) -> None:
        """Waits for the first picture. Raises SourceError."""
        self._pipeline, self._queue, self.name = pipeline, queue, name
        self._heard_s = time.monotonic()
        first = self._queue.get(timedelta(seconds=FIRST_S))
        if first is None:
            pipeline.stop()
            raise SourceError(f"{name} gives no picture: plug it into USB 3, or another cable")
        self.camera = camera_of(first.getRGBFrame())

    def capture(self, timeout_s: float) -> Capture | None:
        """See Device."""
        try:
            data = self._queue.get(timedelta(seconds=timeout_s))
        except RuntimeError as error:  # QueueException, where the pipeline has stopped
            raise DeviceGone(f"{self.name} is gone: {' '.join(str(error).split())[:150]}") from error
        now_s = time.monotonic()
        if data is None:
            if not self._pipeline.isRunning() or now_s - self._heard_s > GONE_S:
                raise DeviceGone(f"{self.name} has given no picture for {GONE_S:g} s: is it unplugged?")
            return None
        self._heard_s = now_s
        return capture_of(data, time.time_ns(), time.monotonic_ns())

    def close(self) -> None:
        """See Device."""
        self._pipeline.stop()


def capture_of(data: Any, now_ns: int, steady_ns: int) -> Capture:
    """A message of RGBD; `now_ns` and `steady_ns` are one moment by the two clocks of this computer."""
    stamp_ns = round(data.getTimestamp() / timedelta(microseconds=1)) * 1000 + now_ns - steady_ns
    return Capture(int(data.getSequenceNum()), stamp_ns, now_ns, partial(_images, data))


def camera_of(color: Any) -> Camera:
    """The camera of a colour frame, which depthai has straightened."""
    (fx, _, cx), (_, fy, cy), _ = color.getTransformation().getIntrinsicMatrix()
    return Camera(Intrinsics(color.getWidth(), color.getHeight(), fx, fy, cx, cy))


def _images(data: Any) -> tuple[np.ndarray, np.ndarray]:
    return np.array(data.getRGBFrame().getCvFrame()), np.array(data.getDepthFrame().getFrame())

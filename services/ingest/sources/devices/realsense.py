"""Cameras of RealSense, by pyrealsense2, and their recordings played back as if the camera were there.

realsense:            the only camera, or any
realsense:SERIAL      the camera with this serial number
realsense:FILE        a recording of the RealSense Viewer or of `enable_record_to_file`, .bag or .db3

Colour and depth of 640 x 480 pixels at 30 Hz (of a recording, as recorded); depth is drawn into the colour camera by
`rs.align`, for frames that may become keyframes. Stamps are the library's, in the time of this computer where it
gives that (global time), else that of the camera's clock, moved so that the first frame is stamped when it came; of a
recording they are the recorded ones. Coefficients of the inverse Brown-Conrady model are read as OpenCV's, as the
maker's ROS node does. Source: github.com/IntelRealSense/librealsense, doc/frame_lifetime.md, wrappers/python.
"""

import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.ingest.sources.base import Camera, FrameError, SourceError
from prior_sg.services.ingest.sources.devices.device import Capture, DeviceGone
from prior_sg.services.opencv import cv2
from prior_sg.services.runtime import extras

SCHEME = "realsense:"
WIDTH_PX, HEIGHT_PX, RATE_HZ = 640, 480, 30
GONE_S = 3.0  # without a frame, a camera is taken to be gone
RECORDINGS = (".bag", ".db3")  # of the library before and since 2.58


def open_camera(name: str) -> "RealSense":
    """A camera by its serial number, a recording by its file. Raises SourceError, and ExtraMissing."""
    extras.require_module("pyrealsense2", f"{SCHEME}{name}")
    try:
        import pyrealsense2 as rs
    except ImportError as error:  # its wheel leaves libusb to the system
        raise SourceError(
            f"{SCHEME}{name}: pyrealsense2 cannot be loaded ({error}): install the library it names"
        ) from error

    recorded = name.endswith(RECORDINGS)
    config = rs.config()
    if recorded:
        if not Path(name).is_file():
            raise SourceError(f"{SCHEME}{name}: there is no such recording")
        config.enable_device_from_file(name, repeat_playback=False)
        config.enable_stream(rs.stream.depth)
        config.enable_stream(rs.stream.color)
    else:
        if name:
            config.enable_device(name)
        config.enable_stream(rs.stream.depth, WIDTH_PX, HEIGHT_PX, rs.format.z16, RATE_HZ)
        config.enable_stream(rs.stream.color, WIDTH_PX, HEIGHT_PX, rs.format.bgr8, RATE_HZ)
    pipeline = rs.pipeline()
    try:
        return RealSense(rs, pipeline, pipeline.start(config), recorded)
    except RuntimeError as error:
        mend = "record colour and depth" if recorded else "plug it in (USB 3), and see `rs-enumerate-devices`"
        raise SourceError(f"{SCHEME}{name} cannot be opened ({' '.join(str(error).split())[:150]}): {mend}") from error


class RealSense:
    """An open camera, or a recording that is played back."""

    def __init__(self, rs: Any, pipeline: Any, profile: Any, recorded: bool) -> None:
        self._rs, self._pipeline, self._align = rs, pipeline, rs.align(rs.stream.color)
        self._playback = profile.get_device().as_playback() if recorded else None
        device = profile.get_device()
        self.name = (
            f"{_info(device, rs.camera_info.name)} (serial number {_info(device, rs.camera_info.serial_number)})"
        )
        color = profile.get_stream(rs.stream.color).as_video_stream_profile()
        self.camera = _camera(rs, color.get_intrinsics())
        self.depth_scale_m = float(device.first_depth_sensor().get_depth_scale())
        self.note = "stamps are those of the recording" if recorded else ""
        self._offset_ns: int | None = 0 if recorded else None
        self._heard_s = time.monotonic()

    def capture(self, timeout_s: float) -> Capture | None:
        """See Device."""
        try:
            there, frames = self._pipeline.try_wait_for_frames(round(timeout_s * 1000))
        except RuntimeError as error:
            raise DeviceGone(f"{self.name} is gone: {' '.join(str(error).split())[:150]}") from error
        if not there:
            if not self.ended and time.monotonic() - self._heard_s > GONE_S:
                raise DeviceGone(f"{self.name} has given no picture for {GONE_S:g} s: is it unplugged?")
            return None
        self._heard_s = time.monotonic()
        color = frames.get_color_frame()
        if not color or not frames.get_depth_frame():
            return None
        frames.keep()  # else the library's pool of frames runs empty while one waits for its pose
        received_ns = time.time_ns()
        stamp_ns = round(color.get_timestamp() * 1e6) + self._offset(color, received_ns)
        return Capture(int(color.get_frame_number()), stamp_ns, received_ns, partial(self._images, frames))

    @property
    def ended(self) -> bool:
        """See Device."""
        return self._playback is not None and self._playback.current_status() == self._rs.playback_status.stopped

    def close(self) -> None:
        """See Device."""
        self._pipeline.stop()

    def _offset(self, color: Any, received_ns: int) -> int:
        """From the stamps to the time of this computer, ns."""
        if self._offset_ns is None:
            own = color.get_frame_timestamp_domain() == self._rs.timestamp_domain.hardware_clock
            self._offset_ns = received_ns - round(color.get_timestamp() * 1e6) if own else 0
        return self._offset_ns

    def _images(self, frames: Any) -> tuple[np.ndarray, np.ndarray]:
        aligned = self._align.process(frames)
        color, depth = aligned.get_color_frame(), aligned.get_depth_frame()
        if not color or not depth:
            raise FrameError("its depth could not be drawn into the colour camera")
        return self._blue_green_red(color), np.array(depth.get_data())

    def _blue_green_red(self, color: Any) -> np.ndarray:
        pixels, kind, formats = np.asanyarray(color.get_data()), color.get_profile().format(), self._rs.format
        if kind == formats.bgr8:
            return np.array(pixels)
        codes = {formats.rgb8: cv2.COLOR_RGB2BGR, formats.rgba8: cv2.COLOR_RGBA2BGR, formats.bgra8: cv2.COLOR_BGRA2BGR}
        if kind not in codes:
            raise FrameError(f"its colour has the format {kind}: record rgb8 or bgr8")
        return cv2.cvtColor(pixels, codes[kind])


def _info(device: Any, which: Any) -> str:
    return str(device.get_info(which)) if device.supports(which) else "unknown"


def _camera(rs: Any, of: Any) -> Camera:
    """The camera of colour. Raises SourceError."""
    kinds = rs.distortion
    lenses = {kinds.kannala_brandt4: ("fisheye", 4), kinds.brown_conrady: ("opencv", 5)}
    lenses |= {kinds.inverse_brown_conrady: ("opencv", 5), kinds.modified_brown_conrady: ("opencv", 5)}
    intrinsics = Intrinsics(of.width, of.height, of.fx, of.fy, of.ppx, of.ppy)
    if of.model == kinds.none or not any(of.coeffs):
        return Camera(intrinsics)
    if of.model not in lenses:
        raise SourceError(
            f"its lens has the model {of.model}, which is not known: give --camera-model and --distortion"
        )
    model, count = lenses[of.model]
    return Camera(intrinsics, model, tuple(float(value) for value in of.coeffs[:count]))

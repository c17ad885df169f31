"""A source of the live page, running or recorded, for Foxglove's `Open connection`."""

import threading
import time
from collections.abc import Callable

import cv2
import foxglove
import msgspec
import numpy as np
from foxglove.websocket import ChannelView, Client, ServerListener

from prior_sg.deploy.errors import UserError
from prior_sg.deploy.viewing.foxglove.stream import Stream
from prior_sg.deploy.viewing.sources import Camera, Source
from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.errors import PriorSgError
from prior_sg.services.images import ImageFault, depth_of

LOOPBACK = "127.0.0.1"  # Foxglove's protocol knows no login
AGAIN_S = (
    1.0  # after somebody has subscribed all is sent once more: the first time may have been before they were heard
)
SURFACE_S = 2.0  # at least, between sendings of the coloured points
ANY_CENTRE = float("inf")  # share of the image by which a principal point may lie off: what is shown is not mapped
BACKLOG = 256  # messages that wait for a slow client before the oldest goes


class _Newcomers(ServerListener):
    """Tells that somebody has subscribed, who has seen nothing yet."""

    def __init__(self) -> None:
        self.came = threading.Event()

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        """Called on a thread of the server."""
        self.came.set()


class Broadcast:
    """Serves what a source shows, on this machine only; nobody can write to it. Raises UserError."""

    def __init__(self, source: Source, port: int) -> None:
        self._source = source
        self._newcomers = _Newcomers()
        context = foxglove.Context()
        self._stream = Stream(context)
        try:
            self._server = foxglove.start_server(
                name=f"Prior-SG: {source.robot}, {source.title}",
                host=LOOPBACK,
                port=port,
                context=context,
                server_listener=self._newcomers,
                message_backlog_size=BACKLOG,
            )
        except RuntimeError as error:
            raise UserError(f"nothing can be served on port {port} ({error}); choose another with --port") from error
        self._again_s: float | None = None
        self._points, self._surface_s, self._frame = -1, 0.0, -1
        self._stamp_ns, self._fault = 0, ""

    @property
    def address(self) -> str:
        """What to open in Foxglove."""
        return f"ws://{LOOPBACK}:{self._server.port}"

    def follow(self, wait_s: float) -> None:
        """Wait so long for something new, and send what there is of it; what fails is noted, and tried again."""
        news = self._source.wait(wait_s)
        if self._is_to_tell_all(time.monotonic()):
            self._stream.forget()
            self._points, self._surface_s, self._frame, news = -1, 0.0, -1, True
        try:
            if news or self._fault:
                scene = self._source.scene()
                self._stamp_ns = scene.stamp_ns
                self._stream.show(scene, scene.stamp_ns)
            self._send_camera()
            self._send_surface()
            self._fault = ""
        except PriorSgError as error:
            if str(error) != self._fault:
                self._stream.note(str(error), self._stamp_ns)
            self._fault = str(error)

    def _is_to_tell_all(self, now_s: float) -> bool:
        """Once when somebody has subscribed, and once more when their subscription surely stands."""
        if self._newcomers.came.is_set():
            self._newcomers.came.clear()
            self._again_s = now_s + AGAIN_S
            return True
        if self._again_s is not None and now_s >= self._again_s:
            self._again_s = None
            return True
        return False

    def _send_camera(self) -> None:
        camera = self._source.camera()
        if camera is not None and camera.frame_id != self._frame:
            self._frame = camera.frame_id
            self._stream.camera(jpeg_of(camera), lens_of(camera), camera.world_from_camera, camera.stamp_ns)
            if (depth_m := depth_m_of(camera)) is not None:
                self._stream.depth(depth_m, camera.stamp_ns)

    def _send_surface(self) -> None:
        points, now_s = len(self._source.cloud), time.monotonic()
        if points != self._points and self._stamp_ns and now_s - self._surface_s >= SURFACE_S:
            self._points, self._surface_s = points, now_s
            self._stream.surface(self._source.cloud.picture(), self._stamp_ns)

    def close(self) -> None:
        """End all connections."""
        self._server.stop()


def serve(source: Source, port: int, say: Callable[[str], None], wait_s: float, insist: Callable[[], None]) -> None:
    """Serve until `insist` raises."""
    broadcast = Broadcast(source, port)
    say(broadcast.address)
    try:
        while True:
            insist()
            broadcast.follow(wait_s)
    finally:
        broadcast.close()


def jpeg_of(camera: Camera) -> bytes:
    """The image as a file."""
    return bytes(cv2.imencode(".jpg", np.ascontiguousarray(camera.image[:, :, ::-1]))[1].tobytes())


def depth_m_of(camera: Camera) -> np.ndarray | None:
    """Depth (h, w), metres, of the image's pixels; None where there is none that can be read."""
    if camera.depth is None:
        return None
    try:
        depth_m = depth_of(camera.depth, ANY_CENTRE)
    except ImageFault:
        return None
    return cv2.resize(depth_m, camera.image.shape[1::-1], interpolation=cv2.INTER_NEAREST)


def lens_of(camera: Camera) -> Intrinsics:
    """The lens of the image as it is, made smaller; centres of pixels have whole numbers."""
    lens = camera.intrinsics
    rows, columns = camera.image.shape[:2]
    scale_u, scale_v = columns / lens.width_px, rows / lens.height_px
    return msgspec.structs.replace(
        lens,
        width_px=columns,
        height_px=rows,
        fx_px=lens.fx_px * scale_u,
        fy_px=lens.fy_px * scale_v,
        cx_px=(lens.cx_px + 0.5) * scale_u - 0.5,
        cy_px=(lens.cy_px + 0.5) * scale_v - 0.5,
    )

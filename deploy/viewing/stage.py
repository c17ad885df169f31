"""The three-dimensional side of the page: pictures become viser's batched nodes, and only what differs is sent."""

import asyncio
import contextlib
import io
import logging
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser
import viser.transforms

from prior_sg.deploy.viewing.drawing import Theme
from prior_sg.deploy.viewing.gate import MOST_VIEWERS, watch
from prior_sg.deploy.viewing.shapes import Arrows, Difference, Lines, Mesh, Name, Picture, Points, Shape, difference
from prior_sg.deploy.viewing.sources import Camera

FOV_RAD, ELEVATION_RAD = np.deg2rad(38.0), np.deg2rad(62.0)
PANEL_PX, PHONE_PX = 360, 700  # width that the controls cover; below this width they lie at the bottom
SHEET_SHARE = 0.58  # of the height that they cover there
ROOM = 1.06  # around the map
CAMERA_NODE = "/camera/last"
CLOSE_S = 0.5  # that a viewer has to say goodbye in, then it is cut off


@dataclass(frozen=True)
class Layer:
    """What can be switched on and off together."""

    name: str  # first part of its nodes' names
    title: str
    shown: bool


LAYERS = (
    Layer("map", "Map points", True),
    Layer("regions", "Regions", True),
    Layer("zones", "Zones", False),
    Layer("floors", "Floors", False),
    Layer("buildings", "Buildings", False),
    Layer("districts", "Districts", False),
    Layer("places", "Places", True),
    Layer("edges", "Edges", True),
    Layer("objects", "Objects", True),
    Layer("unnamed", "Unnamed objects", False),
    Layer("markers", "Printed markers", True),
    Layer("way", "Way there", True),
    Layer("trajectory", "Robot's way", True),
    Layer("camera", "Camera", True),
    Layer("frontiers", "Openings", False),
    Layer("foreseen", "Expected beyond", True),
    Layer("answers", "Answers", True),
)


class SafeServer(viser.ViserServer):
    """A server on this machine alone, for pages that come from it.

    A browser lets any web page open a socket to this machine: one that another page opened is closed before anything is
    said. Of the others, so many at once, only what a viewer can say is taken. Links through a third party cannot be
    asked for.
    """

    def __init__(self, host: str, port: int) -> None:
        warnings.filterwarnings("ignore", "Queued a .* on a closed connection")  # viewers leave when they like
        logging.getLogger("websockets.server").addFilter(_is_no_handshake)
        with contextlib.redirect_stdout(io.StringIO()):  # it prints a banner of its own
            super().__init__(host=host, port=port, verbose=False)
        self._viewers: set[int] = set()
        self._websock_server._client_connect_cb.insert(0, self._admit)  # before anything is made for it
        self._websock_server.on_client_disconnect(self._forget)
        self._event_loop.call_soon_threadsafe(self._event_loop.set_exception_handler, _unless_crowded)
        self._websock_server.disconnect_all_clients()  # who came before that was not looked at, and comes again

    async def _admit(self, client: Any) -> None:
        connection: Any = self._websock_server._live_connections[client.client_id]
        watch(connection, lambda: self.gui)
        connection.close_timeout = CLOSE_S
        headers = connection.request.headers
        origins, hosts = headers.get_all("Origin"), headers.get_all("Host")
        host = hosts[0] if len(hosts) == 1 else ""
        if any(origin.split("://")[-1] != host for origin in origins) or not _is_local(host):
            await connection.close(1008, "pages of other sites may not look at this map")
        elif len(self._viewers) >= MOST_VIEWERS:
            await connection.close(1013, f"{MOST_VIEWERS} look at this map already")
        else:
            self._viewers.add(client.client_id)

    async def _forget(self, client: Any) -> None:
        self._viewers.discard(client.client_id)

    def request_share_url(self, verbose: bool = True) -> str | None:
        return None


def _is_no_handshake(record: logging.LogRecord) -> bool:
    """Whether a line of the log says more than that somebody did not speak the protocol."""
    return record.getMessage() != "opening handshake failed"


def _unless_crowded(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Tell of faults, and not of each of a thousand connections that there was no room for."""
    if not context["message"].startswith("socket.accept()"):
        loop.default_exception_handler(context)


def _is_local(host: str) -> bool:
    """Whether a Host header names this machine: another name that leads here belongs to somebody else."""
    return host.rsplit(":", 1)[0] in ("localhost", "127.0.0.1", "[::1]")


class Stage:
    """Shows pictures on a server."""

    def __init__(self, server: viser.ViserServer, theme: Theme) -> None:
        self._server, self._theme = server, theme
        self.picture: Picture = {}  # what the page shows
        self._nodes: dict[str, Any] = {}
        self._layers = {
            layer.name: server.scene.add_frame(f"/{layer.name}", show_axes=False, visible=layer.shown)
            for layer in LAYERS
        }
        self._camera: tuple[int, bytes] | None = None
        self._bounds: tuple[np.ndarray, np.ndarray] | None = None
        server.scene.world_axes.visible = False
        server.scene.set_background_image(np.full((1, 1, 3), theme.background, np.uint8), format="png")
        server.on_client_connect(self.frame)

    def show(self, picture: Picture) -> Difference:
        """Make the page show this picture; what was sent for it."""
        found = difference(self.picture, picture)
        with self._server.atomic():
            for name in found.removed:
                self._nodes.pop(name).remove()
            for name, shape in found.changed.items():
                self._put(name, shape)
        self.picture = picture
        return found

    def _put(self, name: str, shape: Shape) -> None:
        """Add a node or replace it. A name only changes its text, so that it does not blink."""
        scene, old = self._server.scene, self.picture.get(name)
        match shape:
            case Name() if isinstance(old, Name):
                node = self._nodes[name]
                if node.text != shape.text:
                    node.text = shape.text
                node.position = shape.position_m
                node.font_screen_scale = shape.scale
            case Name():
                self._nodes[name] = scene.add_label(
                    name,
                    shape.text,
                    position=shape.position_m,
                    font_screen_scale=shape.scale,
                    anchor="center-center",
                )
            case Points():
                self._nodes[name] = scene.add_point_cloud(
                    name,
                    shape.points_m,
                    shape.colors,
                    point_size=shape.size_m,
                    point_shape="circle" if name.startswith(("/places", "/answers", "/way")) else "square",
                    point_shading="flat",
                    precision="float32",
                )
            case Lines():
                self._nodes[name] = scene.add_line_segments(
                    name, shape.points_m, shape.colors, thickness=shape.width_px, thickness_units="screen"
                )
            case Mesh():
                self._nodes[name] = scene.add_mesh_simple(
                    name,
                    shape.vertices_m,
                    shape.faces,
                    color=shape.color,
                    opacity=shape.opacity,
                    side="double",
                    cast_shadow=False,
                    receive_shadow=False,
                )
            case Arrows():
                self._nodes[name] = scene.add_arrows(
                    name,
                    shape.points_m,
                    shape.color,
                    shaft_radius=shape.shaft_m,
                    head_radius=3 * shape.shaft_m,
                    head_length=6 * shape.shaft_m,
                )

    def switch(self, layer: str, on: bool) -> None:
        """Show or hide a layer."""
        self._layers[layer].visible = on

    def is_on(self, layer: str) -> bool:
        """Whether a layer is shown."""
        return bool(self._layers[layer].visible)

    def look(self, camera: Camera | None) -> None:
        """Show an image where it was taken."""
        told = None if camera is None else (camera.frame_id, camera.world_from_camera.tobytes())
        if told == self._camera:
            return
        self._camera = told
        if camera is None:
            self._server.scene.remove_by_name(CAMERA_NODE)
            return
        lens, pose = camera.intrinsics, camera.world_from_camera
        self._server.scene.add_camera_frustum(
            CAMERA_NODE,
            fov=2 * float(np.arctan2(lens.height_px / 2, lens.fy_px)),
            aspect=lens.width_px / lens.height_px,
            scale=0.45,
            thickness=2.0,
            thickness_units="screen",
            color=self._theme.path,
            image=camera.image,
            format="jpeg",
            jpeg_quality=80,
            wxyz=viser.transforms.SO3.from_matrix(pose[:3, :3]).wxyz,
            position=pose[:3, 3],
            cast_shadow=False,
            receive_shadow=False,
        )

    def set_bounds(self, low_m: np.ndarray, high_m: np.ndarray) -> None:
        """Where the map is. Who looks on when this is first known sees all of it; later, eyes stay where they are."""
        first, self._bounds = self._bounds is None, (low_m, high_m)
        if first:
            for client in self._server.get_clients().values():
                self.frame(client)

    def frame(self, client: viser.ClientHandle) -> None:
        """Turn one viewer's eye so that the whole map is seen beside the controls."""
        if self._bounds is None:
            return
        width, height = max(client.camera.image_width, 1), max(client.camera.image_height, 1)
        free = (max(1 - PANEL_PX / width, 0.3), 1.0) if width > PHONE_PX else (1.0, 1 - SHEET_SHARE)
        eye, target = pose_for(*self._bounds, width / height, free)
        with client.atomic():
            client.camera.fov = float(FOV_RAD)
            client.camera.up_direction = (0.0, 0.0, 1.0)
            client.camera.position = eye
            client.camera.look_at = target


def pose_for(
    low_m: np.ndarray, high_m: np.ndarray, aspect: float, free: tuple[float, float] = (1.0, 1.0)
) -> tuple[np.ndarray, np.ndarray]:
    """An eye (3,) and where it looks (3,) so that a box fits what is free of a window: shares of its width, from the
    left, and of its height, from the top. The box's longer side lies along the longer side of that part.
    """
    middle, size = (low_m + high_m) / 2, high_m - low_m
    along_x = (size[0] >= size[1]) == (aspect * free[0] >= free[1])
    back = np.array((0.0, -1.0, 0.0) if along_x else (1.0, 0.0, 0.0))
    to_eye = back * np.cos(ELEVATION_RAD) + np.array((0.0, 0.0, np.sin(ELEVATION_RAD)))
    right = np.cross((0.0, 0.0, 1.0), back)
    up = np.cross(to_eye, right)
    half = np.tan(FOV_RAD / 2) * np.array((aspect, 1.0))  # of the window, one metre away
    low, high = np.array((-1.0, 1 - 2 * free[1])) * half, np.array((2 * free[0] - 1, 1.0)) * half
    center, room = (low + high) / 2, (high - low) / 2 / ROOM
    corners = np.array([np.where([number >> axis & 1 for axis in range(3)], high_m, low_m) for number in range(8)])
    reach_m = 1.0
    while True:  # a little farther away, until every corner is in
        target = middle - reach_m * (center @ np.stack((right, up)))
        seen = corners - (target + reach_m * to_eye)
        depths = seen @ -to_eye
        plane = np.stack((seen @ right, seen @ up), axis=1) / np.maximum(depths, 1e-6)[:, None]
        if (depths > 0).all() and (np.abs(plane - center) <= room).all():
            return target + reach_m * to_eye, target
        reach_m *= 1.03

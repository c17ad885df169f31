"""A furnished room seen by a camera: depth and colour images by casting rays at boxes."""

import numpy as np

from prior_sg.schemas.frames import Intrinsics

CAMERA = Intrinsics(width_px=96, height_px=72, fx_px=70.0, fy_px=70.0, cx_px=47.5, cy_px=35.5)
ROOM_M = (np.array((-3.0, -2.5, 0.0)), np.array((3.0, 2.5, 2.6)))
FURNITURE_M = (  # boxes: a table, a wardrobe, a shelf, a stool
    (np.array((0.6, 0.4, 0.0)), np.array((1.8, 1.2, 0.75))),
    (np.array((-2.9, -2.4, 0.0)), np.array((-1.9, -1.8, 2.0))),
    (np.array((2.2, -1.5, 0.0)), np.array((2.7, 0.1, 1.1))),
    (np.array((-1.2, 1.3, 0.0)), np.array((-0.8, 1.7, 0.5))),
)


def pose(x_m: float, y_m: float, z_m: float, heading_deg: float, pitch_deg: float = 0.0) -> np.ndarray:
    """world_from_camera of a camera that looks along a heading, `pitch_deg` below the horizon."""
    heading, pitch = np.radians((heading_deg, pitch_deg))
    forward = np.array((np.cos(heading) * np.cos(pitch), np.sin(heading) * np.cos(pitch), -np.sin(pitch)))
    right = np.array((np.sin(heading), -np.cos(heading), 0.0))
    result = np.eye(4)
    result[:3, :3] = np.stack((right, np.cross(forward, right), forward), axis=1)
    result[:3, 3] = x_m, y_m, z_m
    return result


def walk(frames: int = 16, height_m: float = 1.2) -> list[np.ndarray]:
    """Poses of a camera that goes along an arc through the room and turns, a little up and down too."""
    turns = np.linspace(0, 1, frames)
    return [
        pose(
            1.2 * np.cos(4 * t) - 0.3,
            1.0 * np.sin(4 * t) - 0.4,
            height_m + 0.03 * np.sin(9 * t),
            200 * t,
            14 + 7 * np.sin(7 * t),
        )
        for t in turns
    ]


def depth_of(world_from_camera: np.ndarray, camera: Intrinsics = CAMERA) -> np.ndarray:
    """Depth along the optical axis (h, w), metres."""
    return _cast(world_from_camera, camera)[0]


def color_of(world_from_camera: np.ndarray, camera: Intrinsics = CAMERA) -> np.ndarray:
    """Colour (h, w, 3) uint8: each surface has a shade of its own."""
    _, surface = _cast(world_from_camera, camera)
    shades = np.random.default_rng(3).integers(30, 230, (surface.max() + 1, 3)).astype(np.uint8)
    return shades[surface]


def _cast(world_from_camera: np.ndarray, camera: Intrinsics) -> tuple[np.ndarray, np.ndarray]:
    v, u = np.indices((camera.height_px, camera.width_px))
    rays = np.stack(((u - camera.cx_px) / camera.fx_px, (v - camera.cy_px) / camera.fy_px, np.ones(u.shape)), axis=-1)
    rays = rays @ world_from_camera[:3, :3].T
    rays = np.where(np.abs(rays) < 1e-12, 1e-12, rays)
    origin = world_from_camera[:3, 3]
    at = np.maximum((ROOM_M[0] - origin) / rays, (ROOM_M[1] - origin) / rays)
    axis = at.argmin(axis=-1)
    depth_m = at.min(axis=-1)
    surface = 2 * axis + (np.take_along_axis(rays, axis[..., None], axis=-1)[..., 0] > 0)
    for index, (low, high) in enumerate(FURNITURE_M):
        one, two = (low - origin) / rays, (high - origin) / rays
        entry, leave = np.minimum(one, two), np.maximum(one, two).min(axis=-1)
        near = entry.max(axis=-1)
        hit = (near < leave) & (near > 0.01) & (near < depth_m)
        depth_m = np.where(hit, near, depth_m)
        surface = np.where(hit, 6 + 3 * index + entry.argmax(axis=-1), surface)
    return depth_m, surface

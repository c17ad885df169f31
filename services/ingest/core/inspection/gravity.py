"""Which way is up, and where the floor is, by what the camera saw and how it turned (pure).

A camera on a robot or in a hand turns mostly about the vertical: this is what stays fixed in the camera, however the
camera is mounted. Where it turned too little to tell, the image's own up and the floor decide.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from prior_sg.services.geometry import transform
from prior_sg.services.ingest.core.agreement import DepthView
from prior_sg.services.ingest.core.inspection.findings import Finding, note, ok, problem

UP = np.array((0.0, 0.0, 1.0))
IMAGE_UP = np.array((0.0, -1.0, 0.0))
TURNED = 0.12  # by how much more the vertical must stay fixed in the camera than any other direction
STEADY = 0.75  # mean of a direction in the camera, 1 = fixed
UPRIGHT = 0.6  # cosine to the image's up of a camera that is not rolled
FACING = math.cos(math.radians(25))  # of a surface that counts as level
LEVEL = 0.5  # of the spread of the cameras along z, below which another direction is the vertical
BIN_M = 0.1
LEAST_FLOOR = 0.015  # share of points
BELOW_M, MOST_BELOW = 0.3, 0.06  # share of points that may lie that far below a floor
CAMERA_ABOVE_M = (0.1, 5.0)  # of a floor
USUAL_ABOVE_M = (0.2, 3.0)
TILT_NOTE_DEG, TILT_PROBLEM_DEG, OTHER_AXIS_DEG = 4.0, 20.0, 45.0
FLOOR_NOTE_M = 0.3
SNAP = math.cos(math.radians(15))
POINTS = 1500  # of each image


@dataclass(frozen=True)
class Surface:
    """Points of all views and where their surfaces face, in the world."""

    points: np.ndarray  # (n, 3) metres
    normals: np.ndarray  # (n, 3), towards the camera
    cameras: np.ndarray  # (views, 3) metres


@dataclass(frozen=True)
class Floor:
    """The lowest large level surface, against a direction taken as up."""

    height_m: float  # along that direction
    share: float  # of all points
    camera_above_m: float  # median
    normal: np.ndarray  # (3,)


@dataclass(frozen=True)
class Vertical:
    """The direction that points up in the world of the poses."""

    up: np.ndarray  # (3,)
    sure: bool
    roll_deg: float  # of the images against it, clockwise; 0 = upright


def judge(views: Sequence[DepthView], world_from_source: np.ndarray) -> list[Finding]:
    """Findings about the vertical and the floor; `world_from_source` is how the poses were levelled on reading."""
    if not views:
        return []
    surface = surface_of(views)
    vertical = vertical_of(np.stack([view.world_from_camera[:3, :3] for view in views]), surface)
    floor = floor_of(surface, UP) or floor_of(surface, vertical.up)
    rotation = world_from_source[:3, :3]
    found = [_rolled(vertical)] if abs(vertical.roll_deg) >= 45 else []
    if vertical.up @ UP < math.cos(math.radians(OTHER_AXIS_DEG)):
        return [_other_up(vertical, rotation), *found]
    if floor is None:
        text = "no floor was seen; up is taken to be z" if vertical.sure else "neither floor nor vertical can be told"
        return [note("up", text), *found]
    return [_tilt(floor, rotation), _height(floor), *found]


def vertical_of(rotations: np.ndarray, surface: Surface) -> Vertical:
    """Up, from world_from_camera rotations (n, 3, 3) and surfaces."""
    left, fixed, right = np.linalg.svd(rotations.mean(axis=0))
    if fixed[0] >= STEADY and fixed[0] - fixed[1] >= TURNED:
        up = _signed(left[:, 0], right[0], surface)
        return Vertical(up, True, roll_deg(rotations, up))
    image_up = rotations.mean(axis=0) @ IMAGE_UP
    length = float(np.linalg.norm(image_up))
    if length < STEADY or image_up @ UP >= UPRIGHT * length:
        return Vertical(UP, length >= STEADY, 0.0)
    nearest = axes()[int(np.argmax(axes() @ image_up))]
    as_read, as_seen = floor_of(surface, UP), floor_of(surface, nearest)
    level = np.std(surface.cameras @ nearest) < LEVEL * np.std(surface.cameras @ UP)  # cameras seldom climb
    if as_seen is not None and (as_read is None or level):
        return Vertical(nearest, True, 0.0)
    return Vertical(UP, as_read is not None, roll_deg(rotations, UP))


def _signed(up: np.ndarray, up_in_camera: np.ndarray, surface: Surface) -> np.ndarray:
    """The end of the vertical that points up: z's, unless image and floor both say the other."""
    sign = 1.0 if up @ UP >= 0 else -1.0
    if abs(up @ UP) < math.cos(math.radians(OTHER_AXIS_DEG)):  # z is level: the image decides, or the larger floor
        if abs(up_in_camera @ IMAGE_UP) >= UPRIGHT:
            return up * np.sign(up_in_camera @ IMAGE_UP)
        return up if _floor_share(surface, up) >= _floor_share(surface, -up) else -up
    upside_down = sign * (up_in_camera @ IMAGE_UP) <= -UPRIGHT
    if upside_down and _floor_share(surface, -sign * up) > 1.5 * _floor_share(surface, sign * up):
        return -sign * up
    return sign * up


def roll_deg(rotations: np.ndarray, up: np.ndarray) -> float:
    """By how much the images are turned against upright, clockwise."""
    right, down, _ = (rotations.transpose(0, 2, 1) @ up).mean(axis=0)
    return math.degrees(math.atan2(right, -down)) if math.hypot(right, down) > 0.3 else 0.0


def surface_of(views: Sequence[DepthView]) -> Surface:
    """Points and normals of about POINTS pixels of each view."""
    parts = [_points_and_normals(view) for view in views]
    points, normals = (np.concatenate([part[i] for part in parts]) for i in (0, 1))
    return Surface(points, normals, np.stack([view.world_from_camera[:3, 3] for view in views]))


def floor_of(surface: Surface, up: np.ndarray) -> Floor | None:
    """The lowest large surface that faces up, with next to nothing below it and the camera above it."""
    facing = surface.normals @ up >= FACING
    heights_m = surface.points @ up
    if facing.sum() < LEAST_FLOOR * len(heights_m) or not facing.any():
        return None
    edges = np.arange(heights_m[facing].min() - BIN_M, heights_m[facing].max() + 2 * BIN_M, BIN_M)
    counts, _ = np.histogram(heights_m[facing], edges)
    both = counts[:-1] + counts[1:]  # a floor may lie on the edge of two bins
    large = np.flatnonzero(both >= max(LEAST_FLOOR * len(heights_m), 0.3 * both.max()))
    if not len(large):
        return None
    at = large[0]
    inside = facing & (heights_m >= edges[at]) & (heights_m <= edges[at + 2])
    height_m = float(np.median(heights_m[inside]))
    above_m = float(np.median(surface.cameras @ up)) - height_m
    below = float((heights_m < height_m - BELOW_M).mean())
    if below > MOST_BELOW or not CAMERA_ABOVE_M[0] <= above_m <= CAMERA_ABOVE_M[1]:
        return None
    normal = np.median(surface.normals[inside], axis=0)
    return Floor(height_m, float(inside.mean()), above_m, normal / np.linalg.norm(normal))


def axes() -> np.ndarray:
    """The six directions along an axis (6, 3)."""
    return np.concatenate((np.eye(3), -np.eye(3)))


def _floor_share(surface: Surface, up: np.ndarray) -> float:
    floor = floor_of(surface, up)
    return 0.0 if floor is None else floor.share


def _points_and_normals(view: DepthView) -> tuple[np.ndarray, np.ndarray]:
    height_px, width_px = view.depth_m.shape
    step, reach = max(1, round((height_px * width_px / POINTS) ** 0.5)), max(1, round(width_px / 80))
    v, u = (grid.ravel() for grid in np.mgrid[0 : height_px - reach : step, 0 : width_px - reach : step])
    here, right, down = (_camera_points(view, v + dv, u + du) for dv, du in ((0, 0), (0, reach), (reach, 0)))
    normal = np.cross(down - here, right - here)
    length = np.linalg.norm(normal, axis=1)
    depth_m = here[:, 2]
    smooth = (depth_m > 0) & (length > 0)
    for other in (right, down):
        smooth &= (other[:, 2] > 0) & (np.abs(other[:, 2] - depth_m) < 0.1 * depth_m)
    normal, here = normal[smooth] / length[smooth, None], here[smooth]
    normal *= -np.sign((normal * here).sum(axis=1))[:, None]  # towards the camera
    return transform(view.world_from_camera, here), normal @ view.world_from_camera[:3, :3].T


def _camera_points(view: DepthView, v: np.ndarray, u: np.ndarray) -> np.ndarray:
    camera = view.intrinsics
    z = view.depth_m[v, u].astype(np.float64)
    return np.stack(((u - camera.cx_px) / camera.fx_px * z, (v - camera.cy_px) / camera.fy_px * z, z), axis=1)


def _other_up(vertical: Vertical, rotation: np.ndarray) -> Finding:
    written = _option(rotation.T @ vertical.up)
    text = f"floor and camera say that {written} points up in the source's world, not z of the map"
    return problem("up", text, f"--up {written}")


def _tilt(floor: Floor, rotation: np.ndarray) -> Finding:
    tilt_deg = math.degrees(math.acos(min(1.0, float(floor.normal @ UP))))
    text = f"z points up; the floor is tilted by {tilt_deg:.1f} degrees against it"
    mend = f"--up {_option(rotation.T @ floor.normal, snapped=False)}"
    if tilt_deg >= TILT_PROBLEM_DEG:
        return problem("up", text, mend)
    return note("up", text, mend) if tilt_deg >= TILT_NOTE_DEG else ok("up", text)


def _height(floor: Floor) -> Finding:
    text = f"it lies at {floor.height_m:.2f} m, the camera {floor.camera_above_m:.2f} m above it"
    if abs(floor.height_m) > FLOOR_NOTE_M:
        return note("floor", text, f"--floor {floor.height_m:.2f}")
    if not USUAL_ABOVE_M[0] <= floor.camera_above_m <= USUAL_ABOVE_M[1]:
        return note("floor", f"{text}, which is unusual")
    return ok("floor", text)


def _rolled(vertical: Vertical) -> Finding:
    return note(
        "mounting",
        f"the images are turned by {vertical.roll_deg:.0f} degrees",
        "nothing to do, they are turned upright before they are encoded",
    )


def _option(direction: np.ndarray, snapped: bool = True) -> str:
    """Three numbers for the command line, an axis where the direction is near one."""
    nearest = axes()[int(np.argmax(axes() @ direction))]
    if snapped and nearest @ direction >= SNAP:
        return ",".join(f"{value:.0f}" for value in nearest + 0.0)
    return ",".join(f"{value:.3f}" for value in direction)

"""Cameras and images of a recording of ROS; depth of another camera is drawn into that of colour."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from prior_sg.services.geometry import rotation_angle_rad
from prior_sg.services.ingest.core.options import ReadOptions
from prior_sg.services.ingest.core.pixels import encoded
from prior_sg.services.ingest.core.poses import PoseError
from prior_sg.services.ingest.core.ros.cameras import camera_fields
from prior_sg.services.ingest.core.ros.images import color_file, depth_image, metres
from prior_sg.services.ingest.core.ros.registration import rays, registered
from prior_sg.services.ingest.core.ros.topics import Chosen, Topic
from prior_sg.services.ingest.core.ros.transforms import TransformTree
from prior_sg.services.ingest.sources.base import (
    MILLIMETRE,
    Camera,
    FrameError,
    Images,
    SourceError,
    camera_of,
    color_pixels,
)
from prior_sg.services.ingest.sources.cameras import straight_maps
from prior_sg.services.ingest.sources.tables import LastingError
from prior_sg.services.opencv import cv2

NEARLY = 1e-3  # difference of focal lengths that is none


@dataclass(frozen=True)
class Rig:
    """Topics and cameras of a robot, recorded or live."""

    path: Path  # for the reader of an error
    choice: Chosen
    options: ReadOptions
    infos: Mapping[str, Any]  # camera infos by topic
    tree: TransformTree
    stamp_ns: int  # at which depth's frame is joined to colour's
    within_ns: int


class Pictures:
    """Reads the two image messages of a frame."""

    def __call__(self, color: Any, depth: Any) -> Images:
        """Raises FrameError and ImageError."""
        return Images(color_file(color), depth_image(depth))


@dataclass(frozen=True)
class Registering(Pictures):
    """Draws depth into the colour camera, and undistorts colour."""

    color_camera: Camera
    color_from_depth: np.ndarray
    rays: np.ndarray  # of the depth camera
    maps: tuple[np.ndarray, np.ndarray] | None  # where the pixels of straight colour lie in bent
    unit_m: float

    def __call__(self, color: Any, depth: Any) -> Images:
        """Raises FrameError and ImageError."""
        depth_m = metres(depth_image(depth), self.unit_m)
        if depth_m.shape != self.rays.shape[:2]:
            raise FrameError(f"the depth image has another size than its camera info, {self.rays.shape[1::-1]}")
        seen = registered(depth_m, self.rays, self.color_from_depth, self.color_camera.intrinsics)
        file = color_file(color)
        if self.maps is not None:
            bent = color_pixels(file)
            file = encoded(cv2.remap(bent, *self.maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), ".png")
        return Images(file, seen)


def pictures(rig: Rig) -> tuple[Camera, Pictures, str]:
    """The camera, what reads its images, and a note on how depth becomes colour's. Raises SourceError."""
    choice, options = rig.choice, rig.options
    color, depth = _camera(rig, choice.color, choice.color_info), None
    if choice.depth_info is not None and choice.depth_info != choice.color_info:
        depth = _camera(rig, choice.depth, choice.depth_info)
    known = color or depth or _told_camera(rig.path, options)
    if choice.color.frame == choice.depth.frame:
        return (depth if depth and not _same_size(known, depth) else known), Pictures(), ""
    frames = f"depth of {choice.depth.frame!r} and colour of {choice.color.frame!r}"
    try:
        joined = rig.tree.connects(choice.color.frame, choice.depth.frame)
        color_from_depth = np.eye(4)
        if joined:
            color_from_depth = rig.tree.at(choice.color.frame, choice.depth.frame, rig.stamp_ns, rig.within_ns)
    except PoseError as error:
        raise SourceError(f"{rig.path}: {error}") from error
    if (not joined and _same(color, depth)) or (joined and _is_none(color_from_depth) and _same(color, depth)):
        return known, Pictures(), f"{frames} are taken as registered: their cameras are the same"
    if not joined or color is None or depth is None:
        lacks = "tf does not connect them" if not joined else "both need a camera info"
        raise SourceError(
            f"{rig.path}: {frames} are not registered, and {lacks}; record it, or name a registered --depth-topic"
        )
    moves_m, turns_deg = np.linalg.norm(color_from_depth[:3, 3]), np.degrees(rotation_angle_rad(color_from_depth))
    how = f"{frames}: depth is drawn into the colour camera ({moves_m:.3f} m and {turns_deg:.1f} degrees apart)"
    pinhole = Camera(color.intrinsics)
    reader = Registering(
        pinhole,
        color_from_depth,
        rays(depth.intrinsics, depth.model, depth.distortion),
        straight_maps(color),
        MILLIMETRE if options.depth_scale_m is None else options.depth_scale_m,
    )
    return pinhole, reader, how


def color_camera(rig: Rig) -> Camera:
    """The camera of colour, as its info or the options say. Raises SourceError."""
    return _camera(rig, rig.choice.color, rig.choice.color_info) or _told_camera(rig.path, rig.options)


def _camera(rig: Rig, image: Topic, info: Topic | None) -> Camera | None:
    """The camera that an info says; None where there is none. Raises SourceError."""
    if info is None or info.name not in rig.infos:
        return None
    where = Path(f"{rig.path} ({info.name})")
    try:
        return camera_of(where, camera_fields(rig.infos[info.name], image.is_rectified))
    except (ValueError, AttributeError) as error:
        raise LastingError(f"{where} is not a camera: {error}; give --intrinsics FX,FY,CX,CY,WIDTH,HEIGHT") from error


def _told_camera(path: Path, options: ReadOptions) -> Camera:
    """The camera of the options alone. Raises SourceError."""
    if len(options.intrinsics) != 6:
        raise SourceError(
            f"{path} has no camera info for its colour images: give --info-topic TOPIC, or --intrinsics "
            "FX,FY,CX,CY,WIDTH,HEIGHT"
        )
    fx, fy, cx, cy, width, height = options.intrinsics
    names = ("fx", "fy", "cx", "cy", "width", "height")
    return camera_of(path, dict(zip(names, (fx, fy, cx, cy, width, height), strict=True)))


def _same(color: Camera | None, depth: Camera | None) -> bool:
    """Whether two cameras have the same pixels; one that is not known is taken as the other."""
    if color is None or depth is None:
        return True
    a, b = color.intrinsics, depth.intrinsics
    numbers = (a.fx_px, a.fy_px, a.cx_px, a.cy_px), (b.fx_px, b.fy_px, b.cx_px, b.cy_px)
    return _same_size(color, depth) and np.allclose(*numbers, rtol=NEARLY) and color.distortion == depth.distortion


def _same_size(one: Camera, other: Camera) -> bool:
    a, b = one.intrinsics, other.intrinsics
    return (a.width_px, a.height_px) == (b.width_px, b.height_px)


def _is_none(motion: np.ndarray) -> bool:
    return bool(np.allclose(motion, np.eye(4), atol=1e-6))

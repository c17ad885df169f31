"""Cameras and images of a recording of ROS; depth of another camera is drawn into that of colour."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from prior_sg.services.geometry import rotation_angle_rad
from prior_sg.services.ingest.core.options import ReadOptions
from prior_sg.services.ingest.core.pixels import encoded
from prior_sg.services.ingest.core.poses import PoseError
from prior_sg.services.ingest.core.ros.cameras import camera_fields
from prior_sg.services.ingest.core.ros.images import color_file, depth_image, metres
from prior_sg.services.ingest.core.ros.registration import rays, registered
from prior_sg.services.ingest.core.ros.topics import (
    Topic,
)
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
from prior_sg.services.ingest.sources.ros_recorded import Recorded

NEARLY = 1e-3  # difference of focal lengths that is none


@dataclass(frozen=True)
class Pictures:
    """Reads the images of a frame."""

    recorded: Recorded

    def __call__(self, color: int, depth: int) -> Images:
        """Raises FrameError and ImageError."""
        color_message, depth_message = self.messages(color, depth)
        return Images(color_file(color_message), depth_image(depth_message))

    def messages(self, color: int, depth: int) -> tuple[Any, Any]:
        """The two messages of a frame. Raises FrameError."""
        of = self.recorded
        return (
            of.bag.message(of.choice.color.name, of.colors, color),
            of.bag.message(of.choice.depth.name, of.depths, depth),
        )


@dataclass(frozen=True)
class Registering(Pictures):
    """Draws depth into the colour camera, and undistorts colour."""

    color_camera: Camera
    color_from_depth: np.ndarray
    rays: np.ndarray  # of the depth camera
    maps: tuple[np.ndarray, np.ndarray] | None  # where the pixels of straight colour lie in bent
    unit_m: float

    def __call__(self, color: int, depth: int) -> Images:
        """Raises FrameError and ImageError."""
        color_message, depth_message = self.messages(color, depth)
        depth_m = metres(depth_image(depth_message), self.unit_m)
        if depth_m.shape != self.rays.shape[:2]:
            raise FrameError(f"the depth image has another size than its camera info, {self.rays.shape[1::-1]}")
        seen = registered(depth_m, self.rays, self.color_from_depth, self.color_camera.intrinsics)
        file = color_file(color_message)
        if self.maps is not None:
            bent = color_pixels(file)
            file = encoded(cv2.remap(bent, *self.maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), ".png")
        return Images(file, seen)


def pictures(recorded: Recorded) -> tuple[Camera, Pictures, str]:
    """The camera, what reads its images, and a note on how depth becomes colour's. Raises SourceError."""
    choice, options = recorded.choice, recorded.options
    color, depth = _camera(recorded, choice.color, choice.color_info), None
    if choice.depth_info is not None and choice.depth_info != choice.color_info:
        depth = _camera(recorded, choice.depth, choice.depth_info)
    known = color or depth or _told_camera(recorded.bag.path, options)
    if choice.color.frame == choice.depth.frame:
        return (depth if depth and not _same_size(known, depth) else known), Pictures(recorded), ""
    frames = f"depth of {choice.depth.frame!r} and colour of {choice.color.frame!r}"
    try:
        joined = recorded.tree.connects(choice.color.frame, choice.depth.frame)
        stamps_ns = recorded.colors.stamps_ns or [0]
        color_from_depth = np.eye(4)
        if joined:
            color_from_depth = recorded.tree.at(
                choice.color.frame, choice.depth.frame, stamps_ns[len(stamps_ns) // 2], recorded.within_ns
            )
    except PoseError as error:
        raise SourceError(f"{recorded.bag.path}: {error}") from error
    if (not joined and _same(color, depth)) or (joined and _is_none(color_from_depth) and _same(color, depth)):
        return known, Pictures(recorded), f"{frames} are taken as registered: their cameras are the same"
    if not joined or color is None or depth is None:
        lacks = "tf does not connect them" if not joined else "both need a camera info"
        raise SourceError(
            f"{recorded.bag.path}: {frames} are not registered, and {lacks}; record it, or name a registered "
            "--depth-topic"
        )
    moves_m, turns_deg = np.linalg.norm(color_from_depth[:3, 3]), np.degrees(rotation_angle_rad(color_from_depth))
    how = f"{frames}: depth is drawn into the colour camera ({moves_m:.3f} m and {turns_deg:.1f} degrees apart)"
    pinhole = Camera(color.intrinsics)
    reader = Registering(
        recorded,
        pinhole,
        color_from_depth,
        rays(depth.intrinsics, depth.model, depth.distortion),
        straight_maps(color),
        MILLIMETRE if options.depth_scale_m is None else options.depth_scale_m,
    )
    return pinhole, reader, how


def _camera(recorded: Recorded, image: Topic, info: Topic | None) -> Camera | None:
    """The camera that an info says; None where there is none. Raises SourceError."""
    if info is None or info.name not in recorded.infos:
        return None
    where = Path(f"{recorded.bag.path} ({info.name})")
    try:
        return camera_of(where, camera_fields(recorded.infos[info.name], image.is_rectified))
    except (ValueError, AttributeError) as error:
        raise SourceError(f"{where} is not a camera: {error}; give --intrinsics FX,FY,CX,CY,WIDTH,HEIGHT") from error


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

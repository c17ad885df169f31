"""Walls with printed markers on them as an RGB-D camera sees them, by the homography of each wall's plane."""

import cv2
import numpy as np

from prior_sg.deploy.evaluation import printed
from prior_sg.schemas.frames import Intrinsics, Keyframe
from prior_sg.services.geometry import inverse

CAMERA = Intrinsics(640, 480, 525.0, 525.0, 319.5, 239.5)
DICTIONARY, SIZE_M = "apriltag_36h11", 0.2


def facing(world_from_marker, distance_m, turns_rad=(0.0, 0.0, 0.0), aside_m=(0.0, 0.0)):
    """A camera (world_from_camera) that looks at a marker's middle from so far, turned about it by yaw, pitch
    and roll; aside in its image."""
    yaw_rad, pitch_rad, roll_rad = turns_rad
    turn = cv2.Rodrigues(np.array((0.0, yaw_rad, 0.0)))[0] @ cv2.Rodrigues(np.array((pitch_rad, 0.0, 0.0)))[0]
    marker_from_camera = np.eye(4)
    look = np.diag((1.0, -1.0, -1.0)) @ cv2.Rodrigues(np.array((0.0, 0.0, roll_rad)))[0]  # down the marker's z
    marker_from_camera[:3, :3] = turn @ look
    marker_from_camera[:3, 3] = marker_from_camera[:3, :3] @ np.array((*aside_m, -distance_m))
    return world_from_marker @ marker_from_camera


def on_wall(position_m, heading_rad):
    """A marker (world_from_marker) that hangs upright on a wall and looks along a heading."""
    return printed.on_wall(np.array(position_m), np.array((np.cos(heading_rad), np.sin(heading_rad), 0.0)))


def shot(world_from_camera, markers, *, noise_m=0.0, seed=0, size_m=SIZE_M, hidden=False):
    """Colour (h, w, 3) and depth (h, w) of the planes of `markers` (number, world_from_marker), the nearest in front;
    `hidden` = the depth camera sees nothing of the papers."""
    rng = np.random.default_rng(seed)
    seen = [(number, inverse(world_from_camera) @ marker) for number, marker in markers]
    depth_m = np.min([printed.plane_m(pose, CAMERA) for _, pose in seen], axis=0)
    gray, papers = printed.painted(np.full(depth_m.shape, 140, np.uint8), depth_m, CAMERA, seen, size_m)
    depth_m = np.where(np.isfinite(depth_m), depth_m, 0.0)
    depth_m = depth_m + noise_m * depth_m**2 * rng.normal(size=depth_m.shape)
    if hidden:
        depth_m[papers] = 0.0
    gray = np.clip(gray + rng.normal(0, 3, gray.shape), 0, 255).astype(np.uint8)
    return np.repeat(gray[:, :, None], 3, axis=2), depth_m.astype(np.float32)


def keyframe(frame_id, world_from_camera, color, depth_m, *, robot="robot1", camera=CAMERA):
    """An image and its depth as a robot tells them."""
    pictures = color[:, :, ::-1], np.round(depth_m * 1000).astype(np.uint16)
    encoded = [cv2.imencode(".png", picture)[1].tobytes() for picture in pictures]
    return Keyframe(
        robot=robot,
        frame_id=frame_id,
        stamp_ns=frame_id,
        intrinsics=camera,
        world_from_camera=world_from_camera,
        color=encoded[0],
        depth=encoded[1],
        depth_scale_m=0.001,
    )

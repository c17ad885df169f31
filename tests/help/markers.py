"""Walls with printed markers on them as an RGB-D camera sees them, by the homography of each wall's plane."""

import cv2
import numpy as np

from prior_sg.schemas.frames import Intrinsics, Keyframe
from prior_sg.services.geometry import inverse

CAMERA = Intrinsics(640, 480, 525.0, 525.0, 319.5, 239.5)
DICTIONARY, SIZE_M = "apriltag_36h11", 0.2
CELL_PX = 40  # of the printed image; a marker of 8 cells has a white margin of one
PAPER_CELLS = 10
CELLS = 8
NEAREST_M = 0.1


def printed(number, size_m=SIZE_M):
    """The paper as an image, and the side of the paper in metres."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    black = cv2.aruco.generateImageMarker(dictionary, number, CELLS * CELL_PX)
    margin = (PAPER_CELLS - CELLS) * CELL_PX // 2
    return cv2.copyMakeBorder(black, *[margin] * 4, cv2.BORDER_CONSTANT, value=255), size_m * PAPER_CELLS / CELLS


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
    pose = np.eye(4)
    out = np.array((np.cos(heading_rad), np.sin(heading_rad), 0.0))
    up = np.array((0.0, 0.0, 1.0))
    pose[:3, :3] = np.column_stack((np.cross(up, out), up, out))
    pose[:3, 3] = position_m
    return pose


def painted(gray, depth_m, world_from_camera, markers, *, camera=CAMERA, size_m=SIZE_M):
    """An image (h, w) with papers on the surfaces whose depth (h, w) is theirs; and a mask of where they show."""
    shape, gray = depth_m.shape, gray.copy()
    lens = np.array(((camera.fx_px, 0, camera.cx_px), (0, camera.fy_px, camera.cy_px), (0, 0, 1)))
    papers = np.zeros(shape, bool)
    for number, world_from_marker in markers:
        pose = inverse(world_from_camera) @ world_from_marker  # camera_from_marker
        if pose[2, 3] < NEAREST_M or pose[:3, 2] @ pose[:3, 3] > 0:
            continue  # behind the camera, or seen from behind
        paper, side_m = printed(number, size_m)
        scale = side_m / len(paper)  # of pixel centres to metres on the paper
        to_paper = scale * np.array(((1, 0, 0.5 - len(paper) / 2), (0, -1, len(paper) / 2 - 0.5), (0, 0, 1 / scale)))
        homography = lens @ np.column_stack((pose[:3, 0], pose[:3, 1], pose[:3, 3])) @ to_paper
        flat = cv2.warpPerspective(paper, homography, shape[::-1], flags=cv2.INTER_AREA)
        inside = cv2.warpPerspective(np.full_like(paper, 255), homography, shape[::-1]) > 250
        inside &= np.abs(plane_m(pose, camera) - depth_m) < 0.05
        gray[inside] = flat[inside]
        papers |= inside
    return cv2.GaussianBlur(gray, (0, 0), 0.7), papers


def plane_m(camera_from_marker, camera=CAMERA):
    """Depth (h, w) of a marker's plane, infinite where it is not before the camera."""
    v, u = np.mgrid[: camera.height_px, : camera.width_px]
    rays = np.stack(((u - camera.cx_px) / camera.fx_px, (v - camera.cy_px) / camera.fy_px, np.ones(u.shape)), axis=-1)
    normal = camera_from_marker[:3, 2]
    with np.errstate(divide="ignore"):
        depth_m = (normal @ camera_from_marker[:3, 3]) / (rays @ normal)
    return np.where(depth_m > 0, depth_m, np.inf)


def shot(world_from_camera, markers, *, noise_m=0.0, seed=0, size_m=SIZE_M, hidden=False):
    """Colour (h, w, 3) and depth (h, w) of the planes of `markers` (number, world_from_marker), the nearest in front;
    `hidden` = the depth camera sees nothing of the papers."""
    rng = np.random.default_rng(seed)
    depth_m = np.min([plane_m(inverse(world_from_camera) @ marker) for _, marker in markers], axis=0)
    gray, papers = painted(np.full(depth_m.shape, 140, np.uint8), depth_m, world_from_camera, markers, size_m=size_m)
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

"""A robot with two RGB-D cameras back to back, which go off at the same time."""

import numpy as np

from prior_sg.schemas.frames import Intrinsics
from prior_sg.services.geometry import inverse
from tests.help.bags import Maker
from tests.help.room import CAMERA, color_of, depth_of
from tests.help.walked import BASE_FROM_OPTICAL, LINK_FROM_OPTICAL, MS, STAMPS_NS, WORLD_FROM_BASE, motion

REAR_CAMERA = Intrinsics(width_px=80, height_px=60, fx_px=50.0, fy_px=50.0, cx_px=39.5, cy_px=29.5)
BASE_FROM_REAR = motion(-0.9, 0.0, 0.8, 180, 0, 0) @ LINK_FROM_OPTICAL
CAMERAS = {"front": (CAMERA, BASE_FROM_OPTICAL), "rear": (REAR_CAMERA, BASE_FROM_REAR)}
NAMES = {side: f"/{side}/color/image_raw" for side in CAMERAS}


def add_tree(maker):
    statics = [
        maker.transform(STAMPS_NS[0], "base", f"{side}_optical", base_from_camera)
        for side, (_, base_from_camera) in CAMERAS.items()
    ]
    maker.add("/tf_static", STAMPS_NS[0], maker.tf(*statics))
    for stamp_ns, base in zip(STAMPS_NS, WORLD_FROM_BASE, strict=True):
        maker.add("/tf", stamp_ns, maker.tf(maker.transform(stamp_ns, "map", "base", base)))


def add_camera(maker, side, late_ns=0):
    camera, base_from_camera = CAMERAS[side]
    frame = f"{side}_optical"
    for stamp_ns, base in zip(STAMPS_NS, WORLD_FROM_BASE, strict=True):
        pose = base @ base_from_camera
        depth_mm = np.rint(depth_of(pose, camera) * 1000).astype(np.uint16)
        color = maker.image(stamp_ns, color_of(pose, camera), "rgb8", frame)
        maker.add(NAMES[side], stamp_ns, color, late_ns=9 * MS + late_ns)
        depth = maker.image(stamp_ns, depth_mm, "16UC1", frame)
        maker.add(f"/{side}/depth/image_raw", stamp_ns, depth, late_ns=7 * MS + late_ns)
        maker.add(f"/{side}/color/camera_info", stamp_ns, maker.info(stamp_ns, camera, frame))


def two_eyed(kind="mcap", sides=tuple(CAMERAS)):
    maker = Maker(kind)
    add_tree(maker)
    for side in sides:
        add_camera(maker, side, late_ns=40 * MS * (side == "front"))  # front's come after rear's
    return maker


def base_of(frame):
    """world_from_base of a frame."""
    side = next(side for side, name in NAMES.items() if name == frame.camera)
    return frame.world_from_camera @ inverse(CAMERAS[side][1])

"""A walk through the room as messages of a robot, the frames that must come of it, and the keyframes."""

import numpy as np
from scipy.spatial.transform import Rotation

from prior_sg.schemas.topics import KEYFRAME
from prior_sg.services.geometry import inverse
from prior_sg.services.ingest.core.config import Config
from prior_sg.services.ingest.core.frames import RawFrame
from prior_sg.services.ingest.core.pixels import stored
from prior_sg.services.ingest.core.selection import State
from prior_sg.services.ingest.service import step
from tests.help.bags import COLOR, DEPTH, INFO, OPTICAL, Maker
from tests.help.room import CAMERA, color_of, depth_of, walk

BEGIN_NS, STEP_NS, MS = 1_700_000_000_000_000_123, 100_000_000, 1_000_000
WALK = walk(80)[:10]
COLORS = [color_of(pose) for pose in WALK]
DEPTHS_MM = [np.rint(depth_of(pose) * 1000).astype(np.uint16) for pose in WALK]
STAMPS_NS = [BEGIN_NS + i * STEP_NS for i in range(len(WALK))]


def motion(x, y, z, *degrees):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_euler("ZYX", degrees, degrees=True).as_matrix(), (x, y, z)
    return pose


MAP_FROM_ODOM = [motion(0.1 * i, 0.02, 0, i, 0, 0) for i in range(len(WALK))]
BASE_FROM_LINK = motion(0.2, 0.03, 0.9, 3, 5, 0)
LINK_FROM_OPTICAL = np.array(((0, 0, 1, 0.0), (-1, 0, 0, 0.015), (0, -1, 0, 0), (0, 0, 0, 1)), float)
BASE_FROM_OPTICAL = BASE_FROM_LINK @ LINK_FROM_OPTICAL
WORLD_FROM_BASE = [pose @ inverse(BASE_FROM_OPTICAL) for pose in WALK]


def add_statics(maker):
    maker.add(
        "/tf_static",
        STAMPS_NS[0],
        maker.tf(
            maker.transform(STAMPS_NS[0], "base", "link", BASE_FROM_LINK),
            maker.transform(STAMPS_NS[0], "link", OPTICAL, LINK_FROM_OPTICAL),
        ),
    )


def add_tree(maker, stamps_ns=STAMPS_NS):
    """map -> odom -> base in /tf, base -> link -> optical in /tf_static."""
    add_statics(maker)
    for stamp_ns, corrected, base in zip(stamps_ns, MAP_FROM_ODOM, WORLD_FROM_BASE, strict=False):
        maker.add("/tf", stamp_ns, maker.tf(maker.transform(stamp_ns, "map", "odom", corrected)))
        odom_from_base = inverse(corrected) @ base
        maker.add("/tf", stamp_ns, maker.tf(maker.transform(stamp_ns, "odom", "base", odom_from_base)), late_ns=MS)


def add_images(maker, depth_late_ns=0, pad=0):
    for stamp_ns, color, depth_mm in zip(STAMPS_NS, COLORS, DEPTHS_MM, strict=True):
        maker.add(COLOR, stamp_ns, maker.image(stamp_ns, color, "rgb8", pad=pad), late_ns=9 * MS)
        late_ns = stamp_ns + depth_late_ns
        maker.add(DEPTH, late_ns, maker.image(late_ns, depth_mm, "16UC1", pad=pad), late_ns=7 * MS)
        maker.add(INFO, stamp_ns, maker.info(stamp_ns, CAMERA))


def whole(kind, **options):
    maker = Maker(kind)
    add_tree(maker)
    add_images(maker, **options)
    return maker


NEAR = Config(min_translation_m=0.05, min_rotation_deg=3.0)


def keyframes(source, cfg=NEAR):
    """Those that ingest selects."""
    state = State(robot="r", epoch=0)
    outputs = [output for frame in source for output in step(state, frame, cfg)]
    return [message for topic, message in outputs if topic is KEYFRAME]


def assert_the_walk(source, first=0, depth_m=0.0, pose=1e-6):
    frames = list(source)
    assert [type(frame) for frame in frames] == [RawFrame] * (len(WALK) - first)
    for i, frame in enumerate(frames, start=first):
        assert frame.stamp_ns == STAMPS_NS[i]
        assert np.abs(frame.world_from_camera - WALK[i]).max() < pose
        assert np.array_equal(stored(frame.color)[..., ::-1], COLORS[i])
        assert np.abs(stored(frame.depth) * frame.depth_scale_m - DEPTHS_MM[i] / 1000).max() <= depth_m + 1e-9

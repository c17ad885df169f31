"""The run as a recording that Foxglove opens: images, depth, lens and pose of each keyframe, the map as it grew.

Our own log keeps our own messages, which replays need; this is another file, with Foxglove's message types. Beside it
lies a layout to import.
"""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from prior_sg.deploy.showing.material import Material, Moment
from prior_sg.schemas.codec import DecodeError, decode
from prior_sg.schemas.frames import Keyframe, PoseUpdate
from prior_sg.schemas.topics import KEYFRAME, POSE_UPDATE
from prior_sg.services.deltas import PoseCorrections
from prior_sg.services.images import ImageFault, depth_of
from prior_sg.services.refusals import InputRefused
from prior_sg.services.runtime.record import read_log

LAYOUT = "{}-layout.json"  # beside a recording of that name
SURFACE_M = 0.03  # of a point
ANY_CENTRE = float("inf")  # share of the image by which a principal point may lie off: what is shown is not mapped


class _Image(NamedTuple):
    """What one keyframe shows."""

    frame: Keyframe  # whose images are read when it is its turn
    world_from_camera: np.ndarray  # (4, 4)


Told = tuple[int, int, Moment | _Image]  # when, its order among the like, what


def write_foxglove(material: Material, path: Path) -> None:
    """The moments of a run, or the scene alone as the only one, and each image of its log. Raises OSError."""
    import foxglove

    from prior_sg.deploy.viewing.foxglove.layout import save_layout
    from prior_sg.deploy.viewing.foxglove.stream import Stream
    from prior_sg.deploy.viewing.shapes import Points

    scene, context = material.scene, foxglove.Context()
    story = sorted((*_images(material), *_moments(material)), key=lambda told: told[:2])
    with path.open("wb") as file, foxglove.open_mcap(file, context=context) as writer:
        about = {"robot": scene.robot, "environment": scene.environment, "task": scene.task}
        writer.write_metadata("prior-sg", about | {"origin_m": " ".join(map(str, scene.origin_m))})
        stream = Stream(context)
        if material.cloud is not None:
            points = Points(material.cloud.points_world, material.cloud.colors, SURFACE_M)
            stream.surface({"/map/0": points}, story[0][0])
        for stamp_ns, _, what in story:
            match what:
                case Moment():
                    stream.show(what.scene, stamp_ns)
                case _Image():
                    stream.camera(bytes(what.frame.color), what.frame.intrinsics, what.world_from_camera, stamp_ns)
                    with contextlib.suppress(ImageFault):  # the map did not take it either
                        stream.depth(depth_of(what.frame, ANY_CENTRE), stamp_ns)
    save_layout(path.with_name(LAYOUT.format(path.stem)))


def _moments(material: Material) -> Iterator[Told]:
    """Those with places: before, there is no time to tell of either."""
    for moment in [moment for moment in material.moments if len(moment.scene.place_ids)] or [Moment(0, material.scene)]:
        yield max(moment.scene.stamp_ns, 0), 1, moment


def _images(material: Material) -> Iterator[Told]:
    """Where the log has any: each image where it was taken, as later corrections say."""
    if material.log is None:
        return
    poses, robot = PoseCorrections(), material.scene.robot
    for logged in read_log(material.log, (POSE_UPDATE,)):
        with contextlib.suppress(DecodeError, InputRefused):  # nobody took it either
            if (update := decode(PoseUpdate, logged.payload)).robot == robot:
                poses.take(update)
    for logged in read_log(material.log, (KEYFRAME,)):
        with contextlib.suppress(DecodeError):
            frame = decode(Keyframe, logged.payload)
            if frame.robot == robot and frame.color:  # a lidar without a camera has no picture
                pose = poses.pose(frame.frame_id, frame.world_from_camera)
                yield max(frame.stamp_ns, 0), 0, _Image(frame, pose)

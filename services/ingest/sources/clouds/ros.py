"""Depth of sensor_msgs/PointCloud2 in recordings of ROS, with pictures of a camera or without.

A cloud is read where a recording has no depth images, or where --depth-topic names it. Its frame and the camera's are
placed by tf or by a topic of poses, as cameras are; points that carry times go to where the lidar was then. Without a
camera its frame has x forward, y left and z up (REP 103).
"""

from functools import partial

import numpy as np

from prior_sg.services.ingest.core.clouds.sweep import EDGE_NS, CloudError, Sweep, sweep_of
from prior_sg.services.ingest.core.options import ReadOptions
from prior_sg.services.ingest.core.poses import Convention, PoseError
from prior_sg.services.ingest.core.ros.clouds import columns_of_message
from prior_sg.services.ingest.core.ros.images import color_file
from prior_sg.services.ingest.core.ros.posing import Way, way_of
from prior_sg.services.ingest.core.ros.topics import Chosen, Topic, pose_topics
from prior_sg.services.ingest.core.ros.transforms import Track
from prior_sg.services.ingest.sources.base import (
    MILLIMETRE,
    Camera,
    Entry,
    Found,
    FrameError,
    Images,
    SourceError,
    truth_beside,
)
from prior_sg.services.ingest.sources.clouds.swept import Drawing, Lidar, Posed, view_entries
from prior_sg.services.ingest.sources.ros.bag import Bag, Index
from prior_sg.services.ingest.sources.ros.foreign import ForeignBag
from prior_sg.services.ingest.sources.ros.pictures import color_camera
from prior_sg.services.ingest.sources.ros.recorded import Recorded


def load(name: str, bag: Bag | ForeignBag, topics: list[Topic], choice: Chosen, options: ReadOptions) -> Found:
    """The recording as a source of the layout `name`. Raises SourceError."""
    recorded = Recorded(bag, options, topics, choice, pose_topics(topics, options))
    alone = choice.color is choice.depth
    index = recorded.colors if alone else recorded.depths
    if not index.stamps_ns:
        raise SourceError(f"{bag.path}: no message of {choice.depth.name} can be read")
    world_from_lidar, said = _posed(recorded, choice.depth.frame)
    lidar = Lidar(index.stamps_ns, partial(_sweep, recorded, index), world_from_lidar)
    convention = Convention().changed(options)
    if alone:
        camera, entries, note = view_entries(lidar, options)
        notes = [f"depth of {choice.depth.name}, {said}", note]
    else:
        camera, entries = _drawn(recorded, lidar, convention)
        info = f", camera {choice.color_info.name}" if choice.color_info else ""
        notes = [f"colour {choice.color.name} ({choice.color.encoding}), depth of {choice.depth.name}{info}, {said}"]
    return Found(
        name,
        bag.path,
        camera,
        MILLIMETRE,
        entries,
        ground_truth=truth_beside(bag.path) if bag.path.is_dir() else None,
        convention=convention,
        why=(bag.why,),
        notes=(*notes, *recorded.lost()),
    )


def _drawn(recorded: Recorded, lidar: Lidar, convention: Convention) -> tuple[Camera, list[Entry]]:
    """The camera, and a frame for each picture with a sweep. Raises SourceError."""
    bent = color_camera(recorded.rig())
    posed, _ = _posed(recorded, recorded.choice.color.frame)

    def world_from_camera(stamp_ns: int) -> np.ndarray:
        return convention.of_matrix(posed(stamp_ns))

    drawing, stamps_ns = Drawing.of(lidar, bent, world_from_camera), recorded.colors.stamps_ns
    entries = [
        Entry(
            number,
            recorded.options.told_ns(number, stamps_ns[i]),
            partial(world_from_camera, stamps_ns[i]),
            partial(_images, recorded, drawing, i, j),
        )
        for number, (i, j) in enumerate(lidar.partners(stamps_ns))
    ]
    if not entries:
        raise SourceError(
            f"{recorded.bag.path}: no picture of {recorded.choice.color.name} has a cloud of "
            f"{recorded.choice.depth.name} near in time: give --clock received"
        )
    return Camera(bent.intrinsics), entries


def _posed(recorded: Recorded, frame: str) -> tuple[Posed, str]:
    """Where a frame is at a stamp, and a phrase on how that is known. Raises SourceError."""
    try:
        way = way_of(frame, recorded.tree, recorded.options, recorded.posing, recorded.poses)
    except PoseError as error:
        raise SourceError(f"{recorded.bag.path}: {error}") from error
    track = Track(recorded.poses.get(way.topic, ()))
    return partial(_at, recorded, way, track), way.said


def _at(recorded: Recorded, way: Way, track: Track, stamp_ns: int) -> np.ndarray:
    return way.at(recorded.tree, track, stamp_ns, max(recorded.within_ns, EDGE_NS))


def _sweep(recorded: Recorded, index: Index, position: int) -> Sweep:
    """Raises FrameError."""
    name = recorded.choice.depth.name
    try:
        columns = columns_of_message(recorded.bag.message(name, index, position))
        return sweep_of(columns, index.headers_ns[position])
    except CloudError as error:
        raise FrameError(f"a cloud of {name} cannot be used: {error}") from error


def _images(recorded: Recorded, drawing: Drawing, color: int, position: int) -> Images:
    message = recorded.bag.message(recorded.choice.color.name, recorded.colors, color)
    return drawing(color_file(message), recorded.colors.stamps_ns[color], position)

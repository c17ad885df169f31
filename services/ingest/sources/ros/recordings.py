"""Recordings of ROS: rosbag2 folders and their files (.db3, .mcap), and bags of ROS 1 (.bag, or a
folder of those into which one was split).

sensor_msgs/Image, CompressedImage    colour (raw, JPEG, PNG) and depth (16UC1 in millimetres, 32FC1 in metres, raw or
                                      compressedDepth with PNG)
sensor_msgs/CameraInfo                the cameras; of images named …rect… the projection matrix counts
sensor_msgs/PointCloud2               depth of a lidar, where there is none of a camera (clouds/ros.py)
foxglove.RawImage and others          of MCAP files of other programs, as those of ROS (foreign.py)
tf2_msgs/TFMessage                    /tf and /tf_static; or nav_msgs/Odometry, geometry_msgs/TransformStamped,
                                      PoseStamped, PoseWithCovarianceStamped

Which topics are read is chosen by type, frame and name, and noted. Each colour image gets the depth image whose stamp
is closest within --sync-tolerance, each used once; colour and depth without a partner are left out, and counted. The
pose is interpolated to the colour image's stamp: the camera's frame in the fixed frame through the tree of transforms,
or the pose of a topic, and from its frame to the camera's through the tree. The frame of an image has x right, y down,
z forward (REP 103, "optical"); --axes says otherwise. The world is z up (REP 105). Depth of another frame than colour's
is drawn into the colour camera through the transform between the two, and colour undistorted for it; without such a
transform it is taken as registered where both cameras are the same. Region truth: regions.json in a rosbag2 folder.
"""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from prior_sg.services.ingest.core.options import ALL_CAMERAS, ReadOptions
from prior_sg.services.ingest.core.pairing import associate
from prior_sg.services.ingest.core.poses import Convention, PoseError
from prior_sg.services.ingest.core.ros.posing import Way, way_of
from prior_sg.services.ingest.core.ros.topics import chosen, chosen_cameras, cloud_chosen, pose_topics
from prior_sg.services.ingest.core.ros.transforms import Track
from prior_sg.services.ingest.sources.base import (
    MILLIMETRE,
    Entry,
    Found,
    Images,
    SourceError,
    truth_beside,
)
from prior_sg.services.ingest.sources.clouds import ros as clouds_ros
from prior_sg.services.ingest.sources.ros.bag import is_recording
from prior_sg.services.ingest.sources.ros.foreign import open_bag
from prior_sg.services.ingest.sources.ros.pictures import Pictures, pictures
from prior_sg.services.ingest.sources.ros.recorded import Recorded

NAME = "ros"
LOOKS = "a recording of ROS (a rosbag2 folder with metadata.yaml, .db3, .mcap, .bag, or a folder of .bag files)"
MOST = 0.9  # share of the images of the slower stream that normally find a partner


def fits(path: Path) -> bool:
    """Whether a path is a recording of ROS, and no log of ours."""
    return is_recording(path)


def load(path: Path, options: ReadOptions) -> Found:
    """A recording of ROS. Raises SourceError, and ExtraMissing where rosbags is not installed."""
    if options.quaternion:
        raise SourceError("messages of ROS name the parts of a quaternion: leave out --quaternion")
    bag = open_bag(path)
    topics = bag.topics()
    try:
        if not options.cameras and (clouds := cloud_chosen(topics, options)) is not None:
            return clouds_ros.load(NAME, bag, topics, clouds, options)
        choices = chosen_cameras(topics, options) if options.cameras else [chosen(topics, options)]
        posing = pose_topics(topics, options)
    except ValueError as error:
        raise SourceError(f"{path}: {error}") from error
    found, faults = list[Found](), list[SourceError]()
    for choice in choices:
        try:
            found.append(_found(Recorded(bag, options, topics, choice, posing)))
        except SourceError as error:
            if options.cameras != ALL_CAMERAS:
                raise
            faults.append(error)
    if not found:
        raise faults[0]
    first, *others = found
    notes = (*first.notes, *(f"a camera is not read: {fault}" for fault in faults))
    return replace(first, name=first.name if options.cameras else "", beside=tuple(others), notes=notes)


def _found(recorded: Recorded) -> Found:
    """One camera. Raises SourceError."""
    bag, choice, options = recorded.bag, recorded.choice, recorded.options
    camera, images, how = pictures(recorded.rig())
    way = _way(recorded)
    track = Track(recorded.poses.get(way.topic, ()))
    convention = Convention().changed(options)
    pairs, left_out = _pairs(recorded)
    entries = []
    for number, (color, depth) in enumerate(pairs):
        stamp_ns = recorded.colors.stamps_ns[color]
        entries.append(
            Entry(
                number,
                options.told_ns(number, stamp_ns),
                partial(_pose, recorded, way, track, convention, stamp_ns),
                partial(_images, recorded, images, color, depth),
            )
        )
    return Found(
        NAME,
        bag.path,
        camera,
        MILLIMETRE,
        entries,
        ground_truth=truth_beside(bag.path) if bag.path.is_dir() else None,
        convention=convention,
        why=(bag.why,),
        notes=tuple(filter(None, (f"{choice.said()}, {way.said}", choice.unread, how, *left_out))),
        name=choice.color.image_name,
    )


def _pairs(recorded: Recorded) -> tuple[list[tuple[int, int]], list[str]]:
    """Indices of colour and depth images that belong together, and notes on those that do not. Raises SourceError."""
    bag, colors, depths = recorded.bag, recorded.colors, recorded.depths
    partner = associate(colors.stamps_ns, depths.stamps_ns, recorded.within_ns)
    pairs = sorted(partner.items())
    within = f"{recorded.within_ns / 1e6:g} ms"
    if not pairs:
        away_s = (depths.stamps_ns[0] - colors.stamps_ns[0]) / 1e9 if depths.stamps_ns and colors.stamps_ns else 0.0
        raise SourceError(
            f"{bag.path}: no colour image has a depth image within {within}; depth begins {away_s:+.3f} s after "
            "colour: give --sync-tolerance SECONDS or --clock received"
        )
    notes = recorded.lost()
    fewer = min(len(colors.stamps_ns), len(depths.stamps_ns))
    if len(pairs) < max(len(colors.stamps_ns), len(depths.stamps_ns)):
        mend = "" if len(pairs) >= MOST * fewer else " (--sync-tolerance SECONDS takes more)"
        notes.append(
            f"{len(pairs)} of {len(colors.stamps_ns)} colour and {len(depths.stamps_ns)} depth images belong together "
            f"within {within}: the others are left out{mend}"
        )
    return pairs, notes


def _pose(recorded: Recorded, way: Way, track: Track, convention: Convention, stamp_ns: int) -> np.ndarray:
    return convention.of_matrix(way.at(recorded.tree, track, stamp_ns, recorded.within_ns))


def _images(recorded: Recorded, pictures: Pictures, color: int, depth: int) -> Images:
    return pictures(*recorded.messages(color, depth))


def _way(recorded: Recorded) -> Way:
    """How the camera's pose is found. Raises SourceError."""
    try:
        return way_of(recorded.choice.color.frame, recorded.tree, recorded.options, recorded.posing, recorded.poses)
    except PoseError as error:
        raise SourceError(f"{recorded.bag.path}: {error}") from error

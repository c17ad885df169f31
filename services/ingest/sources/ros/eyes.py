"""What of a running robot is read, and how: its cameras, of what was heard of it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from prior_sg.services.ingest.core.clouds.sweep import EDGE_NS
from prior_sg.services.ingest.core.clouds.views import VIEW
from prior_sg.services.ingest.core.options import ALL_CAMERAS, ReadOptions
from prior_sg.services.ingest.core.poses import Convention
from prior_sg.services.ingest.core.ros.assembly import Assembly, Posed, Rules, Shot
from prior_sg.services.ingest.core.ros.motions import Motions
from prior_sg.services.ingest.core.ros.posing import Way, way_of
from prior_sg.services.ingest.core.ros.recent import RecentTransforms
from prior_sg.services.ingest.core.ros.topics import (
    FIXED_TRANSFORMS,
    TF_TYPES,
    CannotServeError,
    Chosen,
    Topic,
    chosen,
    chosen_cameras,
    cloud_chosen,
    graph_topic,
    pose_topics,
    tree_topics,
)
from prior_sg.services.ingest.core.ros.transforms import Stamped, TransformTree
from prior_sg.services.ingest.sources.base import MILLIMETRE, Camera, Found, FrameError, Images, SourceError
from prior_sg.services.ingest.sources.clouds.live import Around, Drawn, Shower, period_ns
from prior_sg.services.ingest.sources.clouds.swept import used_views
from prior_sg.services.ingest.sources.normalise import Samples, beside, prepare
from prior_sg.services.ingest.sources.normaliser import UNUSABLE, Normaliser
from prior_sg.services.ingest.sources.ros.look import Look
from prior_sg.services.ingest.sources.ros.pictures import Rig, color_camera, pictures
from prior_sg.services.ingest.sources.ros.reader import Reader
from prior_sg.services.ingest.sources.ros.rgbd import Rgbd
from prior_sg.services.ingest.sources.tables import LastingError
from prior_sg.services.runtime.ros.session import Received
from prior_sg.services.runtime.ros.types import Types
from prior_sg.services.runtime.ros.wire import WireError

NAME = "ros2"
SAMPLES = 3
Begin = Callable[[Motions], Shower]


@dataclass(frozen=True)
class Eye:
    """One camera of a robot, or its lidar."""

    name: str  # empty = the only one
    choice: Chosen
    rules: Rules
    begin: Begin
    normaliser: Normaliser
    body_from_camera: np.ndarray  # of the frame whose optimised poses a graph has
    notes: tuple[str, ...]


@dataclass(frozen=True)
class Robot:
    """What is read of a running robot, and how."""

    options: ReadOptions
    eyes: tuple[Eye, ...]
    topics: tuple[Topic, ...]  # all that is listened to
    heard: frozenset[str]  # topics that publish
    convention: Convention
    notes: tuple[str, ...]
    graph: Topic | None  # of optimised poses

    @property
    def normaliser(self) -> Normaliser:
        """That of the first camera, whose world is everybody's."""
        return self.eyes[0].normaliser


@dataclass(frozen=True)
class Heard:
    """What a look has heard."""

    path: Path
    reader: Reader
    messages: Sequence[Received]
    infos: Mapping[str, Any]  # first camera info of each topic
    transforms: RecentTransforms
    poses: Mapping[str, Sequence[Stamped]]  # by topic
    posing: Sequence[Topic]
    graph: Topic | None

    @property
    def options(self) -> ReadOptions:
        """As the user told."""
        return self.reader.options

    def shots(self, topic: Topic) -> list[Shot]:
        """Its images or clouds; what has no header is told when it comes again."""
        found = []
        for message in self.messages:
            if message.topic == topic.name:
                try:
                    found.append(self.reader.shot(message))
                except WireError:
                    continue
        return found

    def way(self, frame: str, tree: TransformTree) -> Way:
        """From a frame to the world. Raises PoseError."""
        return way_of(frame, tree, self.options, self.posing, self.poses)


def robot_of(look: Look, types: Types, path: Path, options: ReadOptions, first: Normaliser | None = None) -> Robot:
    """What is to be read, of what was heard; in the world of `first`, where there is one.

    Raises SourceError, WireError and UNUSABLE, each with one sentence.
    """
    topics = look.topics()
    try:
        choices, posing, graph = _chosen(topics, options), pose_topics(topics, options), graph_topic(topics, options)
    except CannotServeError as error:
        raise LastingError(f"{path}: {error}") from error
    except ValueError as error:
        raise SourceError(f"{path}: {error}") from error
    tree = tree_topics(topics)
    reader = Reader(types, options, {topic.name: topic for topic in (*topics, *tree)})
    messages = look.messages()
    heard = Heard(path, reader, messages, look.infos(), *_motions(messages, reader), posing, graph)
    eyes, unread = _eyes(heard, choices, first)
    names = {topic.name for eye in eyes for topic in (eye.choice.color, eye.choice.depth)}
    names |= {way.topic for eye in eyes for way in (eye.rules.way, eye.rules.cloud_way) if way is not None}
    listened = [topic for topic in topics if topic.name in names]
    missing = [name for name in options.named_cameras if not any(eye.name.endswith(name) for eye in eyes)]
    late = f"not there yet, and read once they are: {', '.join(missing)}" if missing else ""
    return Robot(
        options=options,
        eyes=tuple(eyes),
        topics=(*listened, *tree, *([graph] if graph else [])),
        heard=frozenset(topic.name for topic in topics if topic.count and topic.name not in unread),
        convention=Convention().changed(options),
        notes=(*(note for eye in eyes for note in eye.notes), *unread.values(), *([late] if late else [])),
        graph=graph,
    )


def _chosen(topics: Sequence[Topic], options: ReadOptions) -> list[Chosen]:
    """Raises ValueError."""
    if options.cameras:
        return chosen_cameras(topics, options, heard=False)
    return [cloud_chosen(topics, options) or chosen(topics, options)]


def _eyes(heard: Heard, choices: Sequence[Chosen], first: Normaliser | None) -> tuple[list[Eye], dict[str, str]]:
    """The cameras, and by colour topic a note on those that cannot be read, where all are asked for.

    Raises SourceError and UNUSABLE of a camera that is named, and where none can be read.
    """
    eyes: list[Eye] = []
    faults: list[Exception] = []
    unread: dict[str, str] = {}
    for choice in choices:
        try:
            eyes.append(_eye(heard, choice, first or (eyes[0].normaliser if eyes else None)))
        except (SourceError, *UNUSABLE) as error:
            if heard.options.cameras != ALL_CAMERAS:
                raise
            faults.append(error)
            unread[choice.color.name] = f"{choice.color.name} is not read: {error}"
    if not eyes:
        raise faults[0]
    return eyes, unread


def _eye(heard: Heard, choice: Chosen, first: Normaliser | None) -> Eye:
    """A camera, or a lidar. Raises SourceError and UNUSABLE."""
    options, convention = heard.options, Convention().changed(heard.options)
    stamps_ns = [shot.stamp_ns for shot in heard.shots(choice.color)]
    if not any(stamps_ns):
        raise SourceError(f"the headers of {choice.color.name} have no stamps; give --clock received")
    stamp_ns = stamps_ns[len(stamps_ns) // 2]
    tree = heard.transforms.tree(stamp_ns, heard.transforms.frames)
    way, within_ns = heard.way(choice.color.frame, tree), round(options.sync_tolerance_s * 1e9)
    rig = Rig(heard.path, choice, options, heard.infos, tree, stamp_ns, within_ns)
    if choice.of_cloud:
        camera, rules, begin, how = _of_cloud(heard, choice, rig, way)
    else:
        camera, images, how = pictures(rig)
        rules = Rules.of_images(way, within_ns)
        begin = Rgbd(heard.reader, choice, images, convention).begin
    name = choice.color.image_name if options.cameras else ""
    found = Found(NAME, heard.path, camera, MILLIMETRE, (), convention=convention, name=name)
    samples = _samples(heard, choice, rules, begin)
    try:
        made = prepare(found, options, samples) if first is None else beside(found, first, options, samples)
    except SourceError as error:  # of what the images are, and what was told of them
        raise LastingError(str(error)) from error
    normaliser, notes = made
    body = options.pose_frame or choice.color.frame
    body_from_camera = tree.at(body, choice.color.frame, stamp_ns, within_ns) if heard.graph else np.eye(4)
    told = tuple(filter(None, (f"{choice.said()}, {way.said}", "" if name else choice.unread, how, *notes)))
    return Eye(name, choice, rules, begin, normaliser, body_from_camera, told)


def _of_cloud(heard: Heard, choice: Chosen, rig: Rig, way: Way) -> tuple[Camera, Rules, Begin, str]:
    """How clouds of a lidar become depth. Raises SourceError and PoseError."""
    clouds = heard.shots(choice.depth)
    sweep_ns = period_ns([cloud.stamp_ns for cloud in clouds])
    cloud_way = way if choice.alone else heard.way(choice.depth.frame, rig.tree)
    rules = Rules(way, sweep_ns, max(rig.within_ns, EDGE_NS), cloud_way, sweep_ns)
    if choice.alone:
        sweeps = (partial(heard.reader.sweep, cloud, choice.depth) for cloud in clouds)
        views = used_views(sweeps, f"clouds of {choice.depth.name}", "none came")
        how = f"there is no camera: sweeps are looked at in {len(views)} views of 90 degrees"
        how += ", and places have no appearance"
        return Camera(VIEW), rules, Around(heard.reader, choice, rules, views).begin, how
    camera, convention = color_camera(rig), Convention().changed(heard.options)
    return Camera(camera.intrinsics), rules, Drawn(heard.reader, choice, rules, convention, camera).begin, ""


def _samples(heard: Heard, choice: Chosen, rules: Rules, begin: Begin) -> Samples:
    """Poses and pictures of the newest frames that are complete. Raises SourceError and UNUSABLE."""
    motions = Motions()
    assembly = Assembly(rules, motions)
    for message in heard.messages:
        heard.reader.move(message, motions)
        heard.reader.hand_over(message, choice, assembly)
    posed: list[Posed] = list(assembly.ready(0, ended=True))
    if not posed:
        faults = [*assembly.faults(), *motions.faults()]
        reasons = dict.fromkeys(fault.text for fault in faults) or ["none came"]
        raise SourceError(f"no frame is complete: {'; '.join(list(reasons)[:2])}")
    shower, samples, faulty = begin(motions), list[tuple[np.ndarray, Images]](), list[Exception]()
    for shown in [shown for one in posed for shown in shower(one)][-SAMPLES:]:
        try:
            samples.append((shown.placed(shown.source_from_sensor), shown.images()))
        except UNUSABLE as error:
            faulty.append(error)
    if not samples:
        raise faulty[0]
    return samples


def _motions(messages: Sequence[Received], reader: Reader) -> tuple[RecentTransforms, dict[str, list[Stamped]]]:
    """Transforms, and poses by topic, of what was heard; what cannot be read is told when it comes again."""
    transforms, poses = RecentTransforms(), dict[str, list[Stamped]]()
    for message in messages:
        topic = reader.topics[message.topic]
        if not reader.moves(topic):
            continue
        try:
            samples = reader.motions(message)
        except (WireError, FrameError):
            continue
        for sample in samples:
            if topic.type in TF_TYPES:
                transforms.add(sample, topic.taken_for == FIXED_TRANSFORMS)
            else:
                poses.setdefault(topic.name, []).append(sample)
    return transforms, poses

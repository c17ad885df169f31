"""Which topics of a recording are the colour, the depth, the camera and the poses (pure)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from prior_sg.services.ingest.core.options import ReadOptions
from prior_sg.services.ingest.core.ros.images import COLOR, DEPTH, GREY

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CAMERA_INFO, POINT_CLOUD = "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/PointCloud2"
TF_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
POSE_TYPES = (  # those that say of what their pose is go first
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/TransformStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/PoseStamped",
)
PATH = "nav_msgs/msg/Path"
READ_TYPES = (IMAGE, COMPRESSED, CAMERA_INFO, PATH, *TF_TYPES, *POSE_TYPES)
STATIC = "tf_static"
TRANSPORTS = ("/compressed", "/compressedDepth")  # what image_transport adds to a topic's name
CAMERA, TRANSFORMS, FIXED_TRANSFORMS, POSES = "camera", "transforms", "fixed transforms", "poses"
CLOUD = "cloud of points"
GRAPH = "pose graph"  # only where it is told: a path may be one that is planned
NAMED = 6


@dataclass(frozen=True)
class Topic:
    """A topic of a recording and what its first message says."""

    name: str
    type: str  # such as sensor_msgs/msg/Image
    count: int
    rate_hz: float  # 0 = not known
    encoding: str = ""  # of an image
    frame: str = ""  # of an image or a camera
    shows: str = ""  # of an image: COLOR, GREY or DEPTH

    @property
    def taken_for(self) -> str:
        """What it can serve as; empty = nothing."""
        if self.type in TF_TYPES:
            return FIXED_TRANSFORMS if self.name.endswith(STATIC) else TRANSFORMS
        kinds = {CAMERA_INFO: CAMERA, POINT_CLOUD: CLOUD, PATH: GRAPH}
        if self.type in kinds:
            return kinds[self.type]
        return POSES if self.type in POSE_TYPES else self.shows

    @property
    def image_name(self) -> str:
        """The topic without the name of a transport."""
        for transport in TRANSPORTS:
            if self.name.endswith(transport):
                return self.name.removesuffix(transport)
        return self.name

    @property
    def is_rectified(self) -> bool:
        """Whether an image is named as one whose lens was straightened."""
        return "rect" in self.image_name.rpartition("/")[2]


@dataclass(frozen=True)
class Chosen:
    """The topics that are read; None for a camera that nobody publishes."""

    color: Topic
    depth: Topic
    color_info: Topic | None
    depth_info: Topic | None
    others: tuple[str, ...]  # further colour and depth topics

    def said(self) -> str:
        """One phrase."""
        info = f", camera {self.color_info.name}" if self.color_info else ""
        return (
            f"colour {self.color.name} ({self.color.encoding}), depth {self.depth.name} ({self.depth.encoding}){info}"
        )


def chosen(topics: Sequence[Topic], options: ReadOptions) -> Chosen:
    """The topics that are told, else those that fit together best. Raises ValueError with one sentence."""
    colors = _candidates(topics, options.color_topic, (COLOR, GREY), "color")
    depths = _candidates(topics, options.depth_topic, (DEPTH,), "depth")
    color, depth = max(((c, d) for c in colors for d in depths), key=lambda pair: _fitness(*pair))
    images = {topic.image_name for topic in topics if topic.shows in (COLOR, DEPTH)}
    others = tuple(sorted(images - {color.image_name, depth.image_name}))
    infos = [topic for topic in topics if topic.type == CAMERA_INFO and topic.count]
    told = _told(topics, options.info_topic, (CAMERA,), "info") if options.info_topic else None
    return Chosen(color, depth, told or _info_of(color, infos), _info_of(depth, infos, alone=False), others)


def cloud_chosen(topics: Sequence[Topic], options: ReadOptions) -> Chosen | None:
    """The cloud that gives depth: the told one, else, where there are no depth images, that with most messages.

    Its `color` is the cloud itself where there are no pictures. Raises ValueError with one sentence.
    """
    clouds = [topic for topic in topics if topic.type == POINT_CLOUD and topic.count]
    named = [cloud for cloud in clouds if cloud.name.lstrip("/") == options.depth_topic.lstrip("/")]
    if not named and (options.depth_topic or any(topic.shows == DEPTH and topic.count for topic in topics)):
        return None
    if not (named or clouds):
        return None
    cloud = named[0] if named else max(clouds, key=lambda topic: (topic.count, _falling(topic)))
    pictures = [topic for topic in topics if topic.shows in (COLOR, GREY) and topic.count]
    if not (pictures or options.color_topic):
        return Chosen(cloud, cloud, None, None, ())
    candidates = _candidates(topics, options.color_topic, (COLOR, GREY), "color")
    color = max(candidates, key=lambda topic: _fitness(topic, cloud))
    infos = [topic for topic in topics if topic.type == CAMERA_INFO and topic.count]
    told = _told(topics, options.info_topic, (CAMERA,), "info") if options.info_topic else None
    others = tuple(sorted({topic.image_name for topic in pictures} - {color.image_name}))
    return Chosen(color, cloud, told or _info_of(color, infos), None, others)


def pose_topics(topics: Sequence[Topic], options: ReadOptions) -> list[Topic]:
    """Topics of poses, the told one alone, else by how much their type says. Raises ValueError."""
    if options.pose_topic:
        return [_told(topics, options.pose_topic, (POSES, TRANSFORMS), "pose")]
    found = [topic for topic in topics if topic.taken_for == POSES and topic.count]
    return sorted(found, key=lambda topic: (POSE_TYPES.index(topic.type), -topic.count, topic.name))


def graph_topic(topics: Sequence[Topic], options: ReadOptions) -> Topic | None:
    """The topic of optimised poses, where one is told; nobody need have published on it. Raises ValueError."""
    if not options.graph_topic:
        return None
    announced = [replace(topic, count=1) if topic.type == PATH else topic for topic in topics]
    return _told(announced, options.graph_topic, (GRAPH,), "graph")


def _candidates(topics: Sequence[Topic], told: str, shows: Sequence[str], option: str) -> list[Topic]:
    """Those that may be meant, at least one. Raises ValueError."""
    if told:
        return [_told(topics, told, shows, option)]
    found = [topic for topic in topics if topic.shows in shows and topic.count]
    if not found:
        unknown = [f"{t.name} ({t.encoding})" for t in topics if t.type in (IMAGE, COMPRESSED) and not t.shows]
        held = f"; images of an unknown encoding: {', '.join(unknown[:NAMED])}" if unknown else ""
        what = "colour" if option == "color" else option
        raise ValueError(f"it has no {what} images{held}; `prior-sg ros topics` lists what it has")
    return found


def _told(topics: Sequence[Topic], name: str, kinds: Sequence[str], option: str) -> Topic:
    """The topic of this name, which may lack its first slash. Raises ValueError."""
    topic = next((t for t in topics if t.name.lstrip("/") == name.lstrip("/")), None)
    if topic is None or topic.taken_for not in kinds or not topic.count:
        serve = [t.name for t in topics if t.taken_for in kinds and t.count]
        is_what = "is not in it" if topic is None else f"({topic.type}, {topic.count} messages) cannot serve"
        raise ValueError(f"--{option}-topic {name} {is_what}; what can: {', '.join(serve[:NAMED]) or 'none'}")
    return topic


def _fitness(color: Topic, depth: Topic) -> tuple:
    """How well two topics fit: colour before grey, one frame, one camera's name, many messages, no compression."""
    shared = 0
    for a, b in zip(color.name.split("/"), depth.name.split("/"), strict=False):
        if a != b:
            break
        shared += 1
    raw = (color.type == IMAGE) + (depth.type == IMAGE)
    names = _falling(color), _falling(depth)
    return color.shows == COLOR, color.frame == depth.frame, shared, min(color.count, depth.count), raw, names


def _falling(topic: Topic) -> tuple[int, ...]:
    """Of equals the name that comes first wins, whatever the order in the recording."""
    return tuple(-ord(letter) for letter in topic.name)


def _info_of(image: Topic, infos: Sequence[Topic], alone: bool = True) -> Topic | None:
    """The camera info beside an image's topic, else that of its frame, else, where that is enough, the only one."""
    folder = image.image_name.rpartition("/")[0]
    beside = [info for info in infos if info.name in (f"{folder}/camera_info", f"{image.image_name}/camera_info")]
    of_frame = [info for info in infos if info.frame and info.frame == image.frame]
    only = list(infos) if alone and len(infos) == 1 else []
    return next(iter((*beside, *of_frame, *only)), None)

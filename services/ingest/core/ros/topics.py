"""Which topics of a recording are the colour, the depth, the camera and the poses (pure)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from prior_sg.services.ingest.core.options import ReadOptions
from prior_sg.services.ingest.core.ros.clouds import LIVOX_TYPES
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
CLOUDS = (POINT_CLOUD, *LIVOX_TYPES)
READ_TYPES = (IMAGE, COMPRESSED, CAMERA_INFO, *CLOUDS, PATH, *TF_TYPES, *POSE_TYPES)
STATIC = "tf_static"
TREE = ("/tf", "/tf_static")
SHARED = 2  # parts of the names of two topics, the empty one before the first slash included, that make one camera
TRANSPORTS = ("/compressed", "/compressedDepth")  # what image_transport adds to a topic's name
CAMERA, TRANSFORMS, FIXED_TRANSFORMS, POSES = "camera", "transforms", "fixed transforms", "poses"
CLOUD = "cloud of points"
GRAPH = "pose graph"  # only where it is told: a path may be one that is planned
NAMED = 6


class CannotServeError(ValueError):
    """A topic that is told is there and of a type that cannot be meant."""


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
        kinds = {CAMERA_INFO: CAMERA, PATH: GRAPH} | dict.fromkeys(CLOUDS, CLOUD)
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
    others: tuple[str, ...] = ()  # further colour and depth topics

    def said(self) -> str:
        """One phrase."""
        info = f", camera {self.color_info.name}" if self.color_info else ""
        depth = f"depth of {self.depth.name}" if self.of_cloud else f"depth {self.depth.name} ({self.depth.encoding})"
        if self.alone:
            return depth
        return f"colour {self.color.name} ({self.color.encoding}), {depth}{info}"

    @property
    def of_cloud(self) -> bool:
        """Whether its depth comes from a lidar."""
        return self.depth.type in CLOUDS

    @property
    def alone(self) -> bool:
        """Whether there is a lidar and no camera."""
        return self.color is self.depth

    @property
    def unread(self) -> str:
        """A note on further images; empty = there are none."""
        if not self.others:
            return ""
        more = f" and {len(self.others) - NAMED} more" if len(self.others) > NAMED else ""
        return (
            f"further images are not read: {', '.join(self.others[:NAMED])}{more} (--cameras all reads every camera "
            "with depth and camera info; --color-topic, --depth-topic name others)"
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


def chosen_cameras(topics: Sequence[Topic], options: ReadOptions, heard: bool = True) -> list[Chosen]:
    """The cameras that are asked for, each with a depth topic of its own, by name.

    All are those with colour, depth and camera info. Of a running robot one that is named need not be `heard` yet.
    Raises ValueError with one sentence.
    """
    named = options.named_cameras
    shown = [topic for topic in topics if topic.shows in (COLOR, GREY) and topic.count]
    if named:
        told = [name for name in named if heard or any(_is_called(topic, name) for topic in shown)]
        colors = [_told(topics, name, (COLOR, GREY), "color") for name in told]
    else:
        kind = COLOR if any(topic.shows == COLOR for topic in shown) else GREY
        colors = [topic for topic in shown if topic.shows == kind]
    depths = [topic for topic in topics if topic.shows == DEPTH and topic.count]
    infos = [topic for topic in topics if topic.type == CAMERA_INFO and topic.count]
    found: dict[str, Chosen] = {}
    taken: set[str] = set()
    for color, depth in sorted(
        ((c, d) for c in colors for d in depths), key=lambda pair: _fitness(*pair), reverse=True
    ):
        info = _info_of(color, infos, alone=False)
        used = color.image_name in found or depth.image_name in taken
        if not used and info is not None and _of_one_camera(color, depth):
            found[color.image_name] = Chosen(color, depth, info, _info_of(depth, infos, alone=False))
            taken.add(depth.image_name)
    if lacking := [color.name for color in colors if named and color.image_name not in found]:
        raise ValueError(f"--cameras {lacking[0]} has no depth images and camera info beside it or in its frame")
    if not found:
        raise ValueError("it has no camera with colour, depth and camera info; `prior-sg ros topics` lists what it has")
    return [found[name] for name in sorted(found)]


def _is_called(topic: Topic, name: str) -> bool:
    return topic.name.lstrip("/") == name


def _of_one_camera(color: Topic, depth: Topic) -> bool:
    """Whether depth is of the same frame, or its topic lies in the same folder."""
    return color.frame == depth.frame or _shared(color, depth) >= SHARED


def cloud_chosen(topics: Sequence[Topic], options: ReadOptions) -> Chosen | None:
    """The cloud that gives depth: the told one, else, where there are no depth images, that with most messages.

    Its `color` is the cloud itself where there are no pictures. Raises ValueError with one sentence.
    """
    clouds = [topic for topic in topics if topic.type in CLOUDS and topic.count]
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
    if not any(_is_called(topic, options.graph_topic.lstrip("/")) for topic in topics):
        return Topic(f"/{options.graph_topic.lstrip('/')}", PATH, 0, 0.0)
    announced = [replace(topic, count=1) if topic.type == PATH else topic for topic in topics]
    return _told(announced, options.graph_topic, (GRAPH,), "graph")


def tree_topics(topics: Sequence[Topic]) -> list[Topic]:
    """Those of transforms; the usual ones also where nobody has published on them yet."""
    found = [topic for topic in topics if topic.type in TF_TYPES]
    names = {topic.name for topic in found}
    return [*found, *(Topic(name, TF_TYPES[0], 0, 0.0) for name in TREE if name not in names)]


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
        lasting = topic is not None and bool(topic.taken_for or topic.count) and topic.taken_for not in kinds
        kind = CannotServeError if lasting else ValueError
        raise kind(f"--{option}-topic {name} {is_what}; what can: {', '.join(serve[:NAMED]) or 'none'}")
    return topic


def _fitness(color: Topic, depth: Topic) -> tuple:
    """How well two topics fit: colour before grey, one frame, one camera's name, many messages, no compression."""
    shared = _shared(color, depth)
    raw = (color.type == IMAGE) + (depth.type == IMAGE)
    names = _falling(color), _falling(depth)
    return color.shows == COLOR, color.frame == depth.frame, shared, min(color.count, depth.count), raw, names


def _shared(one: Topic, other: Topic) -> int:
    """How many parts of their names are the same, from the front."""
    pairs = list(zip(one.name.split("/"), other.name.split("/"), strict=False))
    return next((i for i, (a, b) in enumerate(pairs) if a != b), len(pairs))


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

"""How a source is read where its own files do not say, or say it wrongly (pure).

Every field has a value that means "as the files or the layout say". The fields are settings of ingest.
"""

import math
from collections.abc import Sequence
from typing import Literal

import msgspec

from prior_sg.schemas.codec import Signed

PoseConvention = Literal["world_from_camera", "camera_from_world"]
QuaternionOrder = Literal["xyzw", "wxyz"]
CameraAxes = Literal["opencv", "opengl", "ros", "ned"]
StampUnit = Literal["s", "ms", "us", "ns"]
StampClock = Literal["header", "received"]
LensModel = Literal["pinhole", "opencv", "fisheye"]
DepthOutput = Literal["inverse", "metric"]
COEFFICIENTS: dict[str, tuple[int, ...]] = {"pinhole": (0,), "opencv": (4, 5, 8), "fisheye": (4,)}
ROBOT, CAMERAS = "ros2:", ("realsense:", "oak:")  # what sources that are no files begin with
ORIGIN_KEPT, ORIGIN_AUTO = "keep", "auto"
ALL_CAMERAS = "all"


class ReadOptions(msgspec.Struct, frozen=True, kw_only=True):
    """What the user says about a source. Raises ValueError with one sentence for what cannot be meant."""

    source_robot: str = ""  # of a log with several robots: the one to read; empty = the first
    layout: str = ""  # name of a layout in docs/sources.md; empty = recognised by its files
    world_up: list[Signed] = msgspec.field(default_factory=list)  # up in the source's world; empty = as the layout says
    floor_m: Signed = 0.0  # height of the floor in the source's world, measured along world_up; becomes z = 0
    origin: str = ORIGIN_AUTO  # keep, auto (recentred when kilometres away), or x,y,z in the levelled world
    rate_hz: float = 0.0  # frames per second, in place of the source's stamps; 0 = by its stamps
    stamp_unit: Literal["", StampUnit] = ""  # of written stamps; empty = detected from their size and spacing
    stamp_offset_s: Signed | None = None  # added to the stamps of separately stamped poses; none = detected
    depth_scale_m: float | None = None  # metres per depth unit; none = as the source says
    depth_invalid: list[Signed] | None = None  # depth values that mean nothing, besides 0; none = 65535
    depth_min_m: float = 0.0  # nearer depth is no measurement
    depth_max_m: float = 0.0  # farther depth is no measurement; 0 = no limit
    poses: Literal["", PoseConvention] = ""  # what the written poses map
    quaternion: Literal["", QuaternionOrder] = ""  # order of the written quaternions
    camera_axes: Literal["", CameraAxes] = ""  # opencv: x right, y down; opengl: y up, z back; ros: x ahead, z up;
    # ned: x ahead, z down
    position_scale_m: float = 1.0  # metres per unit of written positions
    intrinsics: list[float] = msgspec.field(default_factory=list)  # fx fy cx cy, pixels; then width height, if other
    camera_model: Literal["", LensModel] = ""  # of the lens; opencv = radial and tangential, fisheye = Kannala-Brandt
    distortion: list[Signed] = msgspec.field(default_factory=list)  # its coefficients, as OpenCV orders them
    cameras: str = ""  # of a robot of ROS: all, or colour topics separated by commas; empty = one camera
    color_topic: str = ""  # of a ROS recording; empty = chosen by type, frame and name, as are the next three
    depth_topic: str = ""
    info_topic: str = ""  # the colour camera's info
    pose_topic: str = ""  # odometry, poses or transforms; empty = tf where it moves the camera, else one of them
    pose_source: str = ""  # of a camera: a file or FIFO that grows by lines of stamp tx ty tz qx qy qz qw, or ros2:/
    body_from_camera: list[Signed] = msgspec.field(
        default_factory=list
    )  # of a camera: tx ty tz qx qy qz qw of it in the
    # frame whose poses come; empty = they are the camera's
    graph_topic: str = ""  # of a live robot: its optimised poses (nav_msgs/Path) of pose_frame; empty = jumps of tf
    fixed_frame: str = ""  # of tf: the world; empty = map, world, odom or the root
    pose_frame: str = ""  # the frame whose poses pose_topic has; empty = as its messages say, else the camera's
    depth_model: str = ""  # an ONNX file that sees depth in one picture, or in two; empty = none, and of two pictures
    # OpenCV's semi-global matching
    depth_output: Literal["", DepthOutput] = ""  # of a depth_model of one picture: inverse depth, or (metric) depth;
    # empty = as the file says
    sync_tolerance_s: float = 0.02  # most between stamps of colour, depth and pose that belong together
    ros_domain: int = 0  # of a live robot: its ROS_DOMAIN_ID
    end_after_s: float = 30.0  # a live source has ended after so long without a frame; 0 = never
    clock: StampClock = "header"  # stamps of a ROS recording: of the messages' headers, or of their arrival

    def __post_init__(self) -> None:
        if self.depth_scale_m is not None and not (math.isfinite(self.depth_scale_m) and self.depth_scale_m > 0):
            raise ValueError(f"depth_scale_m must be a positive number of metres, got {self.depth_scale_m}")
        if not (math.isfinite(self.position_scale_m) and self.position_scale_m > 0):
            raise ValueError(f"position_scale_m must be a positive number of metres, got {self.position_scale_m}")
        if not (math.isfinite(self.rate_hz) and self.rate_hz >= 0):
            raise ValueError(f"rate_hz must be a number of frames per second, got {self.rate_hz}")
        if not (math.isfinite(self.sync_tolerance_s) and self.sync_tolerance_s > 0):
            raise ValueError(f"sync_tolerance_s must be a positive number of seconds, got {self.sync_tolerance_s}")
        if not (math.isfinite(self.end_after_s) and self.end_after_s >= 0):
            raise ValueError(f"end_after_s must be a number of seconds, got {self.end_after_s}")
        if not 0 <= self.depth_min_m < (self.depth_max_m or math.inf):
            raise ValueError("depth_min_m must be at least 0 and below depth_max_m")
        if self.intrinsics and not (
            len(self.intrinsics) in (4, 6) and all(math.isfinite(v) and v > 0 for v in self.intrinsics)
        ):
            raise ValueError("intrinsics must be fx fy cx cy, or fx fy cx cy width height, in pixels")
        of_one = (self.color_topic, self.depth_topic, self.info_topic, self.intrinsics, self.distortion, self.rate_hz)
        if self.cameras and any(of_one):
            raise ValueError(
                "several cameras have their own topics, intrinsics, lenses and stamps: with --cameras leave out "
                "--color-topic, --depth-topic, --info-topic, --intrinsics, --distortion and --rate"
            )
        if self.body_from_camera and not _is_pose(self.body_from_camera):
            raise ValueError(
                "body_from_camera must be tx ty tz qx qy qz qw, in metres, with a quaternion that is not zero"
            )
        check_lens(self.camera_model, self.distortion)
        offset_of(self.origin)

    @property
    def named_cameras(self) -> tuple[str, ...]:
        """Colour topics of the cameras that are asked for, without their first slashes; empty = all, or one."""
        if self.cameras == ALL_CAMERAS:
            return ()
        return tuple(filter(None, (name.strip().lstrip("/") for name in self.cameras.split(","))))

    def frame_ns(self, published_hz: float) -> float:
        """Nanoseconds between frames of a layout without stamps."""
        return 1e9 / (self.rate_hz or published_hz)

    def told_ns(self, number: int, stamp_ns: int) -> int:
        """The stamp of a frame that has one: by the rate where that is told, else its own."""
        return round(number * self.frame_ns(1)) if self.rate_hz else stamp_ns


def is_live(source: str) -> bool:
    """Whether a source is a running robot or a camera rather than a file."""
    return is_robot(source) or is_camera(source)


def is_robot(source: str) -> bool:
    """Whether a source is a running robot."""
    return source.startswith(ROBOT)


def is_camera(source: str) -> bool:
    """Whether a source is a camera, or its recording played back."""
    return source.startswith(CAMERAS)


def check_posed(source: str, pose_source: str) -> None:
    """Raise ValueError for a camera of which nobody says where it is."""
    if is_camera(source) and not pose_source:
        raise ValueError(
            f"{source}: a camera does not know where it is; give --pose-source FILE (or a FIFO, with lines of stamp tx "
            "ty tz qx qy qz qw) or --pose-source ros2:/ with --pose-topic"
        )


def _is_pose(numbers: Sequence[float]) -> bool:
    return len(numbers) == 7 and all(map(math.isfinite, numbers)) and any(numbers[3:])


def check_lens(model: str, coefficients: Sequence[float]) -> None:
    """Raise ValueError unless a lens of this model (empty = the one that fits) can have these coefficients."""
    if not all(math.isfinite(value) for value in coefficients):
        raise ValueError("a distortion coefficient is not finite")
    allowed = COEFFICIENTS["opencv"] if not model else COEFFICIENTS[model]
    if coefficients and len(coefficients) not in allowed:
        counts = " or ".join(map(str, allowed))
        raise ValueError(f"a {model or 'opencv'} lens has {counts} distortion coefficients, not {len(coefficients)}")


def offset_of(origin: str) -> tuple[float, float, float] | None:
    """The coordinates of the new origin, in the levelled world; None = keep or auto. Raises ValueError."""
    if origin in (ORIGIN_KEPT, ORIGIN_AUTO):
        return None
    try:
        x_m, y_m, z_m = (float(word) for word in origin.replace(",", " ").split())
    except ValueError:
        raise ValueError(f"origin must be keep, auto, or x,y,z in metres; got {origin!r}") from None
    if not all(map(math.isfinite, (x_m, y_m, z_m))):
        raise ValueError(f"origin must be finite, got {origin!r}")
    return x_m, y_m, z_m

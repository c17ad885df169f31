"""Options of every command that reads a source: one table, each option one setting of ingest."""

import argparse
import os
from dataclasses import dataclass
from typing import TYPE_CHECKING

from prior_sg.deploy.settings import resolved_config

if TYPE_CHECKING:
    from prior_sg.services.ingest.core.config import Config
    from prior_sg.services.place_graph.core.config import Config as PlaceGraphConfig

GROUP = "how the source is read, where its files do not say or say it wrongly"


@dataclass(frozen=True)
class Option:
    """One option and the setting it stands for."""

    flag: str
    setting: str  # of ingest
    metavar: str
    help: str
    listed: bool = False  # numbers separated by commas
    choices: tuple[str, ...] = ()

    @property
    def dest(self) -> str:
        """Its name among the parsed arguments."""
        return f"source_{self.setting}"


OPTIONS = (
    Option(
        "--layout",
        "layout",
        "NAME",
        "layout, as docs/sources.md names it; default: recognised by its files",
    ),
    Option("--rate", "rate_hz", "HZ", "frames per second, in place of the source's stamps"),
    Option("--stamp-unit", "stamp_unit", "UNIT", "unit of written stamps", choices=("s", "ms", "us", "ns")),
    Option("--stamp-offset", "stamp_offset_s", "SECONDS", "added to the stamps of poses in a list of their own"),
    Option("--depth-scale", "depth_scale_m", "METRES", "metres per unit of depth"),
    Option(
        "--depth-invalid", "depth_invalid", "VALUE,…", "stored depth that means nothing (default: 65535)", listed=True
    ),
    Option("--depth-min", "depth_min_m", "METRES", "nearer depth is no measurement"),
    Option("--depth-max", "depth_max_m", "METRES", "farther depth is no measurement"),
    Option(
        "--poses",
        "poses",
        "CONVENTION",
        "what the written poses map",
        choices=("world_from_camera", "camera_from_world"),
    ),
    Option("--quaternion", "quaternion", "ORDER", "order of written quaternions", choices=("xyzw", "wxyz")),
    Option(
        "--axes",
        "camera_axes",
        "AXES",
        "camera axes: opencv (y down), opengl (y up, z back), ros (x ahead, z up), ned (x ahead, z down)",
        choices=("opencv", "opengl", "ros", "ned"),
    ),
    Option("--position-scale", "position_scale_m", "METRES", "metres per unit of written positions"),
    Option("--intrinsics", "intrinsics", "FX,FY,CX,CY[,W,H]", "the camera, pixels", listed=True),
    Option("--camera-model", "camera_model", "MODEL", "of the lens", choices=("pinhole", "opencv", "fisheye")),
    Option(
        "--distortion",
        "distortion",
        "K1,K2,…",
        "coefficients of the lens as OpenCV orders them (--distortion=-0.3,0.1,0,0)",
        listed=True,
    ),
    Option("--origin", "origin", "keep|auto|X,Y,Z", "new zero of the world; auto: recentred when kilometres away"),
    Option("--up", "world_up", "X,Y,Z", "direction that points up in the source's world", listed=True),
    Option("--floor", "floor_m", "METRES", "height of the floor in the source's world, along up"),
    Option(
        "--cameras",
        "cameras",
        "all|TOPIC,…",
        "read several RGB-D cameras of a robot of ROS at once: all, or their colour topics (default: one camera)",
    ),
    Option("--color-topic", "color_topic", "TOPIC", "colour images of a ROS recording (see `prior-sg ros topics`)"),
    Option("--depth-topic", "depth_topic", "TOPIC", "its depth images"),
    Option("--info-topic", "info_topic", "TOPIC", "camera info of its colour images"),
    Option("--pose-topic", "pose_topic", "TOPIC", "its odometry, poses or transforms; default: tf, else one of these"),
    Option(
        "--pose-source", "pose_source", "FILE|ros2:/", "where poses of a camera come from: growing lines, or a topic"
    ),
    Option(
        "--mount", "body_from_camera", "TX,TY,TZ,QX,QY,QZ,QW", "the camera in the frame whose poses come", listed=True
    ),
    Option("--graph-topic", "graph_topic", "TOPIC", "of a live robot: optimised poses (nav_msgs/Path) of --pose-frame"),
    Option("--fixed-frame", "fixed_frame", "FRAME", "the world, of tf; default: map, world, odom or the root"),
    Option("--pose-frame", "pose_frame", "FRAME", "the frame whose poses --pose-topic has"),
    Option(
        "--depth-model", "depth_model", "FILE", "ONNX file that sees depth in one picture, or in a stereo camera's two"
    ),
    Option(
        "--depth-output", "depth_output", "KIND", "of a network that sees one picture", choices=("inverse", "metric")
    ),
    Option(
        "--sync-tolerance", "sync_tolerance_s", "SECONDS", "most between stamps of one frame's colour, depth and pose"
    ),
    Option("--domain", "ros_domain", "ID", "domain of a live robot; default: ROS_DOMAIN_ID, else 0"),
    Option("--end-after", "end_after_s", "SECONDS", "without a frame, a live source has ended (default: 30; 0: never)"),
    Option("--clock", "clock", "CLOCK", "stamps of a ROS recording: of its", choices=("header", "received")),
)


def add_source_options(parser: argparse.ArgumentParser) -> None:
    """Give a command the options."""
    group = parser.add_argument_group(GROUP)
    for option in OPTIONS:
        group.add_argument(
            option.flag,
            dest=option.dest,
            default=None,
            choices=option.choices or None,
            metavar=option.metavar,
            help=option.help + (f": {', '.join(option.choices)}" if option.choices else ""),
        )


def source_option(arguments: argparse.Namespace, flag: str) -> str | None:
    """What was told for one of them, as it was written."""
    told: str | None = getattr(arguments, next(option.dest for option in OPTIONS if option.flag == flag))
    return told


def source_settings(arguments: argparse.Namespace) -> list[str]:
    """Settings of ingest for the options that were given; none for a command that has no such options."""
    given = ((option, getattr(arguments, option.dest, None)) for option in OPTIONS)
    told = [f"ingest.{option.setting}={_value(option, text)}" for option, text in given if text is not None]
    return [*_surroundings(arguments), *told]


def _surroundings(arguments: argparse.Namespace) -> list[str]:
    """What ROS's own environment says of a running robot. Raises UserError."""
    from prior_sg.deploy.ros.options import DOMAIN_VARIABLE, domain_of
    from prior_sg.services.ingest.core.options import is_live

    live = is_live(str(getattr(arguments, "source", None) or ""))
    return [f"ingest.ros_domain={domain_of('')}"] if live and os.environ.get(DOMAIN_VARIABLE) else []


def read_options(arguments: argparse.Namespace) -> "Config":
    """What the options, `--config` and `--set` say, for a command that reads a source itself. Raises ConfigError."""
    from prior_sg.services.registry import BY_NAME

    config, settings = getattr(arguments, "config", "") or "", getattr(arguments, "set", None) or []
    return resolved_config(BY_NAME["ingest"], config, [*source_settings(arguments), *settings])


def mapping_options(arguments: argparse.Namespace) -> "PlaceGraphConfig":
    """What `--config` and `--set` say of the place graph. Raises ConfigError."""
    from prior_sg.services.registry import BY_NAME

    config, settings = getattr(arguments, "config", "") or "", getattr(arguments, "set", None) or []
    return resolved_config(BY_NAME["place_graph"], config, settings)


def _value(option: Option, text: str) -> str:
    return f"[{text.strip().strip('[]').strip().replace(' ', ',')}]" if option.listed else text

"""The middles of regions as frames of tf, and regions as a short table (pure)."""

from collections.abc import Mapping, Sequence
from typing import Any

from prior_sg.deploy.ros import messages
from prior_sg.deploy.ros.messages import Classes
from prior_sg.deploy.showing.colors import Color
from prior_sg.schemas.regions import Region
from prior_sg.schemas.scene import Scene

TF = "tf2_msgs/msg/TFMessage"
MOST_FRAMES = 200
DECIMALS = 3


def frame_of(node: str, region: Region) -> str:
    """The frame in a region's middle, which it keeps for life."""
    return f"{node}/region_{region.id}"


def transforms(classes: Classes, regions: Sequence[Region], node: str, frame: str, stamp_ns: int) -> Any:
    """Where the middles of the largest regions lie; not turned."""
    largest = sorted(regions, key=lambda region: (-region.area_m2, region.id))[:MOST_FRAMES]
    return classes[TF]([_transform(classes, region, node, frame, stamp_ns) for region in largest])


def _transform(classes: Classes, region: Region, node: str, frame: str, stamp_ns: int) -> Any:
    unturned = classes["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    moved = classes["geometry_msgs/msg/Vector3"](*map(float, region.position_m))
    return classes["geometry_msgs/msg/TransformStamped"](
        messages.header(classes, frame, stamp_ns),
        frame_of(node, region),
        classes["geometry_msgs/msg/Transform"](moved, unturned),
    )


def table(
    scene: Scene, node: str, frame: str, values: Mapping[int, int], colors: Mapping[str, Color]
) -> dict[str, Any]:
    """What every region is, and by which value, frame and colour other topics know it."""
    return {
        "robot": scene.robot,
        "revision": scene.revision,
        "stamp_ns": scene.stamp_ns,
        "environment": scene.environment,
        "task": scene.task,
        "frame": frame,
        "origin_m": list(scene.origin_m),
        "regions": [
            {
                "id": region.id,
                "label": region.label,
                "probability": round(region.probability, DECIMALS),
                "predicted": region.predicted,
                "area_m2": round(region.area_m2, DECIMALS),
                "position_m": [round(value, DECIMALS) for value in region.position_m],
                "neighbours": region.neighbour_ids,
                "grid_value": values.get(region.id),
                "frame": frame_of(node, region),
                "color": list(colors[region.label]),
            }
            for region in scene.regions
        ],
    }

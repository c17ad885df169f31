"""Objects and printed markers: what was seen in one keyframe, and what association over time made of it, as deltas."""

from typing import Annotated

import msgspec
import numpy as np

from prior_sg.schemas.codec import Message, Number, NumberOrNone, Part, Shape, Stamp
from prior_sg.schemas.frames import Intrinsics, Pose, check_pose
from prior_sg.schemas.markers import SceneMarker
from prior_sg.schemas.members import MapMember

_NO_NAMES = msgspec.field(default_factory=lambda: np.zeros(0, np.int16))
_NO_MARKERS = msgspec.field(default_factory=lambda: np.zeros(0, np.int32))
_NO_SIDES = msgspec.field(default_factory=lambda: np.zeros(0, np.float32))
_NO_POSES = msgspec.field(default_factory=lambda: np.zeros((0, 4, 4)))
_NO_MERGES = msgspec.field(default_factory=lambda: np.zeros((0, 2), np.int64))


class Detections(Message, frozen=True, kw_only=True):
    """The objects seen in one keyframe, lifted by its depth.

    Everything stands in the camera frame, so that a corrected pose moves it without detecting again. The points of a
    detection are a sample of its visible surface, one per cell of a grid; those of all detections follow each other.
    """

    robot: str
    frame_id: Number
    stamp_ns: Stamp
    space: str  # embedding space
    detector: str  # its setting, for example segments
    prompted: bool  # whether the detector looks for objects by name
    worker: str
    intrinsics: Intrinsics
    world_from_camera: Pose
    boxes_px: Annotated[np.ndarray, Shape("float32", "detection", 4)]  # left, top, right, bottom
    scores: Annotated[np.ndarray, Shape("float32", "detection")]  # the detector's own, in [0, 1]
    embeddings: Annotated[np.ndarray, Shape("float16", "detection", "dim")]  # unit length
    point_counts: Annotated[np.ndarray, Shape("int32", "detection")]  # at least 1 each
    points_camera_m: Annotated[np.ndarray, Shape("float16", "point", 3)]
    surface_m: Annotated[np.ndarray, Shape("float16", "row", "column")]  # coarse depth image, 0 = no measurement
    sought: list[str] = []  # the names that a prompted detector was asked for
    names: Annotated[np.ndarray, Shape("int16", "named")] = _NO_NAMES  # of each detection, the index into `sought`
    marker_dictionary: str = ""  # of the markers that were looked for; empty = none were
    marker_size_m: float = 0.0  # side of their black squares
    marker_ids: Annotated[np.ndarray, Shape("int32", "marker")] = _NO_MARKERS
    marker_sides_px: Annotated[np.ndarray, Shape("float32", "marker")] = _NO_SIDES  # mean of the four, as seen
    camera_from_marker: Annotated[np.ndarray, Shape("float64", "marker", 4, 4)] = _NO_POSES  # frame as in SceneMarker

    def check(self) -> None:
        check_pose(self.world_from_camera)
        check_pose(self.camera_from_marker, "camera_from_marker")
        if len(self.marker_ids) and not (self.marker_dictionary and self.marker_size_m > 0):
            raise ValueError("marker_ids: without a dictionary and a size")
        if len(self.names) != (len(self.scores) if self.sought else 0):
            raise ValueError("names: not one per detection")
        if len(self.names) and not (self.names.min() >= 0 and self.names.max() < len(self.sought)):
            raise ValueError("names: no such name was sought")
        if (self.point_counts < 1).any() or self.point_counts.sum() != len(self.points_camera_m):
            raise ValueError("point_counts do not fit the points")


class SceneObject(Part, frozen=True, kw_only=True):
    """One object of the scene; world, metres."""

    id: int
    label: str  # the prior's most probable object; empty = none of them, or no prior yet
    probability: float  # P(label | object), after what is none of the prior's objects
    known: float  # probability that it is any of the prior's objects
    position_m: tuple[float, float, float]  # middle of its box
    min_m: tuple[float, float, float]  # axis-aligned box
    max_m: tuple[float, float, float]
    frames: int  # keyframes in which it was detected
    members: list[MapMember] = []  # of a merged map: the robots' objects that it is made of


class ObjectDelta(Message, frozen=True, kw_only=True):
    """Change of the objects since the previous revision; with `snapshot`, all of them.

    Apply in this order: remove, merge (the first of a pair is gone, the second holds both), upsert.
    """

    robot: str
    epoch: Number
    revision: NumberOrNone
    stamp_ns: Stamp
    prior_digest: str  # of the prior whose objects the labels name, empty before the first
    snapshot: bool = False
    objects: list[SceneObject]
    removed_ids: Annotated[np.ndarray, Shape("int64", "removed")]
    merged_ids: Annotated[np.ndarray, Shape("int64", "merged", 2)] = _NO_MERGES  # (gone, into)
    markers: list[SceneMarker] = []  # to be upserted, too; markers stay as they were last told

"""Printed markers (AprilTag, ArUco), by which people say that two maps show one spot."""

import math
from typing import NamedTuple

from prior_sg.schemas.codec import Part

UNIT_TOLERANCE = 1e-3


class MarkerKey(NamedTuple):
    """Which of all markers that can be printed."""

    dictionary: str
    id: int

    def __str__(self) -> str:
        return f"marker {self.id} ({self.dictionary})"


class SceneMarker(Part, frozen=True, kw_only=True):
    """One marker as several keyframes show it; its own frame: x right and y up as printed, z out of the paper."""

    dictionary: str  # as in the setting feature_pyramid.markers.dictionary
    id: int  # in that dictionary
    size_m: float  # side of its black square
    position_m: tuple[float, float, float]  # its middle, world
    quaternion_xyzw: tuple[float, float, float, float]  # world_from_marker, unit length
    frames: int  # keyframes that show it there
    doubt: str = ""  # why nothing may be concluded from it, as part of a sentence; empty = it stands at one spot

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (self.size_m > 0 and abs(math.hypot(*self.quaternion_xyzw) - 1) <= UNIT_TOLERANCE):
            raise ValueError("a marker without size, or whose quaternion is not of unit length")

    @property
    def key(self) -> MarkerKey:
        """Which marker it is."""
        return MarkerKey(self.dictionary, self.id)

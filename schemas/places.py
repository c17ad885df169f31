"""The place graph: free-space spheres and the clearance between them, as deltas."""

from typing import Annotated

import msgspec
import numpy as np

from prior_sg.schemas.codec import Message, Number, NumberOrNone, Shape, Stamp
from prior_sg.schemas.members import fault_of_merging

LARGEST_FLOAT32 = float(np.finfo(np.float32).max)
_NO_IDS = msgspec.field(default_factory=lambda: np.zeros(0, np.int64))
_NO_LENGTHS = msgspec.field(default_factory=lambda: np.zeros(0, np.float32))
_NO_CORNERS = msgspec.field(default_factory=lambda: np.zeros((0, 2), np.float32))
_NO_POINTS = msgspec.field(default_factory=lambda: np.zeros((0, 3), np.float32))


class PlaceDelta(Message, frozen=True, kw_only=True):
    """Change of the place graph since the previous revision; with `snapshot`, the whole graph.

    Apply in this order: remove edges, remove places (with all about them), merge, upsert places, upsert edges,
    upsert frontiers and surfaces.
    """

    robot: str
    epoch: Number  # new at every start of the writer
    revision: NumberOrNone  # grows by one per delta
    stamp_ns: Stamp  # of the keyframe that caused it
    frame_id: NumberOrNone
    snapshot: bool = False
    place_ids: Annotated[np.ndarray, Shape("int64", "place")]
    positions_m: Annotated[np.ndarray, Shape("float32", "place", 3)]  # world
    radii_m: Annotated[np.ndarray, Shape("float32", "place")]  # distance to the nearest obstacle
    basis_points: Annotated[np.ndarray, Shape("int16", "place")]  # obstacle points at that distance
    removed_ids: Annotated[np.ndarray, Shape("int64", "removed")]
    merged_ids: Annotated[np.ndarray, Shape("int64", "merged", 2)]  # (gone, into)
    edges: Annotated[np.ndarray, Shape("int64", "edge", 2)]  # place ids, smaller first
    clearances_m: Annotated[np.ndarray, Shape("float32", "edge")]  # smallest obstacle distance along the edge
    removed_edges: Annotated[np.ndarray, Shape("int64", "removed_edge", 2)]
    # Camera centre of the keyframe, world. Of the deltas that a large keyframe causes, the first has it, no snapshot.
    camera_m: tuple[float, float, float] | None = None
    event: str = ""  # what was wrong with the keyframe or the pose update, one sentence; empty = nothing
    # Snapshots: the keyframes so far and their camera centres; else those that a pose update moved.
    past_frame_ids: Annotated[np.ndarray, Shape("int64", "past")] = _NO_IDS
    past_cameras_m: Annotated[np.ndarray, Shape("float32", "past", 3)] = _NO_POINTS
    # Frontiers: places beside unobserved space, the direction towards it, and the area of the opening, 0 = none now.
    frontier_ids: Annotated[np.ndarray, Shape("int64", "frontier")] = _NO_IDS
    frontier_directions: Annotated[np.ndarray, Shape("float32", "frontier", 3)] = _NO_POINTS
    frontier_areas_m2: Annotated[np.ndarray, Shape("float32", "frontier")] = _NO_LENGTHS
    # 2D places: the ellipse on the ground (half axes in metres, angle of the long one in radians) and the convex hull,
    # whose points of all such places follow each other.
    surface_ids: Annotated[np.ndarray, Shape("int64", "surface")] = _NO_IDS
    ellipses: Annotated[np.ndarray, Shape("float32", "surface", 3)] = _NO_POINTS
    hull_counts: Annotated[np.ndarray, Shape("int64", "surface")] = _NO_IDS
    hulls_m: Annotated[np.ndarray, Shape("float32", "hull", 2)] = _NO_CORNERS
    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of the world, as in Keyframe
    merged_of: list[str] = []  # robots whose maps it is merged of; empty = it is a robot's own

    def check(self) -> None:
        if (self.hull_counts < 0).any() or self.hull_counts.sum() != len(self.hulls_m):
            raise ValueError("hull_counts do not add up to the points of hulls_m")
        if fault := fault_of_merging(self.robot, self.merged_of):
            raise ValueError(fault)
        if self.camera_m is not None and max(map(abs, self.camera_m)) > LARGEST_FLOAT32:
            raise ValueError("camera_m: does not fit 32 bits, in which scenes hold it")


class SnapshotRequest(Message, frozen=True, kw_only=True):
    """The whole state of a delta's writer, as one delta with `snapshot` set."""

    robot: str


class MapRequest(Message, frozen=True, kw_only=True):
    """The volumetric map as it stands."""

    robot: str


class VoxelMap(Message, frozen=True, kw_only=True):
    """Observed voxels by integer index; the centre of voxel i is (i + 0.5) * voxel_m in the world."""

    robot: str
    voxel_m: float
    free: Annotated[np.ndarray, Shape("int16", "free", 3)]
    occupied: Annotated[np.ndarray, Shape("int16", "occupied", 3)]

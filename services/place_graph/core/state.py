"""All that is known of one robot's map (pure)."""

import dataclasses
from dataclasses import dataclass

import numpy as np

from prior_sg.schemas.frames import Keyframe
from prior_sg.schemas.status import Loss
from prior_sg.services.deltas import PoseCorrections
from prior_sg.services.losses import Losses
from prior_sg.services.place_graph.core.archive import DepthArchive
from prior_sg.services.place_graph.core.config import Config
from prior_sg.services.place_graph.core.ground import GroundGraph
from prior_sg.services.place_graph.core.ledger import PlaceLedger
from prior_sg.services.place_graph.core.openings import Openings
from prior_sg.services.place_graph.core.skeleton.graph import PlaceGraph
from prior_sg.services.place_graph.core.trajectory import Trajectory
from prior_sg.services.place_graph.core.volume.grid import DERIVED, FIELDS, MEASURED, VoxelGrid


@dataclass
class Legacy:
    """What readers know of the map before this process."""

    ids: np.ndarray  # (place,)
    positions_m: np.ndarray  # (place, 3)
    next_id: int  # none has had it or a higher one
    # Keyframes in that map, as far as it is told.
    frame_ids: frozenset[int] = dataclasses.field(default_factory=frozenset)


@dataclass
class State:
    """Map and graph of one robot, and what its readers were told."""

    robot: str
    epoch: int
    graph: PlaceGraph
    archive: DepthArchive
    openings: Openings
    grid: VoxelGrid  # what was measured
    field: VoxelGrid  # distances and diagram; the same grid, or a coarser one
    ledger: PlaceLedger = dataclasses.field(default_factory=PlaceLedger)
    trajectory: Trajectory = dataclasses.field(default_factory=Trajectory)
    # By frame id, of those fused.
    cameras_m: dict[int, tuple[float, float, float]] = dataclasses.field(default_factory=dict)
    seen: set[int] = dataclasses.field(default_factory=set)  # frame ids of keyframes worked off, also of the refused
    corrections: PoseCorrections = dataclasses.field(default_factory=PoseCorrections)
    refused: dict[int, str] = dataclasses.field(default_factory=dict)  # why keyframes could not be used, by frame id
    joined_frame_id: int = 0  # first keyframe heard live; earlier ones come from the archive
    behind: bool = False  # earlier keyframes are still to come from the archive: readers keep what they have
    stands_by: bool = False  # another is in charge: nothing is told
    unnamed: bool = False  # what the map was before this process is not known yet
    legacy: Legacy | None = None  # the former map, until its ids are taken over
    unanswered: int = 0  # keyframes heard live since the archive answered last, while something is missing
    revision: int = -1
    stamp_ns: int = 0
    frame_id: int = -1
    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of the world, as the newest keyframe says

    @property
    def map_bytes(self) -> int:
        """Memory of all voxels."""
        return self.grid.size_bytes + (self.field.size_bytes if self.field is not self.grid else 0)

    @property
    def silent(self) -> bool:
        """Whether readers keep what they have."""
        return self.stands_by or self.incomplete

    @property
    def incomplete(self) -> bool:
        """Whether something is still to come of what was known before this process."""
        return self.behind or self.unnamed or bool(self.lacking)

    @property
    def lacking(self) -> frozenset[int]:
        """Keyframes of the former map that this one has not seen."""
        return frozenset() if self.legacy is None else self.legacy.frame_ids - self.seen

    def losses(self) -> list[Loss]:
        """Keyframes refused, those left out that were fused later."""
        losses = Losses()
        for frame_id, reason in list(self.refused.items()):
            if frame_id not in self.cameras_m:
                losses.add("keyframes not mapped", reason, of=f"keyframe {frame_id}")
        return losses.told

    def follows_from(self, keyframe: Keyframe) -> None:
        """The next delta follows from this keyframe."""
        self.stamp_ns, self.frame_id = max(self.stamp_ns, keyframe.stamp_ns), keyframe.frame_id


def empty(robot: str, epoch: int, cfg: Config) -> State:
    """A map without observations."""
    graph = GroundGraph(cfg.ground_rules) if cfg.places == "2d" else PlaceGraph(cfg.graph_rules)
    grid = VoxelGrid(FIELDS if cfg.places == "3d" and cfg.coarseness == 1 else MEASURED)
    distances = VoxelGrid(DERIVED) if cfg.coarseness > 1 else grid
    openings = Openings(int(1.5 * cfg.cell_voxels))
    return State(robot, epoch, graph, DepthArchive(cfg.archive_mb * 1e6), openings, grid, distances)

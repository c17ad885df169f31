"""All that is known of one robot's map (pure)."""

from dataclasses import dataclass, field

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
from prior_sg.services.place_graph.core.volume.grid import VoxelGrid


@dataclass
class State:
    """Map and graph of one robot, and what its readers were told."""

    robot: str
    epoch: int
    graph: PlaceGraph
    archive: DepthArchive
    openings: Openings
    grid: VoxelGrid = field(default_factory=VoxelGrid)
    ledger: PlaceLedger = field(default_factory=PlaceLedger)
    trajectory: Trajectory = field(default_factory=Trajectory)
    cameras_m: dict[int, tuple[float, float, float]] = field(default_factory=dict)  # by frame id, of those fused
    seen: set[int] = field(default_factory=set)  # frame ids of all keyframes, also the refused
    corrections: PoseCorrections = field(default_factory=PoseCorrections)
    refused: dict[int, str] = field(default_factory=dict)  # why keyframes could not be used, by frame id
    joined_frame_id: int = 0  # first keyframe heard live; earlier ones come from the archive
    behind: bool = False  # earlier keyframes are still to come from the archive: readers keep what they have
    unanswered: int = 0  # keyframes heard live since the archive answered last, while behind
    revision: int = -1
    stamp_ns: int = 0
    frame_id: int = -1
    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of the world, as the newest keyframe says

    def losses(self) -> list[Loss]:
        """Keyframes refused, those left out that were fused later."""
        losses = Losses()
        for frame_id, reason in list(self.refused.items()):
            if frame_id not in self.cameras_m:
                losses.add("keyframes not mapped", reason, of=f"keyframe {frame_id}")
        return losses.told

    def heard(self, keyframe: Keyframe) -> None:
        """The next delta follows from this keyframe."""
        self.stamp_ns, self.frame_id = max(self.stamp_ns, keyframe.stamp_ns), keyframe.frame_id
        self.seen.add(keyframe.frame_id)


def empty(robot: str, epoch: int, cfg: Config) -> State:
    """A map without observations."""
    graph = GroundGraph(cfg.ground_rules) if cfg.places == "2d" else PlaceGraph(cfg.graph_rules)
    return State(robot, epoch, graph, DepthArchive(cfg.archive_mb * 1e6), Openings(int(1.5 * cfg.cell_voxels)))

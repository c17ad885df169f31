"""Everything the segmenter remembers, in parts with one owner each (pure)."""

from dataclasses import dataclass, field

from prior_sg.schemas.priors import Task
from prior_sg.services.deltas import PoseCorrections
from prior_sg.services.intent import Intent
from prior_sg.services.segmenter.core.aim import Aim
from prior_sg.services.segmenter.core.config import Config
from prior_sg.services.segmenter.core.energy.mrf import KeptTerms
from prior_sg.services.segmenter.core.energy.solver import Solver
from prior_sg.services.segmenter.core.evidence.handover import Spaces
from prior_sg.services.segmenter.core.evidence.seen import Seen
from prior_sg.services.segmenter.core.labelling import Labelling
from prior_sg.services.segmenter.core.layers.layer_map import LayerMap
from prior_sg.services.segmenter.core.map.place_map import PlaceMap
from prior_sg.services.segmenter.core.objects.markers import MarkerMap
from prior_sg.services.segmenter.core.objects.object_map import ObjectMap
from prior_sg.services.segmenter.core.objects.tracks import Tracks
from prior_sg.services.segmenter.core.prior_report import PriorReport
from prior_sg.services.segmenter.core.regions.region_map import RegionMap
from prior_sg.services.segmenter.core.succession import CatchingUp


@dataclass
class State:
    """Everything the segmenter remembers. Each part is written by its own methods and by whom its masks address."""

    robot: str
    epoch: int
    aim: Aim
    seen: Seen
    objects: ObjectMap
    labelling: Labelling
    markers: MarkerMap = field(default_factory=MarkerMap)
    map: PlaceMap = field(default_factory=PlaceMap)
    regions: RegionMap = field(default_factory=RegionMap)
    layers: LayerMap = field(default_factory=LayerMap)
    corrections: PoseCorrections = field(default_factory=PoseCorrections)
    report: PriorReport = field(default_factory=PriorReport)
    catching_up: CatchingUp = field(default_factory=CatchingUp)
    terms: KeptTerms = field(default_factory=KeptTerms)  # of the energy that was told last
    stamp_ns: int = 0  # of the newest place delta, pyramid or detections

    @property
    def task(self) -> Task | None:
        """The task in force."""
        return self.aim.task

    def heard(self, stamp_ns: int) -> None:
        """Something that was taken in at this time."""
        self.stamp_ns = max(self.stamp_ns, stamp_ns)


def empty(cfg: Config, robot: str, epoch: int) -> State:
    """The state before the first message."""
    return State(
        robot,
        epoch,
        aim=Aim(robot, Intent(cfg.remembered_priors)),
        seen=Seen(Spaces(cfg.space), cfg.default_query_radius_m),
        objects=ObjectMap(Tracks(cfg.space)),
        labelling=Labelling(Solver(cfg.solver)),
    )

"""Settings of the segmenter (pure)."""

import msgspec

from prior_sg.schemas.codec import Positive
from prior_sg.schemas.features import DEFAULT_SPACE
from prior_sg.services.segmenter.core.appearance.adaptation import AdaptationConfig
from prior_sg.services.segmenter.core.appearance.information import InformationConfig
from prior_sg.services.segmenter.core.appearance.label_bias import BalanceConfig
from prior_sg.services.segmenter.core.appearance.smoothing import SharingConfig
from prior_sg.services.segmenter.core.appearance.unmixing import UnmixingConfig
from prior_sg.services.segmenter.core.energy.solver import Settings
from prior_sg.services.segmenter.core.evidence.handover import SpacesConfig
from prior_sg.services.segmenter.core.evidence.kernel import KernelConfig
from prior_sg.services.segmenter.core.experts import REGISTRY
from prior_sg.services.segmenter.core.experts.context import ObjectSettings
from prior_sg.services.segmenter.core.foresight.config import ForesightConfig
from prior_sg.services.segmenter.core.layers.stacking import LayersConfig
from prior_sg.services.segmenter.core.map.inclination import GeometryConfig
from prior_sg.services.segmenter.core.objects.markers import MarkerConfig
from prior_sg.services.segmenter.core.objects.sizes import SizeConfig
from prior_sg.services.segmenter.core.objects.track import TrackingConfig


class AdjacencyConfig(msgspec.Struct, frozen=True, kw_only=True):
    """How a prior's adjacency becomes the cost of a border.

    The paper's -log P(ri <-> rj) makes borders free where the prior is sure that two regions touch, so that a better
    prior cuts the map to pieces. Here P counts against chance, the prior's own mean of log P: a border costs `border`,
    less between regions likelier to touch than others, more between unlikelier ones.
    """

    border: float = 1.5  # of a border about which the prior says nothing; 0 = -log P itself (paper)
    trust: float = 0.5  # in the prior's logarithmic odds against chance
    least: float = 0.5
    most: float = 4.0

    def __post_init__(self) -> None:
        if not (self.border >= 0 and self.trust >= 0 and 0 <= self.least <= self.most):
            raise ValueError("border, trust, least or most is out of range")


class Config(msgspec.Struct, frozen=True, kw_only=True):
    """Settings of the segmenter. Those marked (paper) are published values; the others were chosen here."""

    space: str = DEFAULT_SPACE  # embedding space at the start; another may take over
    spaces: SpacesConfig = msgspec.field(default_factory=SpacesConfig)
    kernel: KernelConfig = msgspec.field(default_factory=KernelConfig)
    default_query_radius_m: float = 0.75  # r_Q until a prior is in force (paper)
    evidence_mb: float = 512.0  # pyramids kept of each space, for places that are new or move; of the view that most
    # frames have, the oldest goes first
    experts: dict[str, float] = msgspec.field(  # names, with their reliabilities lambda (paper)
        default_factory=lambda: {"visual": 4.0, "geometric": 1.0, "object": 1.0, "environment": 0.1, "contents": 2.5}
    )
    geometry: GeometryConfig = msgspec.field(default_factory=GeometryConfig)
    objects: ObjectSettings = msgspec.field(default_factory=ObjectSettings)
    tracking: TrackingConfig = msgspec.field(default_factory=TrackingConfig)
    markers: MarkerConfig = msgspec.field(default_factory=MarkerConfig)
    sizes: SizeConfig = msgspec.field(default_factory=SizeConfig)
    beta: float = 2.0  # weight of the pairwise term (paper)
    adjacency: AdjacencyConfig = msgspec.field(default_factory=AdjacencyConfig)  # beyond the paper
    edge_decay_m: float = 2.0  # w_dist = exp(-length / edge_decay_m)
    edge_sum: float = 3.0  # sum of w_dist at a place, whatever the graph's density and scale; 0 = w_dist as it is
    solver: Settings = msgspec.field(default_factory=Settings)
    budget_ms: float = 40.0  # of solving per keyframe; the rest is done when idle. 0 = as long as it takes
    look_ms: Positive = 2.0  # of solving between two looks at the budget, see Budget
    edge_clearance_m: float = (
        0.8  # w_dist times min(clearance / edge_clearance_m, 1): half of it in a usual door; 0 = off
    )
    probability_floor: float = 1e-6  # least probability in a logarithm, so that every cost is finite
    object_phrases: int = 2  # objects whose phrases join a region's concept, the most discriminative first
    sharing: SharingConfig = msgspec.field(default_factory=SharingConfig)  # beyond the paper
    information: InformationConfig = msgspec.field(default_factory=InformationConfig)  # beyond the paper
    unmixing: UnmixingConfig = msgspec.field(default_factory=UnmixingConfig)  # beyond the paper
    region_cost: float = 20.0  # of each region, in the energy's unit; 0 = none (paper)
    layers: LayersConfig = msgspec.field(default_factory=LayersConfig)  # beyond the paper
    balance: BalanceConfig = msgspec.field(default_factory=BalanceConfig)  # beyond the paper
    adaptation: AdaptationConfig = msgspec.field(default_factory=AdaptationConfig)  # beyond the paper
    temperature: float = 3.0  # of the posteriors, see prior_sg.services.segmenter.core.energy.posteriors
    informed: float = 0.2  # what crops must tell of the labels for that; where they tell half, it doubles. 0 = always
    trust_half: float = 0.5  # sum of trust at which half of the unknown mass is left
    predicted_trust: float = 1.0  # sum of trust below which a place counts as predicted; one close look gives about 2
    door_clearance_m: float = 0.7  # a way between regions with at most this clearance is a door
    posterior_change: float = 0.01  # smaller changes of a belief are not sent
    footprint_cell_m: Positive = 0.1  # grid of the regions' areas
    foresight: ForesightConfig = msgspec.field(default_factory=ForesightConfig)  # beyond the paper
    evidence_ticks: int = 40  # ticks between two reports of what the map shows of its prior; 0 = none
    evidence_places: int = 5  # a region of fewer places is not counted there: most are mistakes
    catch_up_ticks: int = 20  # ticks without progress after which a successor of a dead process tells what it has
    prior_wait_ticks: int = 4  # ticks to wait for a task's prior before asking for it
    remembered_priors: int = 4  # priors kept that no task has asked for yet

    def __post_init__(self) -> None:
        unknown = sorted(set(self.experts) - set(REGISTRY))
        if unknown:
            raise ValueError(f"no such expert: {', '.join(unknown)}; there are {', '.join(sorted(REGISTRY))}")
        if not self.evidence_mb > 0:
            raise ValueError("evidence_mb must be positive")
        if not (self.beta >= 0 and self.edge_decay_m > 0 and self.edge_sum >= 0 and self.region_cost >= 0):
            raise ValueError("beta, edge_decay_m, edge_sum or region_cost is out of range")
        if not (0 < self.probability_floor < 1 and self.trust_half > 0 and self.temperature > 0):
            raise ValueError("probability_floor, trust_half or temperature is out of range")

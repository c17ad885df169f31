"""What is expected beyond what a robot has seen: openings, the regions behind them, and what is missing."""

from prior_sg.schemas.codec import Part

Point = tuple[float, float, float]  # world, metres
REACH_M = 6.0  # of way behind an opening that `within` tells of
ROUNDING = 1e-3  # by which a chance may miss 0 and 1
LONGEST_M = 1e9  # of a way


def _check_chances(**chances: float) -> None:
    for name, chance in chances.items():
        if not -ROUNDING <= chance <= 1 + ROUNDING:
            raise ValueError(f"{name}: {chance:g} is no probability")


def _check_metres(**lengths_m: float) -> None:
    for name, length_m in lengths_m.items():
        if not 0 <= length_m <= LONGEST_M:
            raise ValueError(f"{name}: {length_m:g} is no length of a way")


class ForeseenLabel(Part, frozen=True, kw_only=True):
    """One label that a region behind an opening may have, and why."""

    label: str
    next: float  # probability that the very next region behind the opening is another one, with this label
    within: float  # that such a region begins within REACH_M behind the opening
    toward: float = 0.0  # that the nearest such region, if one is left, is come to through it; 0 throughout = not told
    adjacency: float = 0.0  # why: P(ri <-> rj) of the prior with the label of the region that the opening belongs to
    existence: float = 0.0  # P(r | E0)
    found: int = 0  # regions of this label that the map holds
    met: int = 0  # borders in the map between regions of these two labels

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_chances(next=self.next, within=self.within, toward=self.toward)


class Opening(Part, frozen=True, kw_only=True):
    """Frontiers of neighbouring places that lead to the same unobserved space, and what lies behind."""

    place_id: int  # the place with the largest frontier
    position_m: Point  # of its centre
    beyond_m: Point  # a point in the unobserved space
    width_m: float
    region: int  # that it opens from
    same: float  # probability that this region goes on behind it, or nothing is; with all `next` it sums to one
    labels: list[ForeseenLabel] = []  # the most probable first; others left out

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_chances(same=self.same)
        _check_metres(width_m=self.width_m)


class MissingLabel(Part, frozen=True, kw_only=True):
    """A label that is probably still to be found behind the openings."""

    label: str
    probability: float  # that one more region of it is behind any opening
    found: int = 0  # regions of it that the map holds

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_chances(probability=self.probability)


class Foresight(Part, frozen=True, kw_only=True):
    """All that is foreseen of one map: nodes that are predictions."""

    openings: list[Opening] = []
    missing: list[MissingLabel] = []  # the most probable first
    steps: int = 0  # regions behind an opening that `within` reached before REACH_M was its limit; 0 since
    look_m: float = 0.0  # what is walked behind an opening to see what is there
    elsewhere_m: float = 0.0  # what is walked to find what is behind none of the openings

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_metres(look_m=self.look_m, elsewhere_m=self.elsewhere_m)

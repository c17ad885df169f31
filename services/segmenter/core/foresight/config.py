"""Settings of foresight (pure)."""

import msgspec

from prior_sg.schemas.codec import Positive, Signed
from prior_sg.schemas.foresight import LONGEST_M


class ForesightConfig(msgspec.Struct, frozen=True, kw_only=True):
    """How openings, adjacency, existence and what was found make a distribution. Weights are those of logistic models,
    fitted on generated worlds (`deploy/evaluation/foresight/fitting.py`)."""

    enabled: bool = True
    steep: float = 0.7  # openings whose direction rises or falls more (sine) lead to ceilings and floors
    aligned: Signed = 0.3  # least cosine between the directions of neighbouring places' frontiers of one opening
    opening_height_m: Positive = 2.0  # an opening's width is its area over this
    least_width_m: float = 0.4  # narrower openings are cracks
    most_openings: int = 64  # the widest are told
    fan_m: tuple[float, ...] = (0.3, 0.6, 1.0, 1.5, 2.0)  # of points looked at behind an opening's edge ...
    fan_rad: tuple[Signed, ...] = (-0.7, -0.35, 0.0, 0.35, 0.7)  # ... and how far they are turned from its direction
    covered_m: float = 0.3  # beside a place's sphere, what was not seen of its free space: corners
    beyond_m: float = 1.0  # how far beyond the edge of what was seen an expected region is put
    least_places: int = 3  # a region of fewer places does not count as found
    nearby_m: Positive = 4.0  # how far a region is felt around an opening: less by e at each so many metres
    border_m: Positive = 1.0  # the same of a way between two regions
    steepness: float = 3.0  # a metre of height keeps as far apart as so many along the floor
    storey_m: float = 1.5  # what lies higher or lower is on another storey

    # That there is unobserved floor behind an opening at all, and it is no gap or shadow: logit.
    leads_bias: Signed = -1.36
    leads_width: Signed = 0.77  # by log of the opening's width / m
    leads_rise: Signed = -4.32  # by how far its direction rises or falls (absolute sine)
    leads_unseen: Signed = 1.82  # by the share of a fan behind it that no place covers

    # That the same region goes on, where there is anything: logit by width of the opening, and by what was seen of it.
    widths_m: tuple[float, ...] = (0.6, 0.8, 1.1, 1.6, 2.5, 4.0)  # where the classes of width begin, after the first
    same_by_width: tuple[Signed, ...] = (0.09, -0.18, -0.15, 0.32, 0.16, 0.53, 0.47)
    same_by_area: Signed = 0.8  # by log(1 + seen area of the region / m2)
    same_by_spread: Signed = -1.0  # by log of the mean number of other regions that touch one of its label

    # Which other region: log-odds.
    adjacency: Signed = 0.33  # by log P(ri <-> rj)
    existence: Signed = 1.28  # by log P(r)
    again: Signed = -1.3  # another region of the very same label, in place of its adjacency with itself
    found_once: Signed = -0.87
    found_often: Signed = -0.25  # twice or more ...
    found_count: Signed = 0.37  # ... and by log of the number
    met: Signed = 0.47  # by log(1 + number of such borders in this map)

    # That a region of a label begins within REACH_M behind an opening: logit.
    within_bias: Signed = 2.19
    within_width: Signed = 0.36  # by log of the opening's width / m
    within_area: Signed = -0.2  # by log(1 + seen area of the region it opens from / m2)
    within_spread: Signed = 0.67  # by log of the mean number of other regions that touch one of its label
    within_openings: Signed = -0.13  # by log of how many openings of the map lead anywhere
    within_adjacency: Signed = 0.5  # by log P(ri <-> rj)
    within_existence: Signed = 1.27  # by log P(r)
    within_again: Signed = -2.6  # by the belief that the region it opens from has that label
    within_once: Signed = -0.9  # such a region has been found ...
    within_often: Signed = 0.13  # ... or several
    within_touching: Signed = 0.89  # by log(1 + regions that touch the one it opens from)
    within_nearby: Signed = -1.0  # by log(1 + other regions around it)
    within_storey: Signed = -0.41  # by log(1 + seen area of its storey / m2)
    within_at_border: Signed = -0.6  # by log P(ri <-> rj), as near as a way into another region is

    # That the nearest region of a label, if one is left, is come to through an opening, and no other one: log-odds.
    toward_within: Signed = 1.11  # by log of the chance that such a region begins within REACH_M
    toward_adjacency: Signed = 0.63  # by log P(ri <-> rj)
    toward_again: Signed = 0.73  # by the belief that the region it opens from has that label
    toward_border_adjacency: Signed = -0.01  # by log P(ri <-> rj), as near as a way into another region is
    toward_spread: Signed = -1.15  # by log of the mean number of other regions that touch one of its label
    toward_touching: Signed = 1.63  # by log(1 + regions that touch the one it opens from)
    toward_same: Signed = -0.2  # by the logit that the same region goes on
    toward_width: Signed = 0.53  # by log of the opening's width / m
    toward_area: Signed = -0.46  # by log(1 + seen area of the region it opens from / m2)
    toward_nearby: Signed = -0.52  # by log(1 + other regions around it)
    toward_storey: Signed = -0.52  # by log(1 + seen area of its storey / m2)
    toward_at_border: Signed = 0.43  # as near as a way into another region is

    # That one more region of a label is behind any of the openings: logit.
    missing_bias: Signed = 0.5
    missing_sum: Signed = 0.28  # by log of the sum of the chances of all openings
    missing_existence: Signed = 0.11  # by log P(r)
    missing_once: Signed = -1.05
    missing_often: Signed = -1.0

    look_m: float = 1.0  # walked behind an opening to see what is there
    elsewhere_m: float = 40.0  # to what lies behind none of the openings
    told_change: float = 0.05  # smaller changes of a probability are no news
    told_labels: int = 8  # of each opening, the most probable ...
    least_toward: float = 0.01  # ... and all that it leads to with so much at least: searches would pass it by
    least_told: float = 0.02  # of what is missing
    least_within: float = 0.001  # behind one opening: most lead nowhere, and the best of them is still where to look

    def __post_init__(self) -> None:
        for name in ("look_m", "elsewhere_m"):
            if not 0 <= getattr(self, name) <= LONGEST_M:
                raise ValueError(f"{name} must lie between 0 and {LONGEST_M:g} m")

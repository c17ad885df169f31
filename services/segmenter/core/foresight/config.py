"""Settings of foresight (pure)."""

import msgspec


class ForesightConfig(msgspec.Struct, frozen=True, kw_only=True):
    """How openings, adjacency, existence and what was found make a distribution. Weights are those of logistic models,
    fitted on generated worlds (`deploy/evaluation/foresight/fitting.py`)."""

    enabled: bool = True
    steep: float = 0.7  # openings whose direction rises or falls more (sine) lead to ceilings and floors
    aligned: float = 0.3  # least cosine between the directions of neighbouring places' frontiers of one opening
    opening_height_m: float = 2.0  # an opening's width is its area over this
    least_width_m: float = 0.4  # narrower openings are cracks
    most_openings: int = 64  # the widest are told
    fan_m: tuple[float, ...] = (0.3, 0.6, 1.0, 1.5, 2.0)  # of points looked at behind an opening's edge ...
    fan_rad: tuple[float, ...] = (-0.7, -0.35, 0.0, 0.35, 0.7)  # ... and how far they are turned from its direction
    covered_m: float = 0.3  # beside a place's sphere, what was not seen of its free space: corners
    beyond_m: float = 1.0  # how far beyond the edge of what was seen an expected region is put
    least_places: int = 3  # a region of fewer places does not count as found
    nearby_m: float = 4.0  # how far a region is felt around an opening: less by e at each so many metres
    border_m: float = 1.0  # the same of a way between two regions
    steepness: float = 3.0  # a metre of height keeps as far apart as so many along the floor
    storey_m: float = 1.5  # what lies higher or lower is on another storey

    # That there is unobserved floor behind an opening at all, and it is no gap or shadow: logit.
    leads_bias: float = -1.36
    leads_width: float = 0.77  # by log of the opening's width / m
    leads_rise: float = -4.32  # by how far its direction rises or falls (absolute sine)
    leads_unseen: float = 1.82  # by the share of a fan behind it that no place covers

    # That the same region goes on, where there is anything: logit by width of the opening, and by what was seen of it.
    widths_m: tuple[float, ...] = (0.6, 0.8, 1.1, 1.6, 2.5, 4.0)  # where the classes of width begin, after the first
    same_by_width: tuple[float, ...] = (0.09, -0.18, -0.15, 0.32, 0.16, 0.53, 0.47)
    same_by_area: float = 0.8  # by log(1 + seen area of the region / m2)
    same_by_spread: float = -1.0  # by log of the mean number of other regions that touch one of its label

    # Which other region: log-odds.
    adjacency: float = 0.33  # by log P(ri <-> rj)
    existence: float = 1.28  # by log P(r)
    again: float = -1.3  # another region of the very same label, in place of its adjacency with itself
    found_once: float = -0.87
    found_often: float = -0.25  # twice or more ...
    found_count: float = 0.37  # ... and by log of the number
    met: float = 0.47  # by log(1 + number of such borders in this map)

    # That a region of a label begins within REACH_M behind an opening: logit.
    within_bias: float = 2.19
    within_width: float = 0.36  # by log of the opening's width / m
    within_area: float = -0.2  # by log(1 + seen area of the region it opens from / m2)
    within_spread: float = 0.67  # by log of the mean number of other regions that touch one of its label
    within_openings: float = -0.13  # by log of how many openings of the map lead anywhere
    within_adjacency: float = 0.5  # by log P(ri <-> rj)
    within_existence: float = 1.27  # by log P(r)
    within_again: float = -2.6  # by the belief that the region it opens from has that label
    within_once: float = -0.9  # such a region has been found ...
    within_often: float = 0.13  # ... or several
    within_touching: float = 0.89  # by log(1 + regions that touch the one it opens from)
    within_nearby: float = -1.0  # by log(1 + other regions around it)
    within_storey: float = -0.41  # by log(1 + seen area of its storey / m2)
    within_at_border: float = -0.6  # by log P(ri <-> rj), as near as a way into another region is

    # That the nearest region of a label, if one is left, is come to through an opening, and no other one: log-odds.
    toward_within: float = 1.11  # by log of the chance that such a region begins within REACH_M
    toward_adjacency: float = 0.63  # by log P(ri <-> rj)
    toward_again: float = 0.73  # by the belief that the region it opens from has that label
    toward_border_adjacency: float = -0.01  # by log P(ri <-> rj), as near as a way into another region is
    toward_spread: float = -1.15  # by log of the mean number of other regions that touch one of its label
    toward_touching: float = 1.63  # by log(1 + regions that touch the one it opens from)
    toward_same: float = -0.2  # by the logit that the same region goes on
    toward_width: float = 0.53  # by log of the opening's width / m
    toward_area: float = -0.46  # by log(1 + seen area of the region it opens from / m2)
    toward_nearby: float = -0.52  # by log(1 + other regions around it)
    toward_storey: float = -0.52  # by log(1 + seen area of its storey / m2)
    toward_at_border: float = 0.43  # as near as a way into another region is

    # That one more region of a label is behind any of the openings: logit.
    missing_bias: float = 0.5
    missing_sum: float = 0.28  # by log of the sum of the chances of all openings
    missing_existence: float = 0.11  # by log P(r)
    missing_once: float = -1.05
    missing_often: float = -1.0

    look_m: float = 1.0  # walked behind an opening to see what is there
    elsewhere_m: float = 40.0  # to what lies behind none of the openings
    told_change: float = 0.05  # smaller changes of a probability are no news
    told_labels: int = 8  # of each opening, the most probable ...
    least_toward: float = 0.01  # ... and all that it leads to with so much at least: searches would pass it by
    least_told: float = 0.02  # of what is missing
    least_within: float = 0.001  # behind one opening: most lead nowhere, and the best of them is still where to look

"""Settings of foresight (pure)."""

import msgspec


class ForesightConfig(msgspec.Struct, frozen=True, kw_only=True):
    """How openings, adjacency, existence and what was found make a distribution. Weights are those of a logistic model,
    fitted on 35 generated worlds of all kinds, seeds 0 to 3."""

    enabled: bool = True
    steep: float = 0.7  # openings whose direction rises or falls more (sine) lead to ceilings and floors
    aligned: float = 0.3  # least cosine between the directions of neighbouring places' frontiers of one opening
    opening_height_m: float = 2.0  # an opening's width is its area over this
    least_width_m: float = 0.4  # narrower openings are cracks
    most_openings: int = 64  # the widest are told
    beyond_m: float = 1.0  # how far beyond the edge of what was seen an expected region is put
    least_places: int = 3  # a region of fewer places does not count as found

    # That the same region goes on: logit by width of the opening, and by what was seen of the region.
    widths_m: tuple[float, ...] = (0.6, 0.8, 1.1, 1.6, 2.5, 4.0)  # where the classes of width begin, after the first
    same_by_width: tuple[float, ...] = (0.18, -0.01, -0.3, 0.21, 0.24, 0.39, 0.54)
    same_by_area: float = 0.73  # by log(1 + seen area of the region / m2)
    same_by_spread: float = -0.79  # by log of the mean number of other regions that touch one of its label

    # Which other region: log-odds.
    adjacency: float = 0.29  # by log P(ri <-> rj)
    existence: float = 1.26  # by log P(r)
    again: float = -1.47  # another region of the very same label, in place of its adjacency with itself
    found_once: float = -0.92
    found_often: float = -0.24  # twice or more ...
    found_count: float = 0.47  # ... and by log of the number
    met: float = 0.57  # by log(1 + number of such borders in this map)

    steps: int = 3  # regions ahead
    onward: float = 0.6  # chance that a region beyond leads on, times how many of the others are likely to touch it
    look_m: float = 1.0  # walked behind an opening to see what is there
    elsewhere_m: float = 40.0  # to what lies behind none of the openings
    told_change: float = 0.05  # smaller changes of a probability are no news
    told_labels: int = 8  # of each opening, the most probable
    least_told: float = 0.02

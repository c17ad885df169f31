"""How maps are matched and merged (pure)."""

import msgspec


class MatchConfig(msgspec.Struct, frozen=True, kw_only=True):
    """When two maps are taken to show the same place. Chosen on generated homes 0-29."""

    most_pairs: int = 320  # of landmarks that may be the same
    least_alike: float = -0.3  # log-likelihood ratio below which two landmarks are no pair
    tolerance_m: float = 0.4  # by which a distance between landmarks may differ in two maps
    tolerance_share: float = 0.02  # of that distance, beside
    height_m: float = 0.4  # by which a difference of heights may differ
    window_rad: float = 0.3  # headings are tried in windows of twice this
    hypotheses: int = 8  # that are looked at
    refined: int = 3  # of them, that are fitted to the other map and verified
    distinct_m: float = 1.0  # hypotheses closer than this in metres
    distinct_rad: float = 0.2  # and in heading are one

    least_places: int = 12  # in each map
    overlap_least_m2: float = 8.0  # of floor that both have seen
    walls_least: int = 110  # points of walls that both have
    fitting_least: float = 0.55  # share of the walls that both can tell of and both have
    landmarks_least: int = 3  # objects that agree
    evidence_least: float = 8.0  # log-likelihood ratio of all that was found, against chance
    markers: bool = True  # whether printed markers that both maps show are followed
    markers_m: float = 0.3  # by which shared markers may lie apart
    markers_rad: float = 0.35  # or be turned to each other
    markers_walls_least: int = 20  # points of walls from which on walls may contradict markers
    rival_most: float = 0.6  # of the best one's evidence that a second hypothesis may have

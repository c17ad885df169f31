"""Which opening to look behind first when something is searched for (pure).

One goes where the chance to find it is largest for each metre walked. What a whole search then takes is told as well:
whoever looks for a thing walks to an opening, looks behind it, and finds it there with some chance; if not, goes on to
the next. The expected way of an order of openings is a sum over its legs, each times the chance that nothing was found
before. The order after the first is greedy: always the least metres by chance.
"""

import numpy as np

STOPS = 8  # openings after the first that are thought of
DETOUR = 1.4  # a way between openings over the straight line
LEAST_CHANCE = 1e-4
LEAST_M = 0.01  # of a way by which a chance is divided: nobody stands nearer, even where no look is paid for


def expected_metres(
    distances_m: np.ndarray,
    points_m: np.ndarray,
    chances: np.ndarray,
    look_m: float,
    elsewhere_m: float,
    *,
    firsts: np.ndarray | None = None,
) -> np.ndarray:
    """Expected metres (first,) until the thing is found, if that one of the openings comes first; of all where no
    `firsts` (first,) are named. The cost is by firsts and openings, the memory by openings.

    `distances_m` (opening,) is the way to each, inf = there is none; `points_m` (opening, 3) where they are; `chances`
    (opening,) that it is behind. `look_m` is walked behind each opening; `elsewhere_m` when it is behind none of the
    openings thought of.
    """
    chances = np.clip(chances, LEAST_CHANCE, 1.0)
    firsts = np.arange(len(chances)) if firsts is None else firsts
    found = np.full(len(firsts), np.inf)
    for row in np.flatnonzero(np.isfinite(distances_m[firsts])).tolist():
        first = int(firsts[row])
        way_m = float(distances_m[first])
        found[row] = _in_order(first, way_m, points_m, chances, look_m=look_m, elsewhere_m=elsewhere_m)
    return found


def chances_per_metre(distances_m: np.ndarray, chances: np.ndarray, look_m: float) -> np.ndarray:
    """What to choose an opening by (opening,), largest first: its chance over the metres to it and `look_m` behind it.
    Best is the chance that it leads to the thing at all, however deep (`ForeseenLabel.toward`).

    To think further ahead, by the expected metres of whole orders, made searches of generated worlds no shorter
    (docs/evaluation.md).
    """
    return np.asarray(np.maximum(chances, LEAST_CHANCE) / np.maximum(distances_m + look_m, LEAST_M))


def _in_order(
    here: int, way_m: float, points_m: np.ndarray, chances: np.ndarray, *, look_m: float, elsewhere_m: float
) -> float:
    """Expected metres of one order of openings, which begins at `here`."""
    waiting = np.ones(len(chances), dtype=bool)
    total_m, missed = way_m + look_m, 1.0 - float(chances[here])
    waiting[here] = False
    for _ in range(min(STOPS, len(chances) - 1)):
        off_m = DETOUR * np.linalg.norm(points_m - points_m[here], axis=1)
        price = np.where(waiting, (off_m + look_m) / chances, np.inf)
        there = int(price.argmin())
        total_m += missed * (float(off_m[there]) + look_m)
        missed *= 1.0 - float(chances[there])
        waiting[there] = False
        here = there
    return total_m + missed * elsewhere_m

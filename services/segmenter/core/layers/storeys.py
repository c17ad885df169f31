"""Storeys from the geometry of places, and regions that end where a storey does (pure).

A place's free space ends at its centre's height less its radius. In a storey most of these bottoms, weighted by the
ground that the places cover, lie on its floor: furniture, corners and ceilings spread a little upwards, stairs evenly
from one floor to the next. So floors are modes of the bottoms, far enough from each other, with a valley between them:
on a slope, where no height stands out, there is one storey. A place is in the highest storey whose floor lies below its
bottom.
"""

from typing import NamedTuple

import msgspec
import numpy as np

from prior_sg.services.compiled import compiled
from prior_sg.services.segmenter.core.map.received import ReceivedGraph
from prior_sg.services.segmenter.core.regions.components import numbered

CELL_M = 0.1  # of the profile of heights
SMOOTH_M = 0.2  # standard deviation over which it is smoothed
LARGEST_M = 2.0  # radius up to which the ground that a place covers counts
MOST_CELLS = 20_000  # of the profile: heights beyond are taken for mistakes of a map, which is then one storey


class StoreyConfig(msgspec.Struct, frozen=True, kw_only=True):
    """What counts as a storey."""

    least_height_m: float = 2.2  # from floor to floor
    least_m2: float = 30.0  # of places' discs on a floor
    least_share: float = 0.15  # of the most on any floor: treetops and roofs are no storeys
    part_m2: float = 6.0  # the same of a region's part on one storey, where it is torn
    valley: float = 0.5  # density between two floors at most, of that at the lesser one
    tolerance_m: float = 0.3  # a bottom so far below a floor is still on it
    clutter_m: float = 0.8  # bottoms up to so far above a floor are on it
    stairs: float = 0.25  # share of a region between floors from which on it is stairs, which span storeys

    def __post_init__(self) -> None:
        if min(self.least_height_m, self.least_m2, self.part_m2, self.tolerance_m) <= 0 or self.valley < 0:
            raise ValueError("a height or an area is not positive, or valley negative")
        if not (0 < self.stairs <= 1 and 0 <= self.least_share < 1):
            raise ValueError("stairs is not in (0, 1], or least_share not in [0, 1)")
        if self.tolerance_m + self.clutter_m >= self.least_height_m or self.clutter_m < 0:
            raise ValueError("tolerance_m and clutter_m leave nothing between two floors")


class Storeys(NamedTuple):
    """Where the floors are, and which place is on which."""

    floors_m: np.ndarray  # (storey,) heights, ascending; at least one where there are places
    of_place: np.ndarray  # (place,) storey
    grounded: np.ndarray  # (place,) on the storey's floor or what stands there
    between: np.ndarray  # (place,) between two floors
    weights_m2: np.ndarray  # (place,) ground that it covers

    def at(self, rows: np.ndarray) -> "Storeys":
        """The same floors, and the places `rows` alone."""
        return Storeys(self.floors_m, *(column[rows] for column in self[1:]))


def storeys_of(graph: ReceivedGraph, cfg: StoreyConfig) -> Storeys:
    """The storeys of a map."""
    bottoms_m, weights_m2 = _bottoms(graph.positions_m, graph.radii_m, graph.on_ground)
    floors_m = floors_of(bottoms_m, weights_m2, cfg)
    storey, grounded, between = _standing(bottoms_m, floors_m, cfg.tolerance_m, cfg.clutter_m)
    return Storeys(floors_m, storey, grounded, between, weights_m2)


def floors_differ(one_m: np.ndarray, other_m: np.ndarray) -> bool:
    """Whether two maps, of which one has several storeys, have floors at other heights."""
    return max(len(one_m), len(other_m)) > 1 and not np.array_equal(one_m, other_m)


@compiled()
def _bottoms(positions_m, radii_m, on_ground):  # noqa: ANN001, ANN202
    """Where the free space of each place ends, and the ground that it covers."""
    bottoms_m, weights_m2 = np.empty(len(radii_m)), np.empty(len(radii_m))
    for place in range(len(radii_m)):
        bottoms_m[place] = positions_m[place, 2] - (0.0 if on_ground else radii_m[place])
        radius_m = min(radii_m[place], LARGEST_M)
        weights_m2[place] = np.pi * (radius_m * radius_m)
    return bottoms_m, weights_m2


@compiled()
def _standing(bottoms_m, floors_m, tolerance_m, clutter_m):  # noqa: ANN001, ANN202
    """Storey (place,), the highest whose floor lies below, and whether the place is on its floor, or above that and
    below the next."""
    storey = np.zeros(len(bottoms_m), np.int64)
    grounded, between = np.empty(len(bottoms_m), np.bool_), np.empty(len(bottoms_m), np.bool_)
    for place in range(len(bottoms_m)):
        reach_m = bottoms_m[place] + tolerance_m
        while storey[place] + 1 < len(floors_m) and floors_m[storey[place] + 1] <= reach_m:
            storey[place] += 1
        grounded[place] = bottoms_m[place] - floors_m[storey[place]] <= clutter_m
        between[place] = not grounded[place] and storey[place] < len(floors_m) - 1
    return storey, grounded, between


def floors_of(bottoms_m: np.ndarray, weights_m2: np.ndarray, cfg: StoreyConfig) -> np.ndarray:
    """Heights (storey,) of the floors, ascending; the lowest mode alone where none other qualifies."""
    if not len(bottoms_m):
        return np.zeros(0)
    low_m, high_m = float(bottoms_m.min()), float(bottoms_m.max())
    if not high_m - low_m < MOST_CELLS * CELL_M:
        return np.array([low_m])
    profile = _profile(bottoms_m, low_m, weights_m2, round((high_m - low_m) / CELL_M) + 1)
    padded = np.concatenate(([-1.0], profile, [-1.0]))
    modes = np.flatnonzero((padded[1:-1] > padded[:-2]) & (padded[1:-1] >= padded[2:]))
    apart = cfg.least_height_m / CELL_M
    floors, most_m2 = list[int](), 0.0
    for mode in modes[np.argsort(-profile[modes], kind="stable")].tolist():
        reach = slice(max(mode - round(cfg.tolerance_m / CELL_M), 0), mode + round(cfg.clutter_m / CELL_M) + 1)
        ground_m2 = float(profile[reach].sum()) * CELL_M
        distant = all(abs(mode - floor) >= apart for floor in floors)
        enough = ground_m2 >= max(cfg.least_m2, cfg.least_share * most_m2)
        if not floors or (distant and enough and _valleys(profile, mode, floors, cfg)):
            floors.append(mode)
            most_m2 = max(most_m2, ground_m2)
    return low_m + CELL_M * np.array(sorted(floors))


def _profile(bottoms_m: np.ndarray, low_m: float, weights_m2: np.ndarray, cells: int) -> np.ndarray:
    """Density (cell,) of the ground by its height over the lowest, m2 per m, smoothed."""
    counts = _by_height(bottoms_m, low_m, weights_m2, cells) / CELL_M
    reach = round(3 * SMOOTH_M / CELL_M)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) * CELL_M / SMOOTH_M) ** 2)
    return np.convolve(counts, kernel / kernel.sum())[reach : reach + len(counts)]


@compiled()
def _by_height(bottoms_m, low_m, weights_m2, cells):  # noqa: ANN001, ANN202
    counts, cell, sum_m2 = np.zeros(cells), 0, 0.0  # neighbours in the order of ids mostly share a cell
    for place in range(len(bottoms_m)):
        at = int(np.rint((bottoms_m[place] - low_m) / CELL_M))
        if at != cell:
            counts[cell], cell, sum_m2 = sum_m2, at, counts[at]
        sum_m2 += weights_m2[place]
    counts[cell] = sum_m2
    return counts


def _valleys(profile: np.ndarray, mode: int, floors: list[int], cfg: StoreyConfig) -> bool:
    """Whether the profile falls low enough between a mode and the floors below and above it."""
    beside = [*sorted(floor for floor in floors if floor < mode)[-1:], *sorted(f for f in floors if f > mode)[:1]]
    spans = [slice(min(mode, floor), max(mode, floor) + 1) for floor in beside]
    return all(profile[span].min() <= cfg.valley * profile[mode] for span in spans)


def split(component: np.ndarray, edges: np.ndarray, storeys: Storeys, cfg: StoreyConfig) -> np.ndarray:
    """Component number (place,) as from `numbered`, of parts none of which spans storeys unless it is stairs.

    A component spans the storeys on whose floors it has ground of its own; what is above one of these belongs to it.
    """
    count = len(storeys.floors_m)
    if count < 2 or not len(component):
        return component
    number = component * count + storeys.of_place
    size = (int(component.max()) + 1) * count
    weights = storeys.weights_m2
    ground_m2 = np.bincount(number, weights * storeys.grounded, minlength=size).reshape(-1, count)
    own = ground_m2 >= cfg.part_m2
    whole_m2, between_m2 = (
        np.bincount(component, weights * mask, minlength=len(own)) for mask in (True, storeys.between)
    )
    stairs = between_m2 >= cfg.stairs * whole_m2
    torn = (own.sum(axis=1) > 1) & ~stairs
    if not torn.any():
        return component
    below = np.where(own, np.arange(count), -1)
    standing = np.maximum.accumulate(below, axis=1)  # (component, storey) the one to which what is there belongs
    standing = np.where(standing < 0, own.argmax(axis=1)[:, None], standing)
    part = np.where(torn[component], standing[component, storeys.of_place], 0)
    return numbered(component * count + part, edges)

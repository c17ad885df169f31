"""What the box of an object says of what it is (beyond the paper; pure).

The prior says how large its objects usually are and how high above the floor they begin. The logarithm of a measured
horizontal side is normal around that of the usual one; the heights of the lower and of the upper edge above the floor
are normal. Each is wider on the side to which an error is likelier: a thing is seen in part, something hides its lower
edge, something stands on it. A share of each measure is uniform, so that one misfit does not decide, and so is all of
it for what is none of the prior's objects:

    log P(box | c) / P(box | anything) = sum over the measures m of log((1 - misfit) N_c(m) / U(m) + misfit)

Where no floor is known, the height is a side like the others.
"""

from collections.abc import Sequence
from typing import NamedTuple

import msgspec
import numpy as np
import scipy

from prior_sg.schemas.priors import ObjectPrior
from prior_sg.services.segmenter.core.map.received import ReceivedGraph
from prior_sg.services.segmenter.core.objects.cells import unpacked
from prior_sg.services.segmenter.core.objects.track import Track, TrackingConfig

ANGLES = np.radians(np.arange(0, 90, 5))  # directions tried for the sides of a rotated thing


class SizeConfig(msgspec.Struct, frozen=True, kw_only=True):
    """How loudly boxes speak; reasoned, `weight` and `skew` settled after a look at `aws_small_house`."""

    weight: float = 0.5  # of a box's log-likelihood, for its measures err together; 0 = boxes say nothing
    misfit: float = 0.1  # share of measures that say nothing: merged, cut, or of an unusual kind
    skew: float = 1.5  # how much wider a spread is on the side of the likelier error
    side_m: tuple[float, float] = (0.15, 6.0)  # sides of anything lie in here, as likely at any scale
    reach_m: float = 2.5  # edges of anything lie in here above the floor
    bottom_spread_m: float = 0.15  # standard deviation of the lower edge of what stands on the floor
    hung_spread: float = 0.2  # of an edge for each metre that the thing hangs above the floor, up to one
    height_spread: float = 0.5  # of a height against that of the other sides: tables and doors are made for people
    floor_steps: int = 3  # edges of the place graph over which the floor of a place is looked for

    def __post_init__(self) -> None:
        if not (0 <= self.misfit < 1 and self.skew >= 1 and self.weight >= 0 and self.floor_steps >= 0):
            raise ValueError("misfit must lie in [0, 1), skew be at least 1, weight and floor_steps at least 0")
        if not (0 < self.side_m[0] < self.side_m[1] and self.reach_m > 0 and self.bottom_spread_m > 0):
            raise ValueError("side_m must grow from above 0; reach_m and bottom_spread_m must be positive")
        if not (self.hung_spread >= 0 and self.height_spread > 0):
            raise ValueError("hung_spread must not be negative, and height_spread be positive")


class Boxes(NamedTuple):
    """Measures of some objects, and the grid that they are measured on: they reach about half a cell too far."""

    sides_m: np.ndarray  # (object, 3) longest and shortest horizontal side, height
    bottoms_m: np.ndarray  # (object,) height of the lower edge above the floor; NaN = no floor is known
    cell_m: float


def measured(tracks: Sequence[Track], tracking: TrackingConfig, graph: ReceivedGraph, cfg: SizeConfig) -> Boxes:
    """The boxes of some objects above the floor that the places nearby show."""
    cell_m = tracking.cell_m
    numbers = [unpacked(track.firm(tracking.box_share)) for track in tracks]
    centres_m = np.array([(cells.min(axis=0) + cells.max(axis=0) + 1) / 2 for cells in numbers]) * cell_m
    lows_m = np.array([cells[:, 2].min() for cells in numbers]) * cell_m
    sides_m = np.array([sides(cells) for cells in numbers]) * cell_m
    floors_m = floor_below(centres_m, graph, cfg.floor_steps)  # or lower: nothing reaches below the floor
    return Boxes(sides_m, np.maximum(lows_m - floors_m, 0.0), cell_m)


def sides(cells: np.ndarray) -> np.ndarray:
    """Longest and shortest horizontal side and height (3,), in cells, of the upright box of least area around `cells`
    (cell, 3); it may be turned about the vertical."""
    height = np.ptp(cells[:, 2]) + 1
    cos, sin = np.cos(ANGLES), np.sin(ANGLES)
    along, across = cells[:, :2] @ np.stack((cos, sin)), cells[:, :2] @ np.stack((-sin, cos))
    extents = np.stack((np.ptp(along, axis=0), np.ptp(across, axis=0))) + 1
    longest, shortest = extents[:, np.prod(extents, axis=0).argmin()].tolist()
    return np.array((max(longest, shortest), min(longest, shortest), height))


def floor_below(points_m: np.ndarray, graph: ReceivedGraph, steps: int) -> np.ndarray:
    """Height (point,) of the floor at the place nearest to each point; NaN where there are no places.

    The free sphere of a place ends at or above the floor; of some place nearby it rests on it. The lowest sphere within
    `steps` edges therefore tells the floor, of the own storey and not of one that lies below it. 2D places lie on it.
    """
    if not len(graph.ids):
        return np.full(len(points_m), np.nan)
    floors_m = graph.positions_m[:, 2] - (0.0 if graph.on_ground else graph.radii_m)
    for _ in range(steps):
        around_m = floors_m.copy()
        for one, other in ((0, 1), (1, 0)):
            np.minimum.at(around_m, graph.edges[:, one], floors_m[graph.edges[:, other]])
        floors_m = around_m
    return floors_m[scipy.spatial.cKDTree(graph.positions_m).query(points_m)[1]]


def log_ratios(boxes: Boxes, objects: Sequence[ObjectPrior], cfg: SizeConfig) -> np.ndarray:
    """log P(box | object of the prior) / P(box | anything), (box, object); 0 where the prior knows no size."""
    usual_m = np.array([item.size_m or (np.nan,) * 3 for item in objects]).reshape(-1, 3)
    bottoms_m = np.array([np.nan if item.bottom_m is None else item.bottom_m for item in objects])
    spread = np.array([item.size_spread for item in objects])
    lengths = sum(_side(boxes, axis, usual_m[:, axis], spread, cfg) for axis in (0, 1))
    height = _side(boxes, 2, usual_m[:, 2], spread * cfg.height_spread, cfg)
    edges = _edges(boxes, bottoms_m, usual_m[:, 2], spread * cfg.height_spread, cfg)
    return cfg.weight * np.nan_to_num(lengths + np.where(np.isnan(edges), height, edges))


def _side(boxes: Boxes, axis: int, usual_m: np.ndarray, spread: np.ndarray, cfg: SizeConfig) -> np.ndarray:
    """(box, object) of one side."""
    seen_m = usual_m + boxes.cell_m
    sigma = np.hypot(spread, boxes.cell_m / 2 / seen_m)
    density = _two_piece(np.log(boxes.sides_m[:, axis, None] / seen_m), sigma * cfg.skew, sigma)
    return _mixed(density * np.log(cfg.side_m[1] / cfg.side_m[0]), cfg.misfit)


def _edges(
    boxes: Boxes, bottoms_m: np.ndarray, heights_m: np.ndarray, spread: np.ndarray, cfg: SizeConfig
) -> np.ndarray:
    """(box, object) of the lower and the upper edge above the floor; NaN where one of the floor and them is unknown."""
    hung_m = cfg.hung_spread * np.minimum(bottoms_m, 1.0)
    lower_m = cfg.bottom_spread_m + hung_m
    upper_m = np.sqrt(hung_m**2 + (spread * heights_m) ** 2 + (boxes.cell_m / 2) ** 2)
    tops_m = boxes.bottoms_m + boxes.sides_m[:, 2] - boxes.cell_m / 2
    lower = _two_piece(boxes.bottoms_m[:, None] - bottoms_m, lower_m, lower_m * cfg.skew)
    upper = _two_piece(tops_m[:, None] - bottoms_m - heights_m, upper_m, upper_m * cfg.skew)
    return _mixed(lower * cfg.reach_m, cfg.misfit) + _mixed(upper * cfg.reach_m, cfg.misfit)


def _two_piece(deviation: np.ndarray, below: np.ndarray, above: np.ndarray) -> np.ndarray:
    """Density of a normal distribution whose spreads below and above its mode differ."""
    scale = np.where(deviation < 0, below, above)
    return np.sqrt(2 / np.pi) / (below + above) * np.exp(-0.5 * (deviation / scale) ** 2)


def _mixed(ratio: np.ndarray, misfit: float) -> np.ndarray:
    """The logarithm of a density in units of the uniform one, after a share of the latter is mixed in."""
    return np.log((1 - misfit) * ratio + misfit)

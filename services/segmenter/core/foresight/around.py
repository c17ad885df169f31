"""What the map holds around its openings (pure).

An opening of a region that touches many others leads to more of them; one amid regions that were found leads to little
that is new; one beside a border has a door in sight, whose other side need not suit the region that it opens from.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy

from prior_sg.schemas.regions import Region
from prior_sg.services.segmenter.core.foresight.config import ForesightConfig
from prior_sg.services.segmenter.core.foresight.openings import Openings

TINY_M2 = 1e-9  # corners of small outlines are rounded onto each other


@dataclass(frozen=True)
class Around:
    """One row for each opening."""

    touching: np.ndarray  # (opening,) regions that touch the one it opens from
    nearby: np.ndarray  # (opening,) found regions other than that one, each as `fading` as it is far
    at_border: np.ndarray  # (opening,) as `fading` as the nearest way between two regions is far
    storey_m2: np.ndarray  # (opening,) seen on its storey

    def of(self, kept: np.ndarray) -> "Around":
        """The rows of some openings."""
        return Around(*(column[kept] for column in vars(self).values()))


def fading(distances_m: np.ndarray, over_m: float) -> np.ndarray:
    """1 where there is no distance, 1/e at `over_m`."""
    return np.asarray(np.exp(-distances_m / over_m))


def around_of(openings: Openings, regions: Mapping[int, Region], cfg: ForesightConfig) -> Around:
    """Of the openings of a map with these regions."""
    touching = np.array([len(regions[region].neighbour_ids) for region in openings.regions.tolist()], float)
    large = [one for one in regions.values() if one.place_count >= cfg.least_places and one.hull_m]
    ways_m = np.array([way.position_m for one in regions.values() for way in one.transitions]).reshape(-1, 3)
    outward_m = openings.beyond_m - openings.positions_m
    outward = outward_m / np.linalg.norm(outward_m, axis=1, keepdims=True)
    off_m = scipy.spatial.distance.cdist(openings.beyond_m - cfg.beyond_m * outward, ways_m)
    heights_m = np.array([one.position_m[2] for one in large])
    areas_m2 = np.array([one.area_m2 for one in large])
    rise_m = np.abs(openings.positions_m[:, 2:] - heights_m)
    distances_m = _distances_m(openings.beyond_m[:, :2], [np.array(one.hull_m).reshape(-1, 2) for one in large])
    distances_m = np.hypot(distances_m, cfg.steepness * rise_m)
    other = openings.regions[:, None] != np.array([one.id for one in large])
    return Around(
        touching=touching,
        nearby=(fading(distances_m, cfg.nearby_m) * other).sum(axis=1),
        at_border=fading(off_m.min(axis=1, initial=np.inf), cfg.border_m),
        storey_m2=((rise_m <= cfg.storey_m) * areas_m2).sum(axis=1),
    )


def _distances_m(points_m: np.ndarray, hulls_m: list[np.ndarray]) -> np.ndarray:
    """Distance (point, hull) of points (n, 2) from convex outlines (corner, 2), counter-clockwise; 0 inside."""
    if not hulls_m:
        return np.zeros((len(points_m), 0))
    starts = np.cumsum([0, *(len(hull) for hull in hulls_m[:-1])])
    corners = np.concatenate(hulls_m)
    sides = np.concatenate([np.roll(hull, -1, axis=0) - hull for hull in hulls_m])
    (x_m, y_m), (across_m, along_m) = corners.T, sides.T
    off_x_m, off_y_m = points_m[:, :1] - x_m, points_m[:, 1:] - y_m
    sides_m2 = np.maximum(across_m**2 + along_m**2, TINY_M2)
    share = np.clip((off_x_m * across_m + off_y_m * along_m) / sides_m2, 0.0, 1.0)
    away_m2 = (off_x_m - share * across_m) ** 2 + (off_y_m - share * along_m) ** 2
    inside = np.minimum.reduceat(across_m * off_y_m - along_m * off_x_m, starts, axis=1) >= 0
    return np.where(inside, 0.0, np.sqrt(np.minimum.reduceat(away_m2, starts, axis=1)))

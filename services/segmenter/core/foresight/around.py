"""What the map holds around its openings (pure).

An opening of a region that touches many others leads to more of them; one amid regions that were found leads to little
that is new; one beside a border has a door in sight, whose other side need not suit the region that it opens from.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from prior_sg.schemas.regions import Region
from prior_sg.services.segmenter.core.foresight.config import ForesightConfig
from prior_sg.services.segmenter.core.foresight.openings import Openings


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
    off_m = np.linalg.norm(openings.beyond_m[:, None] - ways_m[None], axis=2)
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
    off = points_m[:, None] - corners
    along = np.clip((off * sides).sum(axis=2) / (sides**2).sum(axis=1), 0.0, 1.0)
    away_m = np.linalg.norm(off - along[:, :, None] * sides, axis=2)
    left = sides[:, 0] * off[:, :, 1] - sides[:, 1] * off[:, :, 0]
    inside = np.minimum.reduceat(left, starts, axis=1) >= 0
    return np.where(inside, 0.0, np.minimum.reduceat(away_m, starts, axis=1))

"""What a click means: the place or region that a ray of sight meets first (pure)."""

from dataclasses import dataclass

import numpy as np

from prior_sg.deploy.viewing.footprint import PAD_M, Footprint
from prior_sg.schemas.queries import Spot
from prior_sg.schemas.regions import NO_REGION
from prior_sg.schemas.scene import Scene

CLOSE_RAD = 0.012  # a click that misses a dot by less means it


@dataclass(frozen=True)
class Picked:
    """A place, and whether it was meant itself or the region that it lies in."""

    place: int
    region: int  # NO_REGION = none
    itself: bool

    @property
    def spot(self) -> Spot:
        """As an end of a way."""
        return Spot(what="place", id=self.place) if self.itself else Spot(what="region", id=self.region)


def pick(
    scene: Scene, ground: dict[int, Footprint], origin_m: np.ndarray, direction: np.ndarray, dots: bool
) -> Picked | None:
    """What a ray from `origin_m` (3,) along `direction` (3,) meets; `dots` says whether places can be seen."""
    if not len(scene.place_ids):
        return None
    direction = direction / np.linalg.norm(direction)
    offsets = scene.positions_m - origin_m
    along = offsets @ direction
    if dots:
        aside = np.linalg.norm(offsets - along[:, None] * direction, axis=1)
        angle = np.where(along > 0, aside / np.maximum(along, 1e-6), np.inf)
        near = np.flatnonzero(angle < CLOSE_RAD)
        if len(near):
            return _picked(scene, int(near[along[near].argmin()]), itself=True)
    row = _below(scene, ground, origin_m, direction)
    return None if row is None else _picked(scene, row, itself=False)


def _below(scene: Scene, ground: dict[int, Footprint], origin_m: np.ndarray, direction: np.ndarray) -> int | None:
    """The place that owns the nearest ground the ray meets."""
    floors = sorted({float(one.vertices[0, 2]) for one in ground.values()}, reverse=bool(direction[2] < 0))
    for floor_m in floors if direction[2] else []:
        reach = (floor_m - origin_m[2]) / direction[2]
        if reach <= 0:
            continue
        at = origin_m + reach * direction
        storey = [region for region, one in ground.items() if float(one.vertices[0, 2]) == floor_m]
        rows = np.flatnonzero(np.isin(scene.place_regions, storey))
        heights = scene.radii_m[rows] - np.linalg.norm(scene.positions_m[rows, :2] - at[:2], axis=1)
        if heights.max() > -PAD_M:
            return int(rows[heights.argmax()])
    return None


def _picked(scene: Scene, row: int, *, itself: bool) -> Picked:
    region = int(scene.place_regions[row])
    return Picked(int(scene.place_ids[row]), region, itself or region == NO_REGION)


def typical_place(scene: Scene, region: int) -> int | None:
    """The place of a region that lies nearest to its middle."""
    rows = np.flatnonzero(scene.place_regions == region)
    if not len(rows):
        return None
    middle_m = scene.positions_m[rows].mean(axis=0)
    return int(scene.place_ids[rows[np.linalg.norm(scene.positions_m[rows] - middle_m, axis=1).argmin()]])

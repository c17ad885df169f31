"""What a click means: the printed marker, place or region that a ray of sight meets first (pure)."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from prior_sg.deploy.parts import spots_of
from prior_sg.deploy.viewing.footprint import PAD_M, Footprint
from prior_sg.schemas.markers import MarkerKey
from prior_sg.schemas.queries import Spot
from prior_sg.schemas.regions import NO_REGION
from prior_sg.schemas.scene import Scene

CLOSE_RAD = 0.012  # a click that misses a dot by less means it
CLOSE_TO_MARKER_RAD = 0.02  # likewise a marker, beside which its name stands
ON_GROUND_M = 0.5  # below a storey's floor, from which something is under it


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


@dataclass(frozen=True)
class PickedMarker:
    """A printed marker."""

    key: MarkerKey

    @property
    def spot(self) -> Spot:
        """As an end of a way."""
        return Spot(what="marker", id=self.key.id, dictionary=self.key.dictionary)


class Met(NamedTuple):
    """What a ray meets, and how far along it."""

    along_m: float
    what: Picked | PickedMarker


def pick(
    scene: Scene,
    ground: dict[int, Footprint],
    origin_m: np.ndarray,
    direction: np.ndarray,
    *,
    dots: bool,
    markers: bool = False,
) -> Picked | PickedMarker | None:
    """What a ray from `origin_m` (3,) along `direction` (3,) meets first; `dots` and `markers` say whether places and
    printed markers can be seen. What lies on the ground counts as before it."""
    direction = direction / np.linalg.norm(direction)
    met: list[Met] = []
    if markers and scene.markers:
        half_m = np.array([one.size_m for one in scene.markers]) / 2
        row, along_m = _nearest(spots_of(scene.markers) - origin_m, direction, CLOSE_TO_MARKER_RAD, half_m)
        met += [] if row is None else [Met(along_m, PickedMarker(scene.markers[row].key))]
    if dots and len(scene.place_ids):
        row, along_m = _nearest(scene.positions_m - origin_m, direction, CLOSE_RAD)
        met += [] if row is None else [Met(along_m, _picked(scene, row, itself=True))]
    row, along_m = _below(scene, ground, origin_m, direction)
    if row is not None:
        within_m = ON_GROUND_M / abs(float(direction[2]))
        met.append(Met(along_m + within_m, _picked(scene, row, itself=False)))
    return min(met, key=lambda one: one.along_m).what if met else None


def _nearest(
    offsets_m: np.ndarray, direction: np.ndarray, close_rad: float, half_m: np.ndarray | float = 0.0
) -> tuple[int | None, float]:
    """Of spots (spot, 3) seen from the eye, the nearest that a ray along `direction` (3,) misses by less than an angle,
    or by less than half their size (spot,); and how far along it is."""
    along_m = offsets_m @ direction
    aside_m = np.linalg.norm(offsets_m - along_m[:, None] * direction, axis=1)
    near = np.flatnonzero((along_m > 0) & (aside_m < np.maximum(close_rad * along_m, half_m)))
    if not len(near):
        return None, np.inf
    row = int(near[along_m[near].argmin()])
    return row, float(along_m[row])


def _below(
    scene: Scene, ground: dict[int, Footprint], origin_m: np.ndarray, direction: np.ndarray
) -> tuple[int | None, float]:
    """The place that owns the nearest ground the ray meets, and how far along that is."""
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
            return int(rows[heights.argmax()]), float(reach)
    return None, np.inf


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

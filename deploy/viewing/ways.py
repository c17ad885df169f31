"""The way from where the robot is, or from a chosen start, to what somebody asked for (pure)."""

import itertools
from dataclasses import dataclass, field

import numpy as np

from prior_sg.deploy.showing.colors import Color
from prior_sg.deploy.viewing.shapes import Arrows, Lines, Name, Picture, Points, dashed
from prior_sg.schemas.answers import Point, Route
from prior_sg.schemas.names import shown
from prior_sg.schemas.queries import RouteBetween, Spot
from prior_sg.schemas.regions import NO_REGION
from prior_sg.services.scene_store.core.queries.answering import answer
from prior_sg.services.scene_store.core.queries.index import Index
from prior_sg.services.scene_store.core.queries.markers import numbered

FROM_THE_ROBOT = Spot(here=True)
ARROW_EVERY_M, ARROW_M, SHAFT_M = 1.2, 0.05, 0.035
WAY_PX, GAP_PX, GAP_DASH_M = 6.0, 3.0, 0.1
END_M, NAME_ABOVE_M = 0.24, 0.35


@dataclass(frozen=True)
class Trip:
    """Where to, and from where."""

    goal: Spot
    start: Spot = FROM_THE_ROBOT


@dataclass(frozen=True)
class Stop:
    """Where a way enters a region."""

    label: str
    region: int
    point_m: Point


@dataclass(frozen=True)
class Way:
    """A route with the points that stand for its ends where they are none of its places, and its named waypoints."""

    route: Route
    trip: Trip
    start_m: Point | None = None
    goal_m: Point | None = None
    stops: list[Stop] = field(default_factory=list)


def way(index: Index, trip: Trip) -> Way:
    """The shortest known way of a trip, or one that says why there is none."""
    found = answer(index, RouteBetween(start=trip.start, goal=trip.goal))
    if not isinstance(found, Route):
        raise TypeError(f"RouteBetween is answered by {type(found).__name__}")
    path_m = index.scene.trajectory
    start_m = tuple(path_m[-1].tolist()) if trip.start.here and len(path_m) else _point_of(index, trip.start)
    is_object = found.goal is not None and found.goal.what == "object"
    goal_m = found.goal.position_m if found.goal is not None and is_object else _point_of(index, trip.goal)
    return Way(found, trip, start_m, goal_m, _stops(index, found))


def _point_of(index: Index, spot: Spot) -> Point | None:
    """Where an end is that is a point or the only marker that it can mean."""
    if spot.what != "marker":
        return spot.point_m
    found = numbered(index.scene, spot.id, spot.dictionary)
    return found[0].position_m if len(found) == 1 else None


def _stops(index: Index, route: Route) -> list[Stop]:
    """One for each of the route's regions, at the first place in it."""
    scene = index.scene
    rows = np.searchsorted(scene.place_ids, route.place_ids)
    names = {region.id: region.label for region in scene.regions}
    runs = itertools.groupby(
        zip(scene.place_regions[rows].tolist(), route.waypoints_m, strict=True), lambda one: one[0]
    )
    return [
        Stop(names[region], region, next(steps)[1]) for region, steps in runs if region != NO_REGION and region in names
    ]


def picture(way: Way, line: Color, ink: Color) -> Picture:
    """A way as a line with arrows, dashes over what nobody has checked, and names where it enters regions."""
    points_m = np.array(way.route.waypoints_m, np.float32).reshape(-1, 3)
    if not way.route.found:
        return {}
    tint = np.array(line, np.uint8)
    shapes: Picture = {}
    if len(points_m) > 1:
        steps = np.stack((points_m[:-1], points_m[1:]), axis=1)
        shapes["/way/line"] = Lines(steps, tint, WAY_PX)
        shapes["/way/arrows"] = Arrows(_arrows(steps), ink, SHAFT_M)
    gaps = [(way.start_m, points_m[0]), (points_m[-1], way.goal_m)]
    dashes = [
        dashed(np.array([gap], np.float32), GAP_DASH_M) for gap in gaps if gap[0] is not None and gap[1] is not None
    ]
    if dashes:
        shapes["/way/gaps"] = Lines(np.concatenate(dashes), tint, GAP_PX)
    ends = points_m[[0, -1]]
    shapes["/way/ends"] = Points(ends, np.tile(tint, (2, 1)), END_M)
    return shapes | _names(way, points_m)


def _arrows(steps: np.ndarray) -> np.ndarray:
    """Short arrows along a way (arrow, 2, 3), the same distance apart."""
    along = steps[:, 1] - steps[:, 0]
    lengths = np.linalg.norm(along, axis=1)
    ends = np.cumsum(lengths)
    at = np.arange(ARROW_EVERY_M / 2, max(ends[-1], ARROW_EVERY_M / 2 + 1e-6), ARROW_EVERY_M)
    rows = np.minimum(np.searchsorted(ends, at), len(steps) - 1)
    forward = along[rows] / np.maximum(lengths[rows], 1e-6)[:, None]
    middles = steps[rows, 1] - forward * (ends[rows] - at)[:, None]
    return np.stack((middles, middles + forward * ARROW_M), axis=1).astype(np.float32)


def _names(way: Way, points_m: np.ndarray) -> Picture:
    """The goal with the length, the regions that are entered, numbered, and the start where it was chosen.

    The goal's is below it: above the middle of a region stands the region's own name.
    """
    x, y, z = points_m[-1].tolist()
    told = [(f"goal, {way.route.length_m:.1f} m", (x, y, z - 2 * NAME_ABOVE_M))]
    told += [(f"{number} {shown(stop.label)}", stop.point_m) for number, stop in enumerate(way.stops[1:], 1)]
    told += [] if way.trip.start.here else [("start", points_m[0].tolist())]
    return {
        f"/way/names/{number}": Name(text, (x, y, z + NAME_ABOVE_M), 0.8)
        for number, (text, (x, y, z)) in enumerate(told)
    }

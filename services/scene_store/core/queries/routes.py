"""Ways over the place graph (pure)."""

import itertools
from typing import NamedTuple

import numpy as np
import scipy

from prior_sg.schemas.answers import Point, Route, Thing, What
from prior_sg.schemas.markers import SceneMarker
from prior_sg.schemas.queries import RouteBetween, Spot
from prior_sg.services.scene_store.core.queries.index import Index, Ways
from prior_sg.services.scene_store.core.queries.labels import REGIONS_AND_OBJECTS, kinds, not_there, nothing_called
from prior_sg.services.scene_store.core.queries.markers import gaps_of, nothing_numbered, numbered, rows_before
from prior_sg.services.scene_store.core.queries.spatial import distances_of
from prior_sg.services.scene_store.core.queries.things import thing

REACH_M = 1.0  # so much farther than the nearest place, others may stand for an object where the nearest has no way
FIRST_LIMIT, WIDER = 1.5, 3.0  # a search goes as far as so many straight distances, then farther by so much


class NoSuchSpot(ValueError):
    """An end of a route means nothing in this scene; the message is one sentence."""


class End(NamedTuple):
    """A place at which a route may begin or end."""

    row: int
    gap_m: float  # to what was asked for
    thing: Thing | None  # None = a point


def route(index: Index, question: RouteBetween) -> Route:
    """The shortest way between any two of the places that stand for both ends."""
    ways = index.ways(question.clearance_m)
    try:
        starts = _ends(index, question.start, ways, "start", question.clearance_m)
        goals = _ends(index, question.goal, ways, "goal", question.clearance_m)
    except NoSuchSpot as error:
        return Route(reason=str(error))
    rows = _shortest(index, ways, [end.row for end in starts], [end.row for end in goals])
    start, goal = starts[0], goals[0]
    if not rows:
        return Route(reason=_no_way(index, starts, goals, question.clearance_m), start=start.thing, goal=goal.thing)
    start = min((end for end in starts if end.row == rows[0]), key=lambda end: end.gap_m)
    goal = min((end for end in goals if end.row == rows[-1]), key=lambda end: end.gap_m)
    return _told(index, rows, start, goal)


def lengths_from(index: Index, start: Spot, clearance_m: float) -> np.ndarray:
    """Metres (place,) from a start to each place, inf = no way. Raises NoSuchSpot."""
    ways = index.ways(clearance_m)
    sources = [end.row for end in _ends(index, start, ways, "start", clearance_m)]
    lengths_m: np.ndarray = scipy.sparse.csgraph.dijkstra(ways.graph, indices=sources, min_only=True)
    return lengths_m


def _told(index: Index, rows: list[int], start: End, goal: End) -> Route:
    """A way by its places (place,)."""
    steps = [_edge(index, a, b) for a, b in itertools.pairwise(rows)]
    lengths_m = index.edges[1][steps]
    clearances_m = index.scene.clearances_m[steps] if steps else index.scene.radii_m[rows]
    passed = [region for region, _ in itertools.groupby(index.region_rows[rows].tolist()) if region >= 0]
    return Route(
        found=True,
        start=start.thing,
        goal=goal.thing,
        place_ids=index.scene.place_ids[rows].tolist(),
        waypoints_m=[tuple(point) for point in index.scene.positions_m[rows].tolist()],
        length_m=float(lengths_m.sum()),
        clearance_m=float(clearances_m.min()),
        regions=[thing(index, "region", region) for region in passed],
        start_gap_m=start.gap_m,
        goal_gap_m=goal.gap_m,
    )


def _edge(index: Index, a: int, b: int) -> int:
    """Number of the edge between two rows."""
    return next(int(edge) for edge in index.edges_of(a) if b in index.edges[0][edge])


def _shortest(index: Index, ways: Ways, starts: list[int], goals: list[int]) -> list[int]:
    """Rows from the one of the starts to the one of the goals that are nearest to each other; empty = no way."""
    reached = np.isin(ways.component[goals], ways.component[starts])
    targets = np.array(goals)[reached]
    if not len(targets):
        return []
    sources = np.array(starts)
    straight_m = np.linalg.norm(index.points_m[sources][:, None] - index.points_m[targets], axis=2).min()
    limit_m = FIRST_LIMIT * straight_m + REACH_M
    while True:  # a way that is found within a limit is the shortest, and what lies beyond it was never looked at
        lengths_m, before, _ = scipy.sparse.csgraph.dijkstra(
            ways.graph, indices=sources, return_predecessors=True, min_only=True, limit=limit_m
        )
        goal = int(targets[lengths_m[targets].argmin()])
        if np.isfinite(lengths_m[goal]):
            break
        limit_m *= WIDER
    rows = [goal]
    while before[rows[-1]] >= 0:
        rows.append(int(before[rows[-1]]))
    return rows[::-1]


def _ends(index: Index, spot: Spot, ways: Ways, side: str, clearance_m: float) -> list[End]:
    """Places that stand for an end, the nearest to it first. Raises NoSuchSpot."""
    point_m = _here(index, side) if spot.here else spot.point_m
    if point_m is not None:
        reach_m = distances_of(index, "place", point_m)
        found = _around(reach_m, np.arange(len(reach_m)), ways, None, index.scene.radii_m)
    elif spot.what == "marker":
        found = [end for marker in _printed(index, spot, side) for end in _of_marker(index, marker, ways)]
    else:
        found = [end for what, row in _meant(index, spot, spot.what, side) for end in _of_thing(index, what, row, ways)]
    if not found:
        room = f" with {clearance_m:g} m of room" if clearance_m > 0 else ""
        raise NoSuchSpot(f"no place{room} is there where the {side} is")
    return sorted(found, key=lambda end: end.gap_m)


def _here(index: Index, side: str) -> Point:
    """Where the camera was last. Raises NoSuchSpot."""
    if not len(index.scene.trajectory):
        raise NoSuchSpot(f"the {side} is where the camera was last, and nothing is known of that yet")
    x, y, z = index.scene.trajectory[-1].tolist()
    return x, y, z


def _printed(index: Index, spot: Spot, side: str) -> list[SceneMarker]:
    """The markers of a number; only those that stand at one spot. Raises NoSuchSpot."""
    if spot.id is None:
        raise NoSuchSpot(f"the {side} is a marker without a number: write marker:7")
    found = numbered(index.scene, spot.id, spot.dictionary)
    if not found:
        raise NoSuchSpot(f"the {side}: {nothing_numbered(index.scene, spot.id, spot.dictionary)}")
    sure = [one for one in found if not one.doubt]
    if not sure:
        raise NoSuchSpot(f"the {side}: nobody knows where {found[0].key} is, for {found[0].doubt}")
    return sure


def _of_marker(index: Index, marker: SceneMarker, ways: Ways) -> list[End]:
    """Places that stand for a marker: from where it can be seen."""
    rows = rows_before(index, marker)
    return _around(gaps_of(index, marker, rows), rows, ways, None, index.scene.radii_m[rows])


def _meant(index: Index, spot: Spot, kind: What | None, side: str) -> list[tuple[What, int]]:
    """Kind and row of what an end names, of a kind where it is said. Raises NoSuchSpot."""
    if spot.id is not None:
        if kind is None:
            raise NoSuchSpot(f"the {side} is a number: say whether it is a place, a region, an object or a marker")
        row = index.row(kind, spot.id)
        if row is None:
            raise NoSuchSpot(f"the {side}: {not_there(index, kind, spot.id)}")
        return [(kind, row)]
    if not spot.label:
        raise NoSuchSpot(f"the {side} names nothing: give a point, an id, a label or `here`")
    for what in REGIONS_AND_OBJECTS if kind is None else kinds(kind):
        if len(rows := index.labelled(what, spot.label)):
            return [(what, row) for row in rows.tolist()]
    unknown = nothing_called(index, kind, spot.label)
    raise NoSuchSpot(f"the {side}: {unknown.reason}" if unknown else f"the {side} {spot.label!r} has no places")


def _of_thing(index: Index, what: What, row: int, ways: Ways) -> list[End]:
    """Places that stand for one thing: in each connected part of the map the nearest."""
    shown = thing(index, what, row)
    if what == "place":
        return [End(row, 0.0, shown)] if ways.roomy[row] else []
    if what == "region":
        rows = index.members(row)
        gaps_m = np.linalg.norm(index.points_m[rows] - shown.position_m, axis=1)
        return _around(gaps_m, rows, ways, shown, np.full(len(rows), np.inf))
    low_m, high_m = (side[row] for side in index.boxes_m)
    holder = int(index.object_regions[row])
    rows = index.members(holder) if holder >= 0 else np.zeros(0, np.int64)
    if not ways.roomy[rows].any():
        rows = np.arange(len(index.points_m))
    points_m = index.points_m[rows]
    gaps_m = np.linalg.norm(np.maximum(np.maximum(low_m - points_m, points_m - high_m), 0.0), axis=1)
    reach_m = gaps_m[ways.roomy[rows]].min(initial=np.inf) + REACH_M
    return _around(gaps_m, rows, ways, shown, np.full(len(rows), reach_m))


def _around(gaps_m: np.ndarray, rows: np.ndarray, ways: Ways, shown: Thing | None, reach_m: np.ndarray) -> list[End]:
    """In each connected part of the map the row with the least gap: a scrap of free space under a table may be nearest
    and lead nowhere. Beside the nearest of all, only rows (row,) count whose gap is within their reach (row,)."""
    roomy = ways.roomy[rows]
    rows, gaps_m, reach_m = rows[roomy], gaps_m[roomy], reach_m[roomy]
    if not len(rows):
        return []
    near = np.flatnonzero((gaps_m <= gaps_m.min()) | (gaps_m <= reach_m))
    order = near[np.argsort(gaps_m[near], kind="stable")]
    _, first = np.unique(ways.component[rows[order]], return_index=True)
    return [End(int(rows[one]), float(gaps_m[one]), shown) for one in order[first]]


def _no_way(index: Index, starts: list[End], goals: list[End], clearance_m: float) -> str:
    """Why nothing joins the ends, in one sentence."""
    widest_m = _widest_m(index, [end.row for end in starts], [end.row for end in goals]) if clearance_m > 0 else 0.0
    if widest_m <= 0:
        return "no way: no free space that was seen so far joins the start and the goal"
    return f"no way with {clearance_m:g} m of clearance; the widest one has {widest_m:.2f} m"


def _widest_m(index: Index, starts: list[int], goals: list[int]) -> float:
    """The largest clearance with which some start and goal are joined, 0 where none is: a way in the tree of the widest
    edges is as wide as any."""
    rows, _ = index.edges
    count, clearances_m = len(index.points_m), index.scene.clearances_m.astype(np.float64)
    highest_m = clearances_m.max(initial=0.0) + 1.0
    a, b = rows.T
    graph = scipy.sparse.csr_array((highest_m - clearances_m, (a, b)), shape=(count, count))
    tree = scipy.sparse.csgraph.minimum_spanning_tree(graph)
    best_m = 0.0
    for start in starts:
        lengths, before = scipy.sparse.csgraph.dijkstra(tree, directed=False, indices=start, return_predecessors=True)
        for goal in (one for one in goals if np.isfinite(lengths[one])):
            least_m, row = np.inf, goal
            while before[row] >= 0:
                least_m = min(least_m, float(clearances_m[_edge(index, row, int(before[row]))]))
                row = int(before[row])
            best_m = max(best_m, least_m)
    return best_m if np.isfinite(best_m) else 0.0

"""Regions: connected places with one label, with ids that last (paper, Instantiating the Instance Layers; pure)."""

from typing import NamedTuple

import numpy as np
import scipy

from prior_sg.schemas.regions import NO_REGION, RegionEvent, Transition
from prior_sg.services.compiled import compiled
from prior_sg.services.segmenter.core.experts.context import ObjectView
from prior_sg.services.segmenter.core.map.received import ReceivedGraph

HULL_CORNERS = 8  # of the polygon that stands for a sphere in a hull
OBJECT_REACH_M = 1.5  # an object stands in a region when one of its places is at most this far
SIDE_BY_SIDE_M = 1.0  # edges across a border whose middles are closer than this lead through the same opening


def numbered(labels: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Component number (place,) of each place in the graph of same-label edges (eq. connected_components).

    Numbers count from 0 in the order of each component's first place.
    """
    return _numbered(labels, edges)


@compiled()
def _numbered(labels, edges):  # noqa: ANN001, ANN202
    """Union by the smaller row, which is then the component's first place."""
    parent = np.arange(len(labels))
    for edge in range(len(edges)):
        one, other = edges[edge]
        if labels[one] != labels[other]:
            continue
        while parent[one] != one:
            parent[one] = parent[parent[one]]
            one = parent[one]
        while parent[other] != other:
            parent[other] = parent[parent[other]]
            other = parent[other]
        parent[max(one, other)] = min(one, other)
    numbers = np.empty(len(labels), np.int64)
    count = 0
    for row in range(len(labels)):
        if parent[row] == row:
            numbers[row] = count
            count += 1
        else:  # its parent is a smaller row, whose number is known
            numbers[row] = numbers[parent[row]]
    return numbers


def first_rows(component: np.ndarray) -> np.ndarray:
    """First place (component,) of each component, `component` (place,) from `numbered`."""
    return np.flatnonzero(np.diff(np.maximum.accumulate(component), prepend=-1))


def track(
    component: np.ndarray, previous: np.ndarray, next_id: int, sizes: np.ndarray | None = None
) -> tuple[np.ndarray, int]:
    """Region id (place,) of each place, and the next unused id.

    `component` (place,) from `numbered`, places in the order of their ids; `previous` (place,) holds the region ids
    before, NO_REGION for new places. An id follows the component that keeps most of its places (a split: the larger
    part), and a component that several ids would follow takes the one that brings most places (a merge); ties go to the
    older id and to the component of the older place. Components without an heir get new ids, in order. With `sizes`
    (place,), a place counts as so many.
    """
    pairs, counts = _pairs(previous, component, sizes)
    heir: dict[int, tuple[int, int]] = {}  # old id -> (places kept, component)
    for (old, number), count in zip(pairs.tolist(), counts.tolist(), strict=True):
        if old not in heir or count > heir[old][0]:
            heir[old] = (count, number)
    chosen: dict[int, tuple[int, int]] = {}  # component -> (places brought, old id)
    for old, (count, number) in sorted(heir.items()):
        if number not in chosen or count > chosen[number][0]:
            chosen[number] = (count, old)
    ids = np.empty(int(component.max(initial=-1)) + 1, dtype=np.int64)
    for number in range(len(ids)):
        if number in chosen:
            ids[number] = chosen[number][1]
        else:
            ids[number] = next_id
            next_id += 1
    return ids[component], next_id


def _pairs(previous: np.ndarray, now: np.ndarray, sizes: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (n, 2) of a former and a present number that some place has, sorted, and how many places have each.

    Runs of places with one pair are taken together first, for neighbours in the order of ids mostly share it.
    """
    first, lengths = _runs(previous, now, np.ones(len(now), np.int64) if sizes is None else sizes)
    known = previous[first] != NO_REGION
    first, lengths = first[known], lengths[known]
    found, inverse = np.unique(previous[first] * (int(now.max(initial=0)) + 1) + now[first], return_inverse=True)
    counts = np.bincount(inverse, lengths, minlength=len(found)).astype(np.int64)
    return np.stack(np.divmod(found, int(now.max(initial=0)) + 1), axis=1), counts


@compiled()
def _runs(one, other, sizes):  # noqa: ANN001, ANN202
    """First row and sum of sizes of each run of rows with the same two numbers."""
    first, lengths = np.empty(len(one), np.int64), np.empty(len(one), np.int64)
    count = 0
    for row in range(len(one)):
        if not row or one[row] != one[row - 1] or other[row] != other[row - 1]:
            first[count], lengths[count] = row, 0
            count += 1
        lengths[count - 1] += sizes[row]
    return first[:count].copy(), lengths[:count].copy()


def footprint_m2(positions_m: np.ndarray, radii_m: np.ndarray, cell_m: float) -> float:
    """Area of the union of discs (n, 2 or 3) with `radii_m` (n,), seen from above, counted on a grid of `cell_m`.

    Each disc covers, in each grid row it crosses, an interval of cell centres; what intervals of a row share is counted
    once. So the cost follows the discs' sizes, however far apart they lie.
    """
    low = (positions_m[:, :2] - radii_m[:, None]).min(axis=0)
    x_cells, y_cells = ((positions_m[:, :2] - low) / cell_m).T.astype(np.float64)
    radii_cells = radii_m.astype(np.float64) / cell_m
    first_row = np.ceil(y_cells - radii_cells - 0.5).astype(np.int64)
    row_counts = np.maximum(np.floor(y_cells + radii_cells - 0.5).astype(np.int64) - first_row + 1, 0)
    disc = np.repeat(np.arange(len(radii_m)), row_counts)
    row = np.arange(len(disc)) - np.repeat(np.cumsum(row_counts) - row_counts, row_counts) + first_row[disc]
    half = np.sqrt(np.maximum(radii_cells[disc] ** 2 - (row + 0.5 - y_cells[disc]) ** 2, 0.0))
    start = np.ceil(x_cells[disc] - half - 0.5).astype(np.int64)
    stop = np.floor(x_cells[disc] + half - 0.5).astype(np.int64) + 1
    if not len(disc):
        return 0.0
    width = max(stop.max(), start.max()) + 1  # rows laid end to end, so that no interval reaches into the next
    order = np.argsort(start := row * width + start)
    start, stop = start[order], (row * width + stop)[order]
    reached = np.maximum.accumulate(stop)
    covered = stop - np.maximum(start, np.concatenate((start[:1], reached[:-1])))
    return float(np.maximum(covered, 0).sum() * cell_m**2)


def events(previous: np.ndarray, now: np.ndarray, before: dict[int, str], labels: dict[int, str]) -> list[RegionEvent]:
    """What became of the regions between two updates.

    `previous` and `now` (place,) are the region ids of the places that are there now; `before` and `labels` are the
    labels of all regions then and now. A region that is new and holds places of one that lives on was split off; one
    that is gone was merged into the region with most of its places.
    """
    pairs, counts = _pairs(previous, now)
    new_ones, gone = labels.keys() - before.keys(), before.keys() - labels.keys()
    into: dict[int, tuple[int, int]] = {}  # former id -> (places, id now)
    out_of: dict[int, tuple[int, int]] = {}  # id now -> (places, former id)
    for (old, new), count in zip(pairs.tolist(), counts.tolist(), strict=True):
        if old in gone:
            into[old] = max(into.get(old, (0, 0)), (count, new))
        if new in new_ones:
            out_of[new] = max(out_of.get(new, (0, 0)), (count, old))
    found = []
    for region in sorted(new_ones):
        origin = out_of.get(region, (0, NO_REGION))[1]
        if origin in labels:
            found.append(RegionEvent(kind="split", region=region, label=labels[region], other=origin))
        else:
            found.append(RegionEvent(kind="appeared", region=region, label=labels[region]))
    for region in sorted(gone):
        if region in into:
            found.append(RegionEvent(kind="merged", region=region, label=before[region], other=into[region][1]))
        else:
            found.append(RegionEvent(kind="removed", region=region, label=before[region]))
    for region in sorted(region for region, label in before.items() if labels.get(region, label) != label):
        found.append(RegionEvent(kind="relabelled", region=region, label=labels[region], former_label=before[region]))
    return found


class Border(NamedTuple):
    """The ways between regions, by region."""

    neighbours: dict[int, list[int]]
    transitions: dict[int, list[Transition]]


def border(graph: ReceivedGraph, region_of: np.ndarray, ids: set[int], door_clearance_m: float) -> Border:
    """Neighbours and transitions of the regions `ids`; `region_of` (place,).

    Edges across a border that lie side by side are one way. It counts as a door where even the widest of them has at
    most `door_clearance_m`.
    """
    wanted = np.zeros(int(region_of.max(initial=0)) + 1, dtype=bool)
    wanted[[region for region in ids if region < len(wanted)]] = True
    near = graph.arcs
    crossing = np.unique(_crossing(near.starts, near.neighbours, near.edges, region_of, wanted))
    ends = graph.edges[crossing]
    sides = region_of[ends]
    middles_m = graph.positions_m[ends].mean(axis=1)
    ways = _side_by_side(np.sort(sides, axis=1), middles_m)
    neighbours: dict[int, list[int]] = {}
    transitions: dict[int, list[Transition]] = {}
    order = np.lexsort((crossing, -graph.clearances_m[crossing], ways))  # the widest edge of each way first
    for at in order[np.unique(ways[order], return_index=True)[1]].tolist():
        clearance_m = float(graph.clearances_m[crossing[at]])
        for inside, outside in ((0, 1), (1, 0)):
            region, other = int(sides[at, inside]), int(sides[at, outside])
            if region not in ids:
                continue
            way = Transition(
                region=other,
                edge=(int(graph.ids[ends[at, inside]]), int(graph.ids[ends[at, outside]])),
                position_m=_rounded(middles_m[at]),
                clearance_m=round(clearance_m, 2),
                door=clearance_m <= door_clearance_m,
            )
            transitions.setdefault(region, []).append(way)
            neighbours.setdefault(region, []).append(other)
    for region, ways_of in transitions.items():
        ways_of.sort(key=lambda way: (way.region, way.edge))
        neighbours[region] = sorted(set(neighbours[region]))
    return Border(neighbours, transitions)


@compiled()
def _crossing(starts, neighbours, edges, region_of, wanted):  # noqa: ANN001, ANN202
    """Numbers of the edges that leave a wanted region, some twice."""
    found = [np.int64(0) for _ in range(0)]
    for place in range(len(region_of)):
        if wanted[region_of[place]]:
            for arc in range(starts[place], starts[place + 1]):
                if region_of[neighbours[arc]] != region_of[place]:
                    found.append(np.int64(edges[arc]))
    return np.array(found, np.int64)


def _side_by_side(pairs: np.ndarray, middles_m: np.ndarray) -> np.ndarray:
    """Number (edge,) of the way of each edge: edges between the same regions with a chain of near middles share one."""
    count = len(pairs)
    if not count:
        return np.zeros(0, dtype=np.int64)
    near = scipy.spatial.cKDTree(middles_m).query_pairs(SIDE_BY_SIDE_M, output_type="ndarray")
    near = near[(pairs[near[:, 0]] == pairs[near[:, 1]]).all(axis=1)]
    graph = scipy.sparse.coo_matrix((np.ones(len(near), dtype=np.int8), near.T), shape=(count, count))
    return scipy.sparse.csgraph.connected_components(graph, directed=False)[1]


def members(
    objects: ObjectView, positions_m: np.ndarray, region_of: np.ndarray, rows: np.ndarray
) -> dict[int, list[int]]:
    """Ids of the objects in each region, as far as they stand near the places `rows`: an object belongs to the region
    of its nearest place, which is at most OBJECT_REACH_M away.
    """
    if not (len(rows) and len(objects.ids)):
        return {}
    low_m, high_m = positions_m[rows].min(axis=0) - OBJECT_REACH_M, positions_m[rows].max(axis=0) + OBJECT_REACH_M
    inside = np.flatnonzero(((objects.positions_m >= low_m) & (objects.positions_m <= high_m)).all(axis=1))
    around = ((positions_m >= low_m - OBJECT_REACH_M) & (positions_m <= high_m + OBJECT_REACH_M)).all(axis=1)
    places = np.flatnonzero(around)
    distances_m, nearest = scipy.spatial.cKDTree(positions_m[places]).query(
        objects.positions_m[inside], distance_upper_bound=OBJECT_REACH_M
    )
    found: dict[int, list[int]] = {}
    for item, place, distance_m in zip(inside.tolist(), nearest.tolist(), distances_m.tolist(), strict=True):
        if np.isfinite(distance_m):
            found.setdefault(int(region_of[places[place]]), []).append(int(objects.ids[item]))
    return {region: sorted(ids) for region, ids in found.items()}


def hull_m(positions_m: np.ndarray, radii_m: np.ndarray) -> list[tuple[float, float]]:
    """Convex outline of discs (n, 2 or 3) seen from above, counter-clockwise; a disc counts as an octagon around it."""
    angles = 2 * np.pi * (np.arange(HULL_CORNERS) + 0.5) / HULL_CORNERS
    corners = np.stack((np.cos(angles), np.sin(angles)), axis=1) / np.cos(np.pi / HULL_CORNERS)
    radii_m = np.maximum(radii_m, 0.01)  # a hull needs an area
    points = (positions_m[:, None, :2] + radii_m[:, None, None] * corners).reshape(-1, 2).astype(np.float64)
    outline = points[scipy.spatial.ConvexHull(points).vertices]
    return [(round(x, 2), round(y, 2)) for x, y in outline.tolist()]


def _rounded(point_m: np.ndarray) -> tuple[float, float, float]:
    x, y, z = point_m.tolist()
    return round(x, 2), round(y, 2), round(z, 2)

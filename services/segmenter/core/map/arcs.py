"""Which places touch which, as weighted arcs for compiled loops (pure)."""

from typing import NamedTuple

import numpy as np

from prior_sg.services.compiled import compiled


class Arcs(NamedTuple):
    """Every edge (u, v) as two arcs, u to v and v to u; the arcs of place p are starts[p] to starts[p + 1]."""

    starts: np.ndarray  # (place + 1,) int64
    neighbours: np.ndarray  # (arc,) int32 row at the arc's far end
    weights: np.ndarray  # (arc,) float64, of its edge
    twins: np.ndarray  # (arc,) int32 number of the opposite arc
    edges: np.ndarray  # (arc,) int32 number of its edge

    def weighing(self, weights: np.ndarray) -> "Arcs":
        """The same arcs with the weights (edge,) of their edges."""
        return self._replace(weights=weights[self.edges])


def arcs_of(places: int, edges: np.ndarray, weights: np.ndarray) -> Arcs:
    """The arcs of `edges` (edge, 2) with their `weights` (edge,); linear in places and edges."""
    edges = np.ascontiguousarray(edges, dtype=np.int64).reshape(-1, 2)
    return Arcs(*_build(places, edges, np.ascontiguousarray(weights, dtype=np.float64)))


def arcs_from(near: Arcs, rows: np.ndarray) -> np.ndarray:
    """Numbers (n,) of the arcs that leave the places `rows`, place after place."""
    return _arcs_from(near.starts, rows)


def edges_between(near: Arcs, pairs: np.ndarray) -> np.ndarray:
    """Number (n,) of the edge between the rows of each of `pairs` (n, 2), -1 where there is none."""
    return _edges_between(near.starts, near.neighbours, near.edges, np.ascontiguousarray(pairs, dtype=np.int64))


def grown(near: Arcs, mask: np.ndarray) -> np.ndarray:
    """Mask (place,) of the places in `mask` and their neighbours."""
    return _grown(near.starts, near.neighbours, mask)


def no_arcs() -> Arcs:
    """Of no places; compiles nothing."""
    none = np.zeros(0, np.int32)
    return Arcs(np.zeros(1, np.int64), none, np.zeros(0), none, none)


@compiled()
def _build(places, edges, weights):  # noqa: ANN001, ANN202
    """Counting sort; an edge from a place to itself costs nothing (the diagonal is zero) and is left out."""
    starts = np.zeros(places + 1, np.int64)
    for edge in range(len(edges)):
        if edges[edge, 0] != edges[edge, 1]:
            starts[edges[edge, 0] + 1] += 1
            starts[edges[edge, 1] + 1] += 1
    for place in range(places):
        starts[place + 1] += starts[place]
    fill = starts[:-1].copy()
    arcs = starts[-1]
    neighbours, twins, numbers = np.empty(arcs, np.int32), np.empty(arcs, np.int32), np.empty(arcs, np.int32)
    arc_weights = np.empty(arcs)
    for edge in range(len(edges)):
        u, v = edges[edge, 0], edges[edge, 1]
        if u == v:
            continue
        there, back = fill[u], fill[v]
        fill[u] += 1
        fill[v] += 1
        neighbours[there], neighbours[back] = v, u
        arc_weights[there] = weights[edge]
        arc_weights[back] = weights[edge]
        twins[there], twins[back] = back, there
        numbers[there], numbers[back] = edge, edge
    return starts, neighbours, arc_weights, twins, numbers


@compiled()
def _arcs_from(starts, rows):  # noqa: ANN001, ANN202
    count = 0
    for row in rows:
        count += starts[row + 1] - starts[row]
    found = np.empty(count, np.int64)
    count = 0
    for row in rows:
        for arc in range(starts[row], starts[row + 1]):
            found[count] = arc
            count += 1
    return found


@compiled()
def _edges_between(starts, neighbours, edges, pairs):  # noqa: ANN001, ANN202
    found = np.full(len(pairs), -1, np.int64)
    for index in range(len(pairs)):
        place, other = pairs[index]
        for arc in range(starts[place], starts[place + 1]):
            if neighbours[arc] == other:
                found[index] = edges[arc]
    return found


@compiled()
def _grown(starts, neighbours, mask):  # noqa: ANN001, ANN202
    after = mask.copy()
    for place in range(len(mask)):
        if mask[place]:
            for arc in range(starts[place], starts[place + 1]):
                after[neighbours[arc]] = True
    return after


@compiled()
def ball(centers, reach, starts, neighbours, inside):  # noqa: ANN001, ANN201
    """Rows, ascending, within `reach` steps of `centers`; `inside` is scratch, all False before and after."""
    found = np.empty(len(inside), np.int64)
    count = 0
    for place in centers:
        if not inside[place]:
            inside[place] = True
            found[count] = place
            count += 1
    first = 0
    for _ in range(reach):
        last = count
        for index in range(first, last):
            for arc in range(starts[found[index]], starts[found[index] + 1]):
                neighbour = neighbours[arc]
                if not inside[neighbour]:
                    inside[neighbour] = True
                    found[count] = neighbour
                    count += 1
        first = last
    for index in range(count):
        inside[found[index]] = False
    return np.sort(found[:count])


@compiled()
def spread(row, labels, starts, neighbours, number_of, members, count):  # noqa: ANN001, ANN201, PLR0917
    """Number all places that chains of places with the label of `row` join to it, unless it has a number already.

    They are put into `members` from `count` on, which is also their number; returns how many are there now. `number_of`
    (place,) is -1 where there is none yet.
    """
    if number_of[row] >= 0:
        return count
    number, index = count, count
    number_of[row], members[count] = number, row
    count += 1
    while index < count:
        place = members[index]
        for arc in range(starts[place], starts[place + 1]):
            other = neighbours[arc]
            if number_of[other] < 0 and labels[other] == labels[place]:
                number_of[other], members[count] = number, other
                count += 1
        index += 1
    return count


@compiled()
def joined(labels, near, rows):  # noqa: ANN001, ANN201
    """Places (n,), ascending, that chains of places with one label join to any of `rows` or of their neighbours, and
    the edges (m, 2) between those of one label, as numbers into them."""
    starts, neighbours = near.starts, near.neighbours
    number_of, members, count = np.full(len(labels), -1), np.empty(len(labels), np.int64), 0
    for row in rows:
        count = spread(row, labels, starts, neighbours, number_of, members, count)
        for arc in range(starts[row], starts[row + 1]):
            count = spread(neighbours[arc], labels, starts, neighbours, number_of, members, count)
    places, arcs = np.sort(members[:count]), 0
    for number in range(count):
        number_of[places[number]] = number
        arcs += starts[places[number] + 1] - starts[places[number]]
    edges, found = np.empty((arcs, 2), np.int64), 0
    for number in range(count):
        for arc in range(starts[places[number]], starts[places[number] + 1]):
            other = neighbours[arc]
            if other > places[number] and labels[other] == labels[places[number]]:
                edges[found, 0], edges[found, 1] = number, number_of[other]
                found += 1
    return places, edges[:found]

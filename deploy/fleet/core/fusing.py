"""Places of several maps in one frame: which are one, and what leads from one map to the other (pure)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from prior_sg.deploy.fleet.core.finding.shape import Shape
from prior_sg.deploy.fleet.core.ids import Name
from prior_sg.schemas.scene import Scene
from prior_sg.services.geometry import transform

ONE_M, ALIKE_M = 0.45, 0.3  # places are one within that distance, when their radii differ by less
BESIDE_M = 0.9  # a place of another map that near tells of the same spot
JOINED = 2  # edges that lead from a place to places of other maps, at most
LEAST_LENS_M = 0.25  # radius of the circle in which the balls at both ends of such an edge meet
FLOOR_M = 1.0  # balls whose lowest points differ by more stand on two floors: they meet in the slab, or over a table
CLOSED_M = 0.3  # behind an opening, free space of another map closes it


class Placed(NamedTuple):
    """One map in the fleet's frame."""

    name: Name
    scene: Scene
    fleet_from_own: np.ndarray  # (4, 4)
    place_ids: np.ndarray  # (place,) the fleet's, in the order of the scene's places


@dataclass(frozen=True)
class Fused:
    """Nodes of the merged graph, sorted by id."""

    ids: np.ndarray  # (node,)
    positions_m: np.ndarray  # (node, 3)
    radii_m: np.ndarray  # (node,)
    basis_points: np.ndarray  # (node,)
    edges: np.ndarray  # (edge, 2) rows, smaller first, sorted
    clearances_m: np.ndarray  # (edge,)
    node_of: list[np.ndarray]  # by map: node (place,) of each place
    beside: list[list[np.ndarray]]  # by map and other map: the row (place,) of the other's place beside, -1 = none


def fused(maps: Sequence[Placed]) -> Fused:
    """One graph of all maps. Of places that are one, the node lies where the map says that comes first."""
    positions_m = [transform(one.fleet_from_own, one.scene.positions_m.astype(float)) for one in maps]
    radii_m = [one.scene.radii_m.astype(float) for one in maps]
    sizes = [len(one.place_ids) for one in maps]
    starts = np.concatenate(([0], np.cumsum(sizes))).astype(np.int64)
    every_m, every_r = np.concatenate(positions_m), np.concatenate(radii_m)
    leader = np.arange(len(every_m))
    beside = [[np.full(size, -1) for _ in maps] for size in sizes]
    for later in range(len(maps)):
        for earlier in range(later):
            _beside(beside, positions_m, radii_m, earlier, later)
            near = _one(positions_m, radii_m, earlier, later)
            for row, other in near:
                if leader[starts[later] + row] == starts[later] + row:
                    leader[starts[later] + row] = leader[starts[earlier] + other]
    ids = np.concatenate([one.place_ids for one in maps])
    leaders, node = np.unique(leader, return_inverse=True)
    smallest = np.full(len(leaders), np.iinfo(np.int64).max)
    np.minimum.at(smallest, node, ids)
    order = np.argsort(smallest)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    node = rank[node]
    heads = leaders[order]
    node_of = [node[starts[k] : starts[k + 1]] for k in range(len(maps))]
    owner = np.repeat(np.arange(len(maps)), sizes)[heads]
    basis = np.concatenate([one.scene.basis_points for one in maps])[heads]
    inner, clear = _inner_edges(maps, node_of)
    outer, lens = _outer_edges(every_m[heads], every_r[heads], owner)
    edges, clearances_m = _unique(np.concatenate((inner, outer)), np.concatenate((clear, lens)))
    return Fused(smallest[order], every_m[heads], every_r[heads], basis, edges, clearances_m, node_of, beside)


def openings(maps: Sequence[Placed], found: Fused) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nodes, directions and areas of openings behind which no map knows free space."""
    shapes = [
        Shape(transform(one.fleet_from_own, one.scene.positions_m.astype(float)), one.scene.radii_m) for one in maps
    ]
    nodes, directions, areas = [], [], []
    for number, one in enumerate(maps):
        rows = np.searchsorted(one.scene.place_ids, one.scene.frontier_ids)
        out = one.scene.frontier_directions.astype(float) @ one.fleet_from_own[:3, :3].T
        behind_m = shapes[number].centers_m[rows] + out * (one.scene.radii_m[rows, None] + CLOSED_M)
        closed = np.zeros(len(rows), bool)
        for other, shape in enumerate(shapes):
            if other != number and len(shape.radii_m) and len(rows):
                closed |= shape.depth_m(behind_m) > 0
        nodes.append(found.node_of[number][rows[~closed]])
        directions.append(out[~closed])
        areas.append(one.scene.frontier_areas_m2[~closed])
    node, first = np.unique(np.concatenate(nodes).astype(np.int64), return_index=True)
    return node, np.concatenate(directions).reshape(-1, 3)[first], np.concatenate(areas)[first]


def _beside(
    beside: list[list[np.ndarray]], positions_m: list[np.ndarray], radii_m: list[np.ndarray], one: int, other: int
) -> None:
    """The nearest place of each map beside each place of the other, where the other knows free space there."""
    for here, there in ((one, other), (other, one)):
        if not (len(radii_m[here]) and len(radii_m[there])):
            continue
        distances_m, rows = cKDTree(positions_m[there]).query(positions_m[here])
        free = distances_m < np.minimum(np.maximum(radii_m[there][rows], ONE_M), BESIDE_M)
        beside[here][there][:] = np.where(free, rows, -1)


def _one(positions_m: list[np.ndarray], radii_m: list[np.ndarray], earlier: int, later: int) -> list[tuple[int, int]]:
    """Pairs (row of later, row of earlier) that are one place, each at most once, the nearest first."""
    if not (len(radii_m[earlier]) and len(radii_m[later])):
        return []
    near = cKDTree(positions_m[later]).query_ball_tree(cKDTree(positions_m[earlier]), ONE_M)
    pairs = [(row, other) for row, others in enumerate(near) for other in others]
    if not pairs:
        return []
    rows, others = np.array(pairs).T
    alike = np.abs(radii_m[later][rows] - radii_m[earlier][others]) < ALIKE_M
    rows, others = rows[alike], others[alike]
    gaps_m = np.linalg.norm(positions_m[later][rows] - positions_m[earlier][others], axis=1)
    taken: tuple[set[int], set[int]] = (set(), set())
    found = []
    for at in np.argsort(gaps_m, kind="stable").tolist():
        row, other = int(rows[at]), int(others[at])
        if row not in taken[0] and other not in taken[1]:
            taken[0].add(row)
            taken[1].add(other)
            found.append((row, other))
    return found


def _inner_edges(maps: Sequence[Placed], node_of: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    ends = [
        nodes[np.searchsorted(one.scene.place_ids, one.scene.edges)].reshape(-1, 2)
        for one, nodes in zip(maps, node_of, strict=True)
    ]
    return np.concatenate(ends), np.concatenate([one.scene.clearances_m.astype(float) for one in maps])


def _outer_edges(centers_m: np.ndarray, radii_m: np.ndarray, owner: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Edges between nearby nodes of different maps whose balls meet in a circle wide enough to pass, on one floor."""
    bottoms_m = centers_m[:, 2] - radii_m
    edges, lenses = [], []
    for here in range(int(owner.max(initial=0)) + 1):
        mine, others = np.flatnonzero(owner == here), np.flatnonzero(owner < here)
        if not (len(mine) and len(others)):
            continue
        count = min(JOINED, len(others))
        distances_m, rows = cKDTree(centers_m[others]).query(centers_m[mine], k=count)
        distances_m, rows = distances_m.reshape(-1, count), rows.reshape(-1, count)
        pairs = np.column_stack((np.repeat(mine, count), others[rows.ravel()]))
        lens = lens_m(distances_m.ravel(), radii_m[pairs[:, 0]], radii_m[pairs[:, 1]])
        wide = (lens > LEAST_LENS_M) & (np.ptp(bottoms_m[pairs], axis=1) < FLOOR_M)
        edges.append(pairs[wide])
        lenses.append(lens[wide])
    if not edges:
        return np.zeros((0, 2), np.int64), np.zeros(0)
    return np.concatenate(edges), np.concatenate(lenses)


def lens_m(distances_m: np.ndarray, one_m: np.ndarray, other_m: np.ndarray) -> np.ndarray:
    """Radius (n,) of the circle in which two balls meet; the smaller's where it lies in the other; 0 apart."""
    small = np.minimum(one_m, other_m)
    along = (distances_m**2 + one_m**2 - other_m**2) / (2 * np.maximum(distances_m, 1e-9))
    circle = np.sqrt(np.maximum(one_m**2 - along**2, 0.0))
    inside = distances_m <= np.abs(one_m - other_m)
    beyond = ((along > distances_m) | (along < 0)) & ~inside  # the circle lies behind a centre: the smaller ball is it
    return np.where(inside | beyond, small, np.where(distances_m < one_m + other_m, circle, 0.0))


def _unique(edges: np.ndarray, clearances_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Each pair once, smaller row first, with the smallest clearance that any map tells."""
    edges = np.sort(edges.reshape(-1, 2), axis=1)
    keep = edges[:, 0] != edges[:, 1]
    edges, clearances_m = edges[keep], clearances_m[keep]
    order = np.lexsort((clearances_m, edges[:, 1], edges[:, 0]))
    edges, first = np.unique(edges[order], axis=0, return_index=True)
    return edges, clearances_m[order][first]

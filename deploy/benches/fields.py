"""Random fields as place graphs have them, for `prior-sg bench swap`.

Rooms of about 35 places on a grid per storey, edges between near places of one room and through doors, rows in the
order in which a robot would meet the places. Numbers follow the field of the sample home: six edges a place, weights
around 0.5, costs between labels from 0.2 to 6 (not a metric), the best label ahead of the second by about 0.5, some
rooms not observed.
"""

import numpy as np
from scipy.spatial import cKDTree

from prior_sg.services.segmenter.core.energy.mrf import Field

LABELS = 12
ROOM_M = 4.0
PLACES_PER_ROOM = 35
EDGE_M = 1.05
DOOR_SHARE = 0.7
OPEN_SHARE = 0.3  # rooms with two labels
UNSEEN_SHARE = 0.15


def place_field(places: int, rng: np.random.Generator, labels: int = LABELS) -> Field:
    """One field with exactly `places` places."""
    room, points_m = _places(places, rng)
    edges = _edges(room, points_m, rng)
    lengths_m = np.linalg.norm(points_m[edges[:, 0]] - points_m[edges[:, 1]], axis=1)
    weights = np.exp(-lengths_m / 2.0)
    sums = np.bincount(edges.reshape(-1), np.repeat(weights, 2), minlength=places)
    weights = 3.0 * weights / np.sqrt(sums[edges[:, 0]] * sums[edges[:, 1]])
    return Field(_unary(room, points_m, rng, labels), edges, weights, _pairwise(rng, labels))


def _places(places: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Room (place,) and position (place, 2) in its room's frame of the plan, room after room along a winding path."""
    rooms = -(-places // PLACES_PER_ROOM)
    room = np.sort(np.arange(places) % rooms)
    columns = max(1, int(np.sqrt(rooms)))
    row, column = np.divmod(np.arange(rooms), columns)
    column = np.where(row % 2, columns - 1 - column, column)
    inside_m = rng.uniform(0.1, ROOM_M - 0.1, (places, 2))
    order = np.lexsort((inside_m[:, 0] + inside_m[:, 1], room))
    return room, ROOM_M * np.stack((column, row), axis=1)[room] + inside_m[order]


def _edges(room: np.ndarray, points_m: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    near = cKDTree(points_m).query_pairs(EDGE_M, output_type="ndarray")
    across = room[near[:, 0]] != room[near[:, 1]]
    walls, doors = np.unique(np.sort(room[near[across]], axis=1), axis=0, return_inverse=True)
    is_open = rng.random(len(walls)) < DOOR_SHARE
    chosen = np.flatnonzero(across)[is_open[doors.reshape(-1)]]
    rank = rng.permutation(len(chosen))
    first = np.unique(np.sort(room[near[chosen]], axis=1)[rank], axis=0, return_index=True)[1]
    edges = np.sort(np.concatenate((near[~across], near[chosen[rank[first]]])), axis=1)
    return edges[np.lexsort(edges.T[::-1])].astype(np.int64)


def _unary(room: np.ndarray, points_m: np.ndarray, rng: np.random.Generator, labels: int) -> np.ndarray:
    """-confidence log P(label) of a weak encoder: one bias for all, one per room, one per place."""
    rooms = int(room.max()) + 1
    truth = rng.integers(0, labels, (rooms, 2))
    half = (points_m[:, 0] % ROOM_M > ROOM_M / 2) & (rng.random(rooms) < OPEN_SHARE)[room]
    scores = rng.normal(0, 0.25, labels) + rng.normal(0, 0.2, (rooms, labels))[room]
    scores = scores + rng.normal(0, 0.35, (len(room), labels))
    scores[np.arange(len(room)), truth[room, half.astype(int)]] += 0.8
    log_probabilities = scores - np.log(np.exp(scores).sum(axis=1, keepdims=True))
    confidence = np.where(rng.random(rooms) < UNSEEN_SHARE, 0.1, 2.8)[room]
    return -confidence[:, None] * log_probabilities


def _pairwise(rng: np.random.Generator, labels: int) -> np.ndarray:
    """-2 log P(ri <-> rj): a quarter of the pairs likely neighbours."""
    likely = rng.random((labels, labels)) < 0.25
    adjacency = np.where(likely, rng.uniform(0.4, 0.9, (labels, labels)), rng.uniform(0.05, 0.3, (labels, labels)))
    costs = np.triu(-2.0 * np.log(adjacency), 1)
    return costs + costs.T

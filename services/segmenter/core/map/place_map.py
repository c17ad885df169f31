"""The map: the place graph as followed, how firmly its edges bind, and what is known of each place (pure)."""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from prior_sg.schemas.places import PlaceDelta
from prior_sg.services.deltas import Follower
from prior_sg.services.segmenter.core.config import Config
from prior_sg.services.segmenter.core.map import inclination
from prior_sg.services.segmenter.core.map.arcs import Arcs, arcs_from, grown, no_arcs
from prior_sg.services.segmenter.core.map.frontiers import Frontiers
from prior_sg.services.segmenter.core.map.received import ReceivedGraph, Step, apply, with_neighbours
from prior_sg.services.segmenter.core.map.table import Places


class MapChange(NamedTuple):
    """What one delta changed."""

    step: Step
    gone_ids: np.ndarray  # (removed,) places that left
    gone_slots: np.ndarray  # (removed,) where their evidence is
    gone_regions: np.ndarray  # (removed,) the regions that they were in


@dataclass
class PlaceMap:
    """The place graph as followed, the weights of its edges, and the table of its places."""

    follower: Follower[PlaceDelta] = field(default_factory=Follower)
    epoch: int = -1  # of the graph's writer
    graph: ReceivedGraph = field(default_factory=ReceivedGraph)
    weights: np.ndarray = field(default_factory=lambda: np.zeros(0))  # (edge,) w_dist
    ties: Arcs = field(default_factory=no_arcs)  # those of the graph; an arc weighs w_dist of its edge
    places: Places = field(default_factory=Places.none)
    frontiers: Frontiers = field(default_factory=Frontiers)
    asked_snapshot: bool = False

    def take(self, delta: PlaceDelta) -> list[PlaceDelta]:
        """The deltas to apply now, in order."""
        if delta.snapshot:
            self.asked_snapshot = False
        return self.follower.take(delta)

    def ask_for_snapshot(self) -> bool:
        """Whether a snapshot is missing and not asked for yet; if so, it counts as asked for."""
        due = self.follower.needs_snapshot and not self.asked_snapshot
        self.asked_snapshot |= due
        return due

    def advance(self, delta: PlaceDelta, cfg: Config) -> MapChange:
        """Apply a delta, and mark the places around which it changed the graph."""
        replaces = delta.snapshot or delta.epoch != self.epoch
        step = apply(self.graph, delta, replaces)
        before, places, gone = self.graph, self.places, step.removed
        self.frontiers.follow(delta, before.ids[gone], replaces)
        change = MapChange(step, before.ids[gone], places.slots[gone], places.regions[gone])
        self.graph, self.epoch = step.graph, delta.epoch
        around = with_neighbours(self.graph, step.touched)
        if self.graph.edges is before.edges:
            self.weights, self.ties = reweighed(self.weights, self.ties, self.graph, around, cfg)
        else:
            self.weights = edge_weights(self.graph, cfg)
            self.ties = self.graph.arcs.weighing(self.weights)
        self.places = places.realigned(step)
        self.places.reshaped |= inclination.disturbed(before, step, cfg.geometry.neighbourhood_m)
        self.places.unsettled |= around
        self.places.unparted |= around
        self.places.unparted[step.upserted] = True
        self.places.unshared |= around
        self.places.unbelieved |= around
        self.places.doubtful |= step.moved
        return change

    def relabel(self, labels: int) -> None:
        """Nothing is known any more of any place under these so many labels."""
        self.places = self.places.relabelled(labels)


def edge_weights(graph: ReceivedGraph, cfg: Config) -> np.ndarray:
    """w_dist (edge,) of eq. pairwise_potential: falls with length, then scaled symmetrically.

    With w and the sums of w at both ends, d_u and d_v, the weight is edge_sum w / sqrt(d_u d_v): a place is held by its
    neighbours about as firmly in a dense graph of small rooms as in a sparse one of large halls.
    """
    first, second = graph.edges.T
    near = _nearness(graph.lengths_m, cfg)
    sums = np.bincount(graph.edges.reshape(-1), np.repeat(near, 2), minlength=len(graph.ids))
    return _scaled(near, sums[first], sums[second], graph.clearances_m, cfg)


def reweighed(
    weights: np.ndarray, ties: Arcs, graph: ReceivedGraph, around: np.ndarray, cfg: Config
) -> tuple[np.ndarray, Arcs]:
    """`edge_weights`, and the arcs that weigh so, after places or clearances changed and edges did not.

    `weights` (edge,) and `ties` are those before; mask `around` (place,) holds the ends of all edges whose length or
    clearance is another, and their neighbours: only the edges of these can weigh otherwise.
    """
    near = graph.arcs
    rows = np.flatnonzero(grown(near, around))
    at, degrees = arcs_from(near, rows), near.starts[rows + 1] - near.starts[rows]
    sources, nearness = np.repeat(rows, degrees), _nearness(near.weights[at], cfg)
    sums = np.zeros(len(graph.ids))
    sums[rows] = np.bincount(np.repeat(np.arange(len(rows)), degrees), nearness, minlength=len(rows))
    own = around[sources]
    at, sources, nearness = at[own], sources[own], nearness[own]
    edges = near.edges[at]
    now = _scaled(nearness, sums[sources], sums[near.neighbours[at]], graph.clearances_m[edges], cfg)
    weights, of_arcs = weights.copy(), ties.weights.copy()
    weights[edges] = of_arcs[at] = of_arcs[near.twins[at]] = now
    return weights, near._replace(weights=of_arcs)


def _nearness(lengths_m: np.ndarray, cfg: Config) -> np.ndarray:
    near = np.exp(-lengths_m / cfg.edge_decay_m)
    return np.maximum(near, np.finfo(float).tiny) if cfg.edge_sum > 0 else near


def _scaled(near: np.ndarray, here: np.ndarray, there: np.ndarray, clearances_m: np.ndarray, cfg: Config) -> np.ndarray:
    """w_dist of edges, from w and its sums at both ends."""
    weights = near
    if cfg.edge_sum > 0:
        weights = cfg.edge_sum * weights / (np.sqrt(here) * np.sqrt(there))
    if cfg.edge_clearance_m > 0:
        weights = weights * np.minimum(clearances_m / cfg.edge_clearance_m, 1.0)
    return weights

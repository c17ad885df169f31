"""Baseline Hydra rooms (Hughes et al. 2022, 2024): persistent homology of the place graph under growing obstacles.

Obstacles are dilated until doorways close; the components that last are rooms, and grow back over the rest.
"""

import heapq
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from prior_sg.schemas.regions import NO_REGION

from .common import NO_LABEL, Answer, Inputs, similarities


@dataclass(frozen=True)
class Config:
    """Hydra's values for Habitat scenes (filter PLATEAU, flood NEIGHBORS)."""

    min_dilation_m: float = 0.5
    max_dilation_m: float = 1.2
    min_component_size: int = 10  # places that a component needs to count
    min_room_size: int = 10  # places that a room needs to stay
    min_lifetime_ratio: float = 0.25  # of the longest lasting component count
    standardised: bool = True  # scale of the similarity that names rooms; Hydra itself does not name them


# Tuned on split dev (mean of F1_S and penalised mIoU_S, with our segmenter's concepts). Tried: min_dilation_m 0.3
# to 0.5; max_dilation_m 0.8, 1.2; min_component_size 5, 10, 15; min_lifetime_ratio 0.15, 0.25, 0.5.
TUNED = Config(min_dilation_m=0.4, min_component_size=5)


class Run(NamedTuple):
    """A stretch of dilations with one number of components."""

    components: int
    low_m: float  # edges of at least this clearance make the components
    lifetime_m: float


def segment(inputs: Inputs, cfg: Config) -> Answer:
    """Rooms by filtration and flood fill, each named by the mean descriptor of its places.

    Places that no room reaches, and those of rooms that are too small, stay without region.
    """
    regions = rooms(len(inputs.place_ids), inputs.edges, inputs.clearances_m, cfg)
    features, observed = inputs.descriptors
    labels = [NO_LABEL] * len(regions)
    for region in np.unique(regions[regions != NO_REGION]).tolist():
        members = np.flatnonzero(regions == region)
        if observed[members].any():
            mean = features[members[observed[members]]].mean(axis=0, keepdims=True)
            best = similarities(mean, inputs.text, cfg.standardised)[0].argmax()
            for row in members.tolist():
                labels[row] = inputs.names[best]
    return Answer(labels, regions)


def rooms(count: int, edges: np.ndarray, clearances_m: np.ndarray, cfg: Config) -> np.ndarray:
    """Room (place,) of `count` places joined by edges (edge, 2), numbered by each room's first seed place."""
    runs = filtration(count, edges, clearances_m, cfg)
    if not runs:
        return np.full(count, NO_REGION, np.int64)
    longest_m = max(run.lifetime_m for run in runs)
    lasting = [run for run in runs if run.lifetime_m >= cfg.min_lifetime_ratio * longest_m]
    threshold_m = max(lasting, key=lambda run: (run.components, -run.low_m)).low_m
    seeds = _seeds(count, edges[clearances_m >= threshold_m], cfg.min_component_size)
    labels = _flood(seeds, edges, clearances_m)
    sizes = np.bincount(labels[labels != NO_REGION], minlength=1)
    return np.where((labels != NO_REGION) & (sizes[labels] >= cfg.min_room_size), labels, NO_REGION)


def filtration(count: int, edges: np.ndarray, clearances_m: np.ndarray, cfg: Config) -> list[Run]:
    """Runs of a constant, positive number of large components over the dilations allowed, largest dilation first.

    Edges enter by falling clearance; the components formed once all edges of one clearance are in last until the next
    smaller clearance.
    """
    union = UnionFind(count, cfg.min_component_size)
    order = np.argsort(-clearances_m, kind="stable")
    levels_m, starts = np.unique(-clearances_m[order], return_index=True)
    levels_m = -levels_m
    ends_m = np.append(levels_m[1:], 0.0)
    runs: list[Run] = []
    for level_m, end_m, batch in zip(levels_m.tolist(), ends_m.tolist(), np.split(order, starts[1:]), strict=True):
        for a, b in edges[batch].tolist():
            union.join(a, b)
        lifetime_m = min(level_m, cfg.max_dilation_m) - max(end_m, cfg.min_dilation_m)
        if lifetime_m <= 0:
            continue
        if runs and runs[-1].components == union.large:
            runs[-1] = Run(union.large, level_m, runs[-1].lifetime_m + lifetime_m)
        else:
            runs.append(Run(union.large, level_m, lifetime_m))
    return [run for run in runs if run.components]


class UnionFind:
    """Components under joining, and how many have at least `large_size` members."""

    def __init__(self, count: int, large_size: int) -> None:
        self._parents = list(range(count))
        self._sizes = [1] * count
        self._large_size = large_size
        self.large = count if large_size <= 1 else 0

    def find(self, node: int) -> int:
        """The smallest member of the node's component."""
        while self._parents[node] != node:
            self._parents[node] = self._parents[self._parents[node]]
            node = self._parents[node]
        return node

    def join(self, a: int, b: int) -> None:
        a, b = sorted((self.find(a), self.find(b)))
        if a == b:
            return
        size = self._sizes[a] + self._sizes[b]
        before = (self._sizes[a] >= self._large_size) + (self._sizes[b] >= self._large_size)
        self.large += (size >= self._large_size) - before
        self._parents[b], self._sizes[a] = a, size


def _seeds(count: int, edges: np.ndarray, min_size: int) -> np.ndarray:
    """Seed (place,): the number of the large component that holds each place, in the order of first places."""
    union = UnionFind(count, min_size)
    for a, b in edges.tolist():
        union.join(a, b)
    roots = np.array([union.find(node) for node in range(count)], np.int64)
    sizes = np.bincount(roots, minlength=count)
    names = np.cumsum((np.arange(count) == roots) & (sizes[roots] >= min_size)) - 1
    return np.where(sizes[roots] >= min_size, names[roots], NO_REGION)


def _flood(seeds: np.ndarray, edges: np.ndarray, clearances_m: np.ndarray) -> np.ndarray:
    """Seeds grown over the graph, always along the widest edge that leaves them; ties to the earlier places."""
    links: list[list[tuple[float, int]]] = [[] for _ in seeds]
    for (a, b), clearance_m in zip(edges.tolist(), clearances_m.tolist(), strict=True):
        links[a].append((clearance_m, b))
        links[b].append((clearance_m, a))
    labels = seeds.copy()
    frontier = [(-width, a, b) for a in np.flatnonzero(seeds != NO_REGION).tolist() for width, b in links[a]]
    heapq.heapify(frontier)
    while frontier:
        _, a, b = heapq.heappop(frontier)
        if labels[b] != NO_REGION:
            continue
        labels[b] = labels[a]
        for width, other in links[b]:
            heapq.heappush(frontier, (-width, b, other))
    return labels

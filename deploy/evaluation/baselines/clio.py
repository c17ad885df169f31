"""Baseline Clio (Maggio et al. 2024): regions by agglomerative information bottleneck on the place graph.

Every image has one embedding, which every place inside its frustum receives, hidden or not; places are then clustered
by what their mean embedding says about the tasks, here the region names.
"""

import heapq
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from prior_sg.schemas.regions import NO_REGION
from prior_sg.services.geometry import inverse, project, transform

from .common import NO_LABEL, Answer, Inputs, similarities

EPSILON = 1e-12  # score of a task that does not count


@dataclass(frozen=True)
class Config:
    """Clio's values for regions; thresholds are cosines of ViT-L/14."""

    score_threshold: float = 0.21  # score of the null task; regions below it stay unnamed
    max_delta: float = 0.01  # share of the mutual information that one merge may lose
    top_k: int = 2  # ranks that are accumulated: the best counts top_k times, the next once less
    null_task_preprune: bool = True  # a place nearest to the null task says nothing about the others
    standardised: bool = False  # scores in standard deviations above the background instead of cosines
    min_depth_m: float = 0.3  # frustum; Clio takes these from its sensor, we use our kernel's
    max_depth_m: float = 10.0


# Tuned on split dev (mean of F1_S and penalised mIoU_S, with our segmenter's concepts) for our encoder, whose
# cosines have another scale and offset per concept than ViT-L's. Tried: standardised, score_threshold 2 to 5,
# max_delta 0.005 to 0.05, max_depth_m 3, 5, 10; cosines, score_threshold 0.1 to 0.3, max_delta 0.005 to 0.03,
# max_depth_m 3, 5. A threshold of 2 leaves nearly all above the null task.
TUNED = Config(standardised=True, score_threshold=2.0, max_delta=0.02, max_depth_m=5.0)


def segment(inputs: Inputs, cfg: Config) -> Answer:
    """Mean global features, information bottleneck, name by the best task at or above the threshold.

    Places in no frustum have no feature and stay without region, unnamed regions keep their places.
    """
    features, seen = place_features(inputs, cfg)
    rows = np.flatnonzero(seen)
    distributions = task_distributions(similarities(features[rows], inputs.text, cfg.standardised), cfg)
    number = np.full(len(seen), NO_REGION, np.int64)
    number[rows] = np.arange(len(rows))
    edges = number[inputs.edges]
    clusters = bottleneck(distributions, edges[(edges >= 0).all(axis=1)], cfg.max_delta)
    regions = np.full(len(seen), NO_REGION, np.int64)
    regions[rows] = clusters
    labels = [NO_LABEL] * len(seen)
    for region in np.unique(clusters).tolist():
        members = np.flatnonzero(regions == region)
        scores = similarities(features[members].mean(axis=0, keepdims=True), inputs.text, cfg.standardised)[0]
        name = inputs.names[scores.argmax()] if scores.max() >= cfg.score_threshold else NO_LABEL
        for row in members.tolist():
            labels[row] = name
    return Answer(labels, regions)


def place_features(inputs: Inputs, cfg: Config) -> tuple[np.ndarray, np.ndarray]:
    """Plain mean (place, dim) of the embeddings of the views whose frustum holds the place's centre, and whether there
    is any (place,). No occlusion test. Clio averages over the views of its active window, we over all."""
    views = inputs.views
    sums = np.zeros((len(inputs.place_ids), views.embeddings.shape[1]))
    counts = np.zeros(len(inputs.place_ids))
    for pyramid, embedding in zip(views.pyramids, views.embeddings, strict=True):
        camera = pyramid.intrinsics
        pixels, depths_m = project(transform(inverse(pyramid.world_from_camera), inputs.positions_m), camera)
        inside = (depths_m >= cfg.min_depth_m) & (depths_m <= cfg.max_depth_m)
        inside &= ((pixels >= -0.5) & (pixels < (camera.width_px - 0.5, camera.height_px - 0.5))).all(axis=1)
        sums[inside] += embedding
        counts += inside
    return sums / np.maximum(counts, 1)[:, None], counts > 0


def task_distributions(scores: np.ndarray, cfg: Config) -> np.ndarray:
    """p(y | x) (place, 1 + task) from scores (place, task); column 0 is the null task.

    Ranks are accumulated: with top_k = 2 the best task counts twice and the second once. Standardised scores can be
    negative, and such a task counts as none.
    """
    with_null = np.column_stack((np.full(len(scores), cfg.score_threshold), scores))
    order = np.argsort(-with_null, axis=1, kind="stable")
    times = np.zeros_like(with_null)
    for rank in range(min(cfg.top_k, with_null.shape[1])):
        times[np.arange(len(scores)), order[:, rank]] = cfg.top_k - rank
    mass = np.maximum(times * with_null, EPSILON)
    if cfg.null_task_preprune:
        mass[order[:, 0] == 0, 1:] = EPSILON
    return mass / mass.sum(axis=1, keepdims=True)


def bottleneck(distributions: np.ndarray, edges: np.ndarray, max_delta: float) -> np.ndarray:
    """Cluster (place,), named by its first place, after greedy merges along edges (edge, 2) of the graph.

    p(x) and p(y) are uniform, so the information that a merge loses is exactly its edge's score and a heap finds the
    cheapest one; merging stops before the first that loses `max_delta` of I(X; Y) or more.
    """
    weights = np.full(len(distributions), 1 / max(len(distributions), 1))
    clusters = Clusters(distributions.copy(), weights, _neighbours(len(distributions), edges))
    total = information(distributions, weights)
    heap = [(clusters.cost(a, b), a, b, 0, 0) for a, b in clusters.pairs()]
    heapq.heapify(heap)
    while heap:
        cost, a, b, version_a, version_b = heapq.heappop(heap)
        if (version_a, version_b) != (clusters.version(a), clusters.version(b)):
            continue
        if total <= 0 or cost / total >= max_delta:
            break
        clusters.merge(a, b)
        for other in clusters.neighbours[a]:
            low, high = min(a, other), max(a, other)
            heapq.heappush(heap, (clusters.cost(low, high), low, high, clusters.version(low), clusters.version(high)))
    return clusters.owner()


def information(distributions: np.ndarray, weights: np.ndarray) -> float:
    """I(C; Y) in nats with uniform p(y): sum over c of p(c) KL(p(y | c) || p(y))."""
    ratios = distributions * distributions.shape[1]
    return float(weights @ (distributions * np.log(ratios)).sum(axis=1))


class Clusters:
    """A partition of the places under merging; a cluster's name is its smallest place, gone ones have version -1."""

    def __init__(self, distributions: np.ndarray, weights: np.ndarray, neighbours: list[set[int]]) -> None:
        self.distributions = distributions  # (place, 1 + task), rows of living clusters count
        self.weights = weights  # (place,)
        self.neighbours = neighbours
        self._versions = [0] * len(weights)
        self._parents = list(range(len(weights)))

    def version(self, cluster: int) -> int:
        return self._versions[cluster]

    def pairs(self) -> Iterator[tuple[int, int]]:
        """Neighbouring clusters, smaller first, in order."""
        for low, others in enumerate(self.neighbours):
            yield from ((low, high) for high in sorted(others) if high > low)

    def mixture(self, a: int, b: int) -> np.ndarray:
        """p(y | a and b merged)."""
        weight_a, weight_b = self.weights[a], self.weights[b]
        return (weight_a * self.distributions[a] + weight_b * self.distributions[b]) / (weight_a + weight_b)

    def cost(self, a: int, b: int) -> float:
        """(p(a) + p(b)) times the Jensen-Shannon divergence of their distributions, weighted by p(a) and p(b)."""
        log_mixture = np.log(self.mixture(a, b))
        pair = self.distributions[[a, b]]
        return float(self.weights[[a, b]] @ (pair * (np.log(pair) - log_mixture)).sum(axis=1))

    def merge(self, a: int, b: int) -> None:
        """Cluster b becomes part of a, which is smaller."""
        self.distributions[a] = self.mixture(a, b)
        self.weights[a] += self.weights[b]
        self.weights[b] = 0.0
        for other in self.neighbours[b]:
            self.neighbours[other].remove(b)
            if other != a:
                self.neighbours[other].add(a)
                self.neighbours[a].add(other)
        self.neighbours[b] = set()
        self._versions[a] += 1
        self._versions[b] = -1
        self._parents[b] = a

    def owner(self) -> np.ndarray:
        """Cluster (place,) of each place."""
        found = np.arange(len(self._parents))
        for place, parent in enumerate(self._parents):
            found[place] = found[parent]
        return found


def _neighbours(count: int, edges: np.ndarray) -> list[set[int]]:
    neighbours: list[set[int]] = [set() for _ in range(count)]
    for a, b in edges.tolist():
        neighbours[a].add(b)
        neighbours[b].add(a)
    return neighbours

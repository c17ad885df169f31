"""What several robots together believe of each place's label (pure).

Of robots that saw one spot the mean of the log beliefs counts, by how much of it each knows: they looked at the same
walls, and a robot's own many looks count as their mean, too. These means are the costs of a field over all places, with
the segmenter's edges, borders and price of a region, whose best labels are those of the merged map. A map that is alone
keeps what its robot tells.

What a robot believes holds the pull of its own neighbours already. Whoever knew how much its segmenter doubts itself
could take that out, but robots do not tell; a wrong guess ruins the labels, and left in, it costs nothing.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from prior_sg.deploy.fleet.core.fusing import Fused, Placed
from prior_sg.schemas.scene import Scene
from prior_sg.services.segmenter.core.config import Config
from prior_sg.services.segmenter.core.energy.mrf import Field
from prior_sg.services.segmenter.core.energy.region_cost import consolidated
from prior_sg.services.segmenter.core.energy.solver import Solver
from prior_sg.services.segmenter.core.map.place_map import edge_weights
from prior_sg.services.segmenter.core.map.received import ReceivedGraph

CFG = Config()  # what a segmenter does that nobody has told otherwise
FLOOR = 1e-3  # of any label's probability; what is below is not told when it changes
LEAST_KNOWN = 1e-3  # of a place that no robot has looked at


class Believed(NamedTuple):
    """By node."""

    names: list[str]
    labels: np.ndarray  # (node,) number among the names, -1 = none
    posteriors: np.ndarray  # (node, name)
    unknown: np.ndarray  # (node,)
    predicted: np.ndarray  # (node,) bool


def believed(maps: Sequence[Placed], found: Fused) -> Believed:
    """Labels and beliefs of all nodes."""
    names = sorted({label for one in maps for label in one.scene.labels})
    count = len(found.ids)
    if not names:
        return Believed([], np.full(count, -1), np.zeros((count, 0)), np.ones(count), np.zeros(count, bool))
    labels, unknown, predicted = np.full(count, -1), np.ones(count), np.ones(count, bool)
    for number, one in reversed(list(enumerate(maps))):
        nodes, own = found.node_of[number], _labels(one.scene, names)
        np.minimum.at(unknown, nodes, one.scene.unknown.astype(float))
        predicted[nodes] &= np.isin(one.scene.place_ids, one.scene.predicted_ids)
        labels[nodes] = np.where(own >= 0, own, labels[nodes])
    logs = _together(maps, found, names)
    posteriors = np.exp(logs - logs.max(axis=1, keepdims=True))
    posteriors /= posteriors.sum(axis=1, keepdims=True)
    if len(maps) > 1:
        labels = _settled(labels, -CFG.temperature * logs, found)
    return Believed(names, labels, posteriors, unknown, predicted)


def _labels(scene: Scene, names: list[str]) -> np.ndarray:
    """Label (place,) of each place of a map, -1 = none."""
    calls = {region.id: names.index(region.label) for region in scene.regions if region.label in names}
    return np.array([calls.get(region, -1) for region in scene.place_regions.tolist()], np.int64)


def _told(scene: Scene, names: list[str]) -> np.ndarray:
    """A robot's log beliefs (place, name), over all names."""
    told = np.zeros((len(scene.place_ids), len(names)))
    told[:, [names.index(label) for label in scene.labels]] = scene.posteriors
    return np.asarray(np.log(np.maximum(told / np.maximum(told.sum(axis=1, keepdims=True), FLOOR), FLOOR)))


def _together(maps: Sequence[Placed], found: Fused, names: list[str]) -> np.ndarray:
    """Mean log beliefs (node, name): of the places that a node is made of, and of places beside it in other maps."""
    sums, masses = np.zeros((len(found.ids), len(names))), np.zeros(len(found.ids))
    told = [_told(one.scene, names) for one in maps]
    known = [np.maximum(1 - one.scene.unknown.astype(float), LEAST_KNOWN) for one in maps]
    for number, nodes in enumerate(found.node_of):
        np.add.at(sums, nodes, known[number][:, None] * told[number])
        np.add.at(masses, nodes, known[number])
        for other, rows in enumerate(found.beside[number]):
            met = (rows >= 0) & ~np.isin(nodes, found.node_of[other])
            np.add.at(sums, nodes[met], known[other][rows[met], None] * told[other][rows[met]])
            np.add.at(masses, nodes[met], known[other][rows[met]])
    return np.asarray(sums / masses[:, None])


def _settled(labels: np.ndarray, unary: np.ndarray, found: Fused) -> np.ndarray:
    """Labels (node,) of the field over all nodes that have a label; the others keep none."""
    known = np.flatnonzero(labels >= 0)
    if not len(known):
        return labels
    rank = np.full(len(labels), -1)
    rank[known] = np.arange(len(known))
    inner = (rank[found.edges] >= 0).all(axis=1)
    edges = rank[found.edges[inner]].reshape(-1, 2)
    graph = ReceivedGraph(
        found.ids[known], found.positions_m[known], found.radii_m[known], edges, found.clearances_m[inner]
    )
    border = CFG.beta * CFG.adjacency.border * (1 - np.eye(unary.shape[1]))  # of which no prior says anything
    field = Field(unary[known], edges, edge_weights(graph, CFG), border)
    solver = Solver(CFG.solver)
    solver.update(field, labels[known])
    labels = labels.copy()
    labels[known] = consolidated(field, solver.drain(), CFG.region_cost)
    return labels

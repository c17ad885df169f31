"""What several robots together believe of each place's label (pure).

A robot tells of each place the Gibbs distribution of its segmenter's energy while the neighbours keep their labels. So
the energy follows from it, up to a constant; less what the neighbours pull, it is what the robot has seen there. Of
robots that saw one spot the mean counts, by how much of it each knows: they looked at the same walls, and a robot's own
many looks count as their mean, too. Over all places these make one field with the segmenter's edges, borders and costs
of a region, and labels and beliefs follow as a robot's do. A map that is alone keeps what its robot tells.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from prior_sg.deploy.fleet.core.fusing import Fused, Placed
from prior_sg.schemas.scene import Scene
from prior_sg.services.segmenter.core.config import Config
from prior_sg.services.segmenter.core.energy.mrf import Field
from prior_sg.services.segmenter.core.energy.posteriors import conditional_costs, posteriors
from prior_sg.services.segmenter.core.energy.region_cost import consolidated
from prior_sg.services.segmenter.core.energy.solver import Solver
from prior_sg.services.segmenter.core.map.arcs import arcs_of
from prior_sg.services.segmenter.core.map.place_map import edge_weights
from prior_sg.services.segmenter.core.map.received import ReceivedGraph

CFG = Config()  # what a segmenter does that nobody has told otherwise
TEMPERATURE = 8.0  # of the robots' posteriors, which is not told: about what segmenters with a weak encoder take
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
    told = [_told(one.scene, names) for one in maps]
    labels, unknown, predicted = np.full(count, -1), np.ones(count), np.ones(count, bool)
    held = np.zeros((count, len(names)))
    for number, one in reversed(list(enumerate(maps))):
        nodes, own = found.node_of[number], _labels(one.scene, names)
        np.minimum.at(unknown, nodes, one.scene.unknown.astype(float))
        predicted[nodes] &= np.isin(one.scene.place_ids, one.scene.predicted_ids)
        labels[nodes] = np.where(own >= 0, own, labels[nodes])
        held[nodes] = told[number]
    if len(maps) > 1 and (labels >= 0).any():
        seen = [_seen(one.scene, told[number], names) for number, one in enumerate(maps)]
        labels, held = _inferred(labels, held, _together(maps, found, seen), found)
    return Believed(names, labels, held, unknown, predicted)


def _told(scene: Scene, names: list[str]) -> np.ndarray:
    """A robot's beliefs (place, name), over all names."""
    told = np.zeros((len(scene.place_ids), len(names)))
    told[:, [names.index(label) for label in scene.labels]] = scene.posteriors
    told = np.maximum(told, FLOOR)
    return np.asarray(told / told.sum(axis=1, keepdims=True))


def _labels(scene: Scene, names: list[str]) -> np.ndarray:
    """Label (place,) of each place of a map, -1 = none."""
    calls = {region.id: names.index(region.label) for region in scene.regions if region.label in names}
    return np.array([calls.get(region, -1) for region in scene.place_regions.tolist()], np.int64)


def _seen(scene: Scene, told: np.ndarray, names: list[str]) -> np.ndarray:
    """Costs (place, name) of what a robot has seen: those of its beliefs, less what its neighbours pull."""
    edges = np.searchsorted(scene.place_ids, scene.edges).reshape(-1, 2)
    labels = _labels(scene, names)
    edges, clearances_m = (column[(labels[edges] >= 0).all(axis=1)] for column in (edges, scene.clearances_m))
    graph = ReceivedGraph(scene.place_ids, scene.positions_m.astype(float), scene.radii_m, edges, clearances_m)
    weights, border = edge_weights(graph, CFG), _border(len(names))
    costs = -TEMPERATURE * np.log(told)
    for here, there in ((0, 1), (1, 0)):
        np.add.at(costs, edges[:, here], -weights[:, None] * border[labels[edges[:, there]]])
    return costs - costs.min(axis=1, keepdims=True)


def _border(labels: int) -> np.ndarray:
    """Costs (label, label) of a border of which no prior is known to say anything."""
    return CFG.beta * CFG.adjacency.border * (1 - np.eye(labels))


def _together(maps: Sequence[Placed], found: Fused, seen: list[np.ndarray]) -> np.ndarray:
    """Mean costs (node, name): of the places that a node is made of, and of places beside it in the other maps."""
    sums, masses = np.zeros((len(found.ids), seen[0].shape[1])), np.zeros(len(found.ids))
    known = [np.maximum(1 - one.scene.unknown.astype(float), LEAST_KNOWN) for one in maps]
    for number, nodes in enumerate(found.node_of):
        np.add.at(sums, nodes, known[number][:, None] * seen[number])
        np.add.at(masses, nodes, known[number])
        for other, rows in enumerate(found.beside[number]):
            met = (rows >= 0) & ~np.isin(nodes, found.node_of[other])
            np.add.at(sums, nodes[met], known[other][rows[met], None] * seen[other][rows[met]])
            np.add.at(masses, nodes[met], known[other][rows[met]])
    return np.asarray(sums / masses[:, None])


def _inferred(labels: np.ndarray, held: np.ndarray, unary: np.ndarray, found: Fused) -> tuple[np.ndarray, np.ndarray]:
    """Labels and beliefs of the field over all nodes that have a label; the others keep none, and what is held."""
    known = np.flatnonzero(labels >= 0)
    rank = np.full(len(labels), -1)
    rank[known] = np.arange(len(known))
    inner = (rank[found.edges] >= 0).all(axis=1)
    edges = rank[found.edges[inner]].reshape(-1, 2)
    graph = ReceivedGraph(
        found.ids[known], found.positions_m[known], found.radii_m[known], edges, found.clearances_m[inner]
    )
    field = Field(unary[known], edges, edge_weights(graph, CFG), _border(unary.shape[1]))
    solver = Solver(CFG.solver)
    solver.update(field, labels[known])
    settled = consolidated(field, solver.drain(), CFG.region_cost)
    arcs = arcs_of(len(known), edges, field.weights)
    costs = conditional_costs(field, arcs, settled, np.arange(len(known)))
    labels, held = labels.copy(), held.copy()
    labels[known], held[known] = settled, posteriors(costs, TEMPERATURE)
    return labels, held

"""What several robots together believe of each place's label (pure).

Posteriors of robots that saw the same spot are multiplied and divided by the prior they share, the unknown mass of each
counting as the prior. A place keeps the label of its robot's region where nobody else has seen it; elsewhere the joint
belief names it. Then neighbours agree: a few rounds in which each place takes the label that its belief and the places
beside it, by the width of the way there, make likeliest.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from prior_sg.deploy.fleet.core.fusing import Fused, Placed

FLOOR = 1e-3  # of any label's probability, before it is multiplied
LEAST = 1e-4  # of any label's joint probability
ROUNDS = 5
NEIGHBOUR, OWN = 1.0, 1.0  # what a neighbour across an open way, and the label so far, are worth in log-likelihood
OPEN_M = 0.6  # clearance from which a way is open


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
    own = [_spread(one, names) for one in maps]
    logs, unknown = np.zeros((count, len(names))), np.ones(count)
    labels, seen, predicted = np.full(count, -1), np.zeros(count, int), np.ones(count, bool)
    for number, one in reversed(list(enumerate(maps))):
        nodes, joint = found.node_of[number], _joint(number, own, found.beside)
        np.add.at(logs, nodes, joint)
        np.add.at(seen, nodes, 1)
        np.minimum.at(unknown, nodes, one.scene.unknown.astype(float))
        predicted[nodes] &= np.isin(one.scene.place_ids, one.scene.predicted_ids)
        told = _labels(one, joint, names, found.beside[number])
        labels[nodes] = np.where(told >= 0, told, labels[nodes])
    logs /= np.maximum(seen, 1)[:, None]
    posteriors = np.exp(logs - logs.max(axis=1, keepdims=True))
    posteriors /= posteriors.sum(axis=1, keepdims=True)
    several = len(maps) > 1
    return Believed(names, _agreed(labels, posteriors, found) if several else labels, posteriors, unknown, predicted)


def _spread(one: Placed, names: list[str]) -> np.ndarray:
    """Log beliefs (place, name) with the unknown mass spread evenly."""
    scene = one.scene
    held = np.zeros((len(scene.place_ids), len(names)))
    held[:, [names.index(label) for label in scene.labels]] = scene.posteriors
    unknown = np.clip(scene.unknown.astype(float), 0, 1)[:, None]
    held = held * (1 - unknown) + unknown / len(names)
    return np.asarray(np.log(np.maximum(held / np.maximum(held.sum(axis=1, keepdims=True), 1e-9), FLOOR)))


def _joint(number: int, own: list[np.ndarray], beside: list[list[np.ndarray]]) -> np.ndarray:
    """Log belief (place, name) of one map's places with what the others believe beside them; the prior is even."""
    logs = own[number].copy()
    for other, rows in enumerate(beside[number]):
        met = rows >= 0
        logs[met] += own[other][rows[met]]
    return logs


def _labels(one: Placed, joint: np.ndarray, names: list[str], beside: list[np.ndarray]) -> np.ndarray:
    """Label (place,) of one map's places: its region's where no other map has a place, else by joint belief."""
    calls = {region.id: names.index(region.label) for region in one.scene.regions if region.label in names}
    own = np.array([calls.get(region, -1) for region in one.scene.place_regions.tolist()], np.int64)
    met = np.zeros(len(own), bool)
    for rows in beside:
        met |= rows >= 0
    return np.where(met & (own >= 0), joint.argmax(axis=1), own) if len(own) else own


def _agreed(labels: np.ndarray, posteriors: np.ndarray, found: Fused) -> np.ndarray:
    """Labels (node,) after neighbours were heard; a node without a label keeps none."""
    known = np.flatnonzero(labels >= 0)
    logs = np.log(np.maximum(posteriors, LEAST))
    logs[known, labels[known]] += OWN
    weights = NEIGHBOUR * np.minimum(found.clearances_m / OPEN_M, 1.0)
    now = labels
    for _ in range(ROUNDS):
        votes = np.zeros_like(logs)
        for here, there in ((0, 1), (1, 0)):
            heard = now[found.edges[:, there]] >= 0
            ends = found.edges[heard]
            np.add.at(votes, (ends[:, here], now[ends[:, there]]), weights[heard])
        then = np.where(labels >= 0, (logs + votes).argmax(axis=1), -1)
        if (then == now).all():
            break
        now = then
    return now

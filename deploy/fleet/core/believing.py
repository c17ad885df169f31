"""What several robots together believe of each place's label (pure).

Posteriors of robots that saw the same spot are multiplied and divided by the prior they share, the unknown mass of each
counting as the prior. Two regions that are one room seen twice are settled as a whole, each robot's mean belief of it
being one voice; where they merely overlap, each place is settled for itself.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from prior_sg.deploy.fleet.core.fusing import Fused, Placed
from prior_sg.schemas.regions import NO_REGION

FLOOR = 1e-3  # of any label's probability, before it is multiplied
ONE_ROOM = 0.6  # share of two regions' places beside each other, from which they are one room, whatever they are called
MET = 0.5  # the same of the places that lie beside the other map, when both are called alike
LEAST_MET = 3


class Believed(NamedTuple):
    """By node."""

    names: list[str]
    labels: np.ndarray  # (node,) number among the names, -1 = none
    posteriors: np.ndarray  # (node, name)
    unknown: np.ndarray  # (node,)
    predicted: np.ndarray  # (node,) bool


Room = tuple[int, int]  # number of the map, id of its region


def believed(maps: Sequence[Placed], found: Fused) -> Believed:
    """Labels and beliefs of all nodes."""
    names = sorted({label for one in maps for label in one.scene.labels})
    if not names:
        count = len(found.ids)
        none = np.zeros((count, 0))
        return Believed([], np.full(count, -1), none, np.ones(count), np.zeros(count, bool))
    own = [_spread(one, names) for one in maps]
    joint = [_joint(number, own, found.beside) for number in range(len(maps))]
    rooms = _rooms(maps, found, own)
    count = len(found.ids)
    logs, unknown = np.zeros((count, len(names))), np.ones(count)
    labels, seen, predicted = np.full(count, -1), np.zeros(count, int), np.ones(count, bool)
    for number, one in reversed(list(enumerate(maps))):
        nodes = found.node_of[number]
        np.add.at(logs, nodes, joint[number])
        np.add.at(seen, nodes, 1)
        np.minimum.at(unknown, nodes, one.scene.unknown.astype(float))
        predicted[nodes] &= np.isin(one.scene.place_ids, one.scene.predicted_ids)
        mine = {region: label for (k, region), label in rooms.items() if k == number}
        told = _labels(one, joint[number], names, mine, found.beside[number])
        labels[nodes] = np.where(told >= 0, told, labels[nodes])
    logs /= np.maximum(seen, 1)[:, None]
    posteriors = np.exp(logs - logs.max(axis=1, keepdims=True))
    posteriors /= posteriors.sum(axis=1, keepdims=True)
    return Believed(names, labels, posteriors, unknown, predicted)


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


def _rooms(maps: Sequence[Placed], found: Fused, own: list[np.ndarray]) -> dict[Room, int]:
    """The label of each region that is one room with another map's."""
    held = [{int(r): one.scene.place_regions == r for r in np.unique(one.scene.place_regions)} for one in maps]
    means = [
        {region: own[k][rows].mean(axis=0) for region, rows in regions.items() if region != NO_REGION}
        for k, regions in enumerate(held)
    ]
    group: dict[Room, set[Room]] = {(k, r): {(k, r)} for k, regions in enumerate(means) for r in regions}
    for later in range(len(maps)):
        for earlier in range(later):
            for one, other in _same_rooms(maps, found, held, earlier, later):
                joined = group[one] | group[other]
                for member in joined:
                    group[member] = joined
    return {
        room: int(np.argmax(sum(means[k][r] for k, r in sorted(members))))
        for room, members in group.items()
        if len(members) > 1
    }


def _same_rooms(
    maps: Sequence[Placed], found: Fused, held: list[dict[int, np.ndarray]], one: int, other: int
) -> list[tuple[Room, Room]]:
    """Regions of two maps that are each other's counterpart."""
    regions = maps[one].scene.place_regions, maps[other].scene.place_regions
    calls = [{region.id: region.label for region in maps[k].scene.regions} for k in (one, other)]
    shares: list[dict[tuple[int, int], tuple[float, float]]] = []
    for side, (here, there) in enumerate(((one, other), (other, one))):
        rows = found.beside[here][there]
        met = rows >= 0
        table: dict[tuple[int, int], tuple[float, float]] = {}
        mine, theirs = regions[side][met], regions[1 - side][rows[met]]
        for a, b in {*zip(mine.tolist(), theirs.tolist(), strict=True)}:
            both, of_a = int(((mine == a) & (theirs == b)).sum()), int((mine == a).sum())
            if both >= LEAST_MET and NO_REGION not in (a, b):
                table[a, b] = both / of_a, both / int(held[here][a].sum())
        shares.append(table)
    found_pairs = []
    for (a, b), (of_met, of_all) in shares[0].items():
        if (b, a) in shares[1]:
            met_b, all_b = shares[1][b, a]
            alike = calls[0].get(a) == calls[1].get(b) and min(of_met, met_b) >= MET
            if alike or min(of_all, all_b) >= ONE_ROOM:
                found_pairs.append(((one, a), (other, b)))
    return found_pairs


def _labels(
    one: Placed, joint: np.ndarray, names: list[str], rooms: dict[int, int], beside: list[np.ndarray]
) -> np.ndarray:
    """Label (place,) of one map's places: that of the room, else of the region where nobody objects, else of the joint
    belief."""
    calls = {region.id: names.index(region.label) for region in one.scene.regions if region.label in names}
    regions = one.scene.place_regions.tolist()
    own = np.array([calls.get(region, -1) for region in regions], np.int64)
    settled = np.array([rooms.get(region, -1) for region in regions], np.int64)
    met = np.zeros(len(own), bool)
    for rows in beside:
        met |= rows >= 0
    best = np.where(met & (own >= 0), joint.argmax(axis=1), own) if joint.size else own
    return np.where(settled >= 0, settled, best)

"""The levels above regions as they are known: nodes with ids that last (pure).

They follow the regions, so they are found again only when a region has changed, over all regions, which are few. What
they need of a region's places is summed up once, and again when that region has changed.
"""

from collections.abc import Mapping, Set
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from prior_sg.schemas.levels import LEVELS, NO_NODE, LevelName, LevelNode, regions_in
from prior_sg.schemas.regions import NO_REGION, Region
from prior_sg.services.segmenter.core.layers.alignment import Members
from prior_sg.services.segmenter.core.layers.pieces import near_regions
from prior_sg.services.segmenter.core.layers.stacking import Layer, LayersConfig, LevelInForce, layers_of
from prior_sg.services.segmenter.core.layers.storeys import Storeys
from prior_sg.services.segmenter.core.map.received import ReceivedGraph
from prior_sg.services.segmenter.core.map.table import Places
from prior_sg.services.segmenter.core.regions.components import track

NodeKey = tuple[LevelName, int]
MOST_COUNTED = 1000  # places of a region, where its weight for an id is counted


class Held(NamedTuple):
    """What a region holds."""

    belief: np.ndarray  # (label,) mean over its places
    ground_m2: np.ndarray  # (storey,) of its places
    others: np.ndarray  # (other,) ids, ascending, of regions of higher id that ways lead to
    ways: np.ndarray  # (other,) how wide these are together, as `alignment.Members` counts


@dataclass
class LayerMap:
    """Nodes by level and id, and which node of each level each region is in."""

    next_ids: dict[LevelName, int] = field(default_factory=dict)
    known: dict[NodeKey, LevelNode] = field(default_factory=dict)
    node_of: dict[LevelName, dict[int, int]] = field(default_factory=dict)  # node id by region id
    held: dict[int, Held] = field(default_factory=dict)  # by region id
    floors_m: np.ndarray = field(default_factory=lambda: np.zeros(0))  # (storey,) that `held` counts by

    def inherit(self, nodes: list[LevelNode], next_ids: Mapping[LevelName, int]) -> None:
        """These nodes were known before this process, and no id below these has yet to be given."""
        self.known = {(node.level, node.id): node for node in nodes}
        self.node_of = {level: regions_in(nodes, level) for level in LEVELS}
        for level in LEVELS:
            ids = [node.id + 1 for node in nodes if node.level == level]
            self.next_ids[level] = max([self.next_ids.get(level, 0), next_ids.get(level, 0), *ids])

    def renew(
        self,
        regions: Mapping[int, Region],
        graph: ReceivedGraph,
        places: Places,
        storeys: Storeys,
        *,
        levels: Mapping[str, LevelInForce],
        cfg: LayersConfig,
        changed: Set[int] | None = None,
    ) -> None:
        """Find all levels of these regions, of which only `changed` hold other places or beliefs than before; None =
        all may."""
        listed = [region for _, region in sorted(regions.items()) if region.place_count]
        several = max(len(storeys.floors_m), len(self.floors_m)) > 1
        if changed is None or (several and not np.array_equal(storeys.floors_m, self.floors_m)):
            self.held = {}
        self.floors_m = storeys.floors_m
        self.forget(changed or frozenset())
        asked = [region for region in listed if region.id not in self.held]
        self.held |= _held(asked, places, storeys, cfg.alignment.way_m)
        self.held = {region.id: self.held[region.id] for region in listed}
        members = _members(listed, list(self.held.values()), graph, places, cfg)
        layers = layers_of(members, _storeys(self.held), levels, cfg.alignment)
        counts = np.minimum([region.place_count for region in listed], MOST_COUNTED).astype(np.int64)
        former, self.node_of, ids = self.node_of, {}, {}
        for layer in layers:
            before = former.get(layer.level, {})
            previous = np.array([before.get(region.id, NO_REGION) for region in listed], np.int64)
            next_id = self.next_ids.get(layer.level, 0)
            ids[layer.level], self.next_ids[layer.level] = track(layer.groups, previous, next_id, counts)
            self.node_of[layer.level] = dict(
                zip([region.id for region in listed], ids[layer.level].tolist(), strict=True)
            )
        self.known = {(node.level, node.id): node for node in _nodes(listed, layers, ids)}

    def forget(self, regions: Set[int]) -> None:
        """These regions have changed, though no level was found again."""
        self.held = {number: one for number, one in self.held.items() if number not in regions}

    @property
    def zones(self) -> dict[int, str]:
        """Label of the zone that each region is in, by region id; empty where there are none."""
        return {region: self.known["zone", node].label for region, node in self.node_of.get("zone", {}).items()}


def _held(regions: list[Region], places: Places, storeys: Storeys, way_m: float) -> dict[int, Held]:
    """What each of the regions holds, by id."""
    ids = [region.id for region in regions]
    numbers, count = _numbers(ids, places), max(len(storeys.floors_m), 1)
    rows = np.flatnonzero(numbers[places.regions] >= 0)
    of_region = numbers[places.regions[rows]]
    beliefs = _means(places.posteriors[rows].astype(np.float64), of_region, len(ids))
    cells = of_region * count + storeys.of_place[rows]
    ground_m2 = np.bincount(cells, storeys.weights_m2[rows], minlength=len(ids) * count).reshape(-1, count)
    return {
        region.id: Held(belief, ground, *_ways(region, way_m))
        for region, belief, ground in zip(regions, beliefs, ground_m2, strict=True)
    }


def _ways(region: Region, way_m: float) -> tuple[np.ndarray, np.ndarray]:
    """The regions of higher id that ways lead to, and how wide these are together."""
    found: dict[int, float] = {}
    for way in region.transitions:
        if region.id < way.region:
            found[way.region] = found.get(way.region, 0.0) + min(way.clearance_m / way_m, 1.0)
    others = sorted(found)
    return np.array(others, np.int64), np.array([found[other] for other in others])


def _members(
    regions: list[Region], held: list[Held], graph: ReceivedGraph, places: Places, cfg: LayersConfig
) -> Members:
    """Regions as members of the level above: mean beliefs of their places, and the ways between them."""
    others = np.concatenate([np.zeros(0, np.int64), *(one.others for one in held)])
    ways = np.concatenate([np.zeros(0), *(one.ways for one in held)])
    here = np.repeat(np.arange(len(regions)), [len(one.others) for one in held])
    ids = np.array([region.id for region in regions], np.int64)
    there = np.searchsorted(ids, others)
    listed = np.isin(others, ids)
    known = np.stack((here[listed], there[listed]), axis=1)
    near = near_regions(graph, _rows(regions, places), known, len(regions), cfg.join_m)
    return Members(
        areas_m2=np.array([region.area_m2 for region in regions]),
        beliefs=np.array([one.belief for one in held]).reshape(len(regions), places.posteriors.shape[1]),
        edges=np.concatenate((known, near)),
        ways=np.concatenate((ways[listed], np.zeros(len(near)))),
    )


def _rows(regions: list[Region], places: Places) -> np.ndarray:
    """Row (place,) of the region of each place, -1 = none of these."""
    return _numbers([region.id for region in regions], places)[places.regions]


def _numbers(ids: list[int], places: Places) -> np.ndarray:
    """Where each region (region id,) comes in `ids`, -1 = not; the last entry is that of no region."""
    numbers = np.full(max(int(places.regions.max(initial=-1)), max(ids, default=-1)) + 2, -1)
    numbers[ids] = np.arange(len(ids))
    return numbers


def _means(values: np.ndarray, rows: np.ndarray, count: int) -> np.ndarray:
    """Mean (row, column) of the values (place, column) of each row."""
    sums = np.stack([np.bincount(rows, column, minlength=count) for column in values.T], axis=1)
    return sums / np.maximum(np.bincount(rows, minlength=count), 1)[:, None]


def _storeys(held: Mapping[int, Held]) -> np.ndarray:
    """The storey (region,) that most ground of each region is on; the lower of equals."""
    return np.array([one.ground_m2.argmax() for one in held.values()], np.int64)


def _nodes(regions: list[Region], layers: list[Layer], ids: dict[LevelName, np.ndarray]) -> list[LevelNode]:
    """The nodes of all levels, by level and id."""
    areas_m2 = np.array([region.area_m2 for region in regions])
    counts = np.array([region.place_count for region in regions], float)
    positions_m = np.array([region.position_m for region in regions])
    found = []
    members, of_region = "region", np.array([region.id for region in regions])
    for number, layer in enumerate(layers):
        own = ids[layer.level]
        above = ids[layers[number + 1].level] if number + 1 < len(layers) else np.full(len(own), NO_NODE)
        for node in np.unique(own).tolist():
            rows = np.flatnonzero(own == node)
            x, y, z = np.average(positions_m[rows], axis=0, weights=counts[rows]).round(2).tolist()
            group = int(layer.groups[rows[0]])
            found.append(
                LevelNode(
                    level=layer.level,
                    id=node,
                    label=layer.labels[group],
                    probability=round(float(layer.probabilities[group]), 2),
                    member_ids=np.unique(of_region[rows]).tolist(),
                    members=members,
                    area_m2=round(float(areas_m2[rows].sum()), 2),
                    position_m=(x, y, z),
                    parent_id=int(above[rows[0]]),
                )
            )
        members, of_region = layer.level, own
    return found

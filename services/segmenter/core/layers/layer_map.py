"""The levels above regions as they are known: nodes with ids that last (pure).

They follow the regions, so they are found again only when a region has changed, over all regions, which are few.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

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


@dataclass
class LayerMap:
    """Nodes by level and id, and which node of each level each region is in."""

    next_ids: dict[LevelName, int] = field(default_factory=dict)
    known: dict[NodeKey, LevelNode] = field(default_factory=dict)
    node_of: dict[LevelName, dict[int, int]] = field(default_factory=dict)  # node id by region id

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
    ) -> None:
        """Find all levels of these regions."""
        listed = [region for _, region in sorted(regions.items()) if region.place_count]
        members = _members(listed, graph, places, cfg)
        layers = layers_of(members, _storeys(listed, places, storeys), levels, cfg.alignment)
        counts = np.minimum([region.place_count for region in listed], MOST_COUNTED).astype(np.int64)
        former, self.node_of, ids = self.node_of, {}, {}
        for layer in layers:
            before = former.get(layer.level, {})
            previous = np.array([before.get(region.id, NO_REGION) for region in listed], np.int64)
            found, self.next_ids[layer.level] = track(
                np.repeat(layer.groups, counts), np.repeat(previous, counts), self.next_ids.get(layer.level, 0)
            )
            ids[layer.level] = found[np.cumsum(counts) - 1]  # of each region
            self.node_of[layer.level] = dict(
                zip([region.id for region in listed], ids[layer.level].tolist(), strict=True)
            )
        self.known = {(node.level, node.id): node for node in _nodes(listed, layers, ids)}

    def zone_of(self, region: int) -> str:
        """Label of the zone that a region is in; empty where there are none."""
        node = self.node_of.get("zone", {}).get(region)
        return "" if node is None else self.known["zone", node].label


def _members(regions: list[Region], graph: ReceivedGraph, places: Places, cfg: LayersConfig) -> Members:
    """Regions as members of the level above: mean beliefs of their places, and the ways between them."""
    way_m = cfg.alignment.way_m
    row = {region.id: number for number, region in enumerate(regions)}
    ways: dict[tuple[int, int], float] = {}
    for region in regions:
        for way in region.transitions:
            if region.id < way.region and way.region in row:
                pair = row[region.id], row[way.region]
                ways[pair] = ways.get(pair, 0.0) + min(way.clearance_m / way_m, 1.0)
    rows = _rows(regions, places)
    known = np.array(sorted(ways), np.int64).reshape(-1, 2)
    near = near_regions(graph, rows, known, len(regions), cfg.join_m)
    return Members(
        areas_m2=np.array([region.area_m2 for region in regions]),
        beliefs=_means(places.posteriors.astype(np.float64), rows, len(regions)),
        edges=np.concatenate((known, near)),
        ways=np.concatenate(([ways[pair] for pair in sorted(ways)], np.zeros(len(near)))),
    )


def _rows(regions: list[Region], places: Places) -> np.ndarray:
    """Row (place,) of the region of each place."""
    ids = np.array([region.id for region in regions], np.int64)
    return np.searchsorted(ids, places.regions)


def _means(values: np.ndarray, rows: np.ndarray, count: int) -> np.ndarray:
    """Mean (row, column) of the values (place, column) of each row."""
    sums = np.stack([np.bincount(rows, column, minlength=count) for column in values.T], axis=1)
    return sums / np.maximum(np.bincount(rows, minlength=count), 1)[:, None]


def _storeys(regions: list[Region], places: Places, storeys: Storeys) -> np.ndarray:
    """The storey (region,) that most ground of each region is on; the lower of equals."""
    count = max(len(storeys.floors_m), 1)
    number = _rows(regions, places) * count + storeys.of_place
    ground_m2 = np.bincount(number, storeys.weights_m2, minlength=len(regions) * count)
    return ground_m2.reshape(len(regions), count).argmax(axis=1)


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

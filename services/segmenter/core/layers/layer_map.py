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
from prior_sg.services.segmenter.core.layers.pieces import near_regions, numbers_of
from prior_sg.services.segmenter.core.layers.stacking import Layer, LayersConfig, LevelInForce, layers_of
from prior_sg.services.segmenter.core.layers.storeys import Storeys, floors_differ
from prior_sg.services.segmenter.core.map.received import ReceivedGraph
from prior_sg.services.segmenter.core.map.table import Places
from prior_sg.services.segmenter.core.regions.components import track

NodeKey = tuple[LevelName, int]
MOST_COUNTED = 1000  # places of a region, where its weight for an id is counted


class Held(NamedTuple):
    """What regions hold, in the order of their ids, and which ways lead between them."""

    ids: np.ndarray  # (region,) ascending
    areas_m2: np.ndarray  # (region,)
    counts: np.ndarray  # (region,) places
    positions_m: np.ndarray  # (region, 3)
    beliefs: np.ndarray  # (region, label) mean over its places
    ground_m2: np.ndarray  # (region, storey) of its places
    contacts: np.ndarray  # (contact, 2) ids, smaller first, sorted; a region's own are those in which it is first
    ways: np.ndarray  # (contact,) how wide these are together, as `alignment.Members` counts

    @classmethod
    def none(cls) -> "Held":
        """Of no regions."""
        nobody, nothing, column = np.zeros(0, np.int64), np.zeros(0), np.zeros((0, 1))
        return cls(nobody, nothing, nobody, np.zeros((0, 3)), column, column, nobody.reshape(0, 2), nothing)

    def without(self, ids: np.ndarray) -> "Held":
        """Those of other regions."""
        stays, leads = ~np.isin(self.ids, ids), ~np.isin(self.contacts[:, 0], ids)
        return Held._make([*(column[stays] for column in self[:-2]), self.contacts[leads], self.ways[leads]])

    def joined(self, other: "Held") -> "Held":
        """Those of both, which have no region in common."""
        if not (len(self.ids) and len(other.ids)):
            return self if len(self.ids) else other
        *columns, contacts, ways = (np.concatenate((one, two)) for one, two in zip(self, other, strict=True))
        order, sorted_ = np.argsort(columns[0]), np.lexsort(contacts.T[::-1])
        return Held._make([*(column[order] for column in columns), contacts[sorted_], ways[sorted_]])


class Numbered(NamedTuple):
    """A number of each region."""

    regions: np.ndarray  # (region,) ids, ascending
    numbers: np.ndarray  # (region,)

    @classmethod
    def of(cls, numbers: Mapping[int, int]) -> "Numbered":
        """Those of a table by region id."""
        table = np.array(sorted(numbers.items()), np.int64).reshape(-1, 2)
        return cls(table[:, 0], table[:, 1])

    @property
    def table(self) -> dict[int, int]:
        """The same by region id."""
        return dict(zip(self.regions.tolist(), self.numbers.tolist(), strict=True))

    def at(self, regions: np.ndarray, missing: int) -> np.ndarray:
        """Numbers (region,) of these regions; `missing` for those that have none."""
        where = np.searchsorted(self.regions, regions)
        padded = np.append(self.regions, -1), np.append(self.numbers, missing)
        return np.where(padded[0][where] == regions, padded[1][where], missing)


@dataclass
class LayerMap:
    """Nodes by level and id, and which node of each level each region is in."""

    next_ids: dict[LevelName, int] = field(default_factory=dict)
    known: dict[NodeKey, LevelNode] = field(default_factory=dict)
    node_of: dict[LevelName, Numbered] = field(default_factory=dict)  # node id of each region
    held: Held = field(default_factory=Held.none)
    floors_m: np.ndarray = field(default_factory=lambda: np.zeros(0))  # (storey,) that `held` counts by

    def inherit(self, nodes: list[LevelNode], next_ids: Mapping[LevelName, int]) -> None:
        """These nodes were known before this process, and no id below these has yet to be given."""
        self.known = {(node.level, node.id): node for node in nodes}
        self.node_of = {level: Numbered.of(regions_in(nodes, level)) for level in LEVELS}
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
        if changed is None or floors_differ(storeys.floors_m, self.floors_m):
            self.held = Held.none()
        self.floors_m = storeys.floors_m
        self.forget((set(self.held.ids.tolist()) - regions.keys()) | (changed or frozenset()))
        others = (regions[number] for number in sorted(regions.keys() - set(self.held.ids.tolist())))
        news = _held([region for region in others if region.place_count], places, storeys, cfg.alignment.way_m)
        self.held = self.held.joined(news)
        members = _members(self.held, graph, places, cfg)
        layers = layers_of(members, self.held.ground_m2.argmax(axis=1), levels, cfg.alignment)
        counts = np.minimum(self.held.counts, MOST_COUNTED)
        former, self.node_of = self.node_of, {}
        for layer in layers:
            before = former.get(layer.level, Numbered.of({})).at(self.held.ids, NO_REGION)
            next_id = self.next_ids.get(layer.level, 0)
            ids, self.next_ids[layer.level] = track(layer.groups, before, next_id, counts)
            self.node_of[layer.level] = Numbered(self.held.ids, ids)
        self.known = {(node.level, node.id): node for node in _nodes(self.held, layers, self.node_of)}

    def forget(self, regions: Set[int]) -> None:
        """These regions have changed, though no level was found again."""
        self.held = self.held.without(np.array([*regions], np.int64))

    @property
    def zones(self) -> dict[int, str]:
        """Label of the zone that each region is in, by region id; empty where there are none."""
        zone_of = self.node_of.get("zone", Numbered.of({}))
        labels = {node: self.known["zone", node].label for node in np.unique(zone_of.numbers).tolist()}
        return {region: labels[node] for region, node in zone_of.table.items()}


def _held(regions: list[Region], places: Places, storeys: Storeys, way_m: float) -> Held:
    """What each of the regions, in the order of their ids, holds."""
    ids = np.array([region.id for region in regions], np.int64)
    numbers, count = numbers_of(ids, places.regions), max(len(storeys.floors_m), 1)
    rows = np.flatnonzero(numbers[places.regions] >= 0)
    of_region = numbers[places.regions[rows]]
    cells = of_region * count + storeys.of_place[rows]
    ground_m2 = np.bincount(cells, storeys.weights_m2[rows], minlength=len(ids) * count)
    ways = [(region.id, other, width) for region in regions for other, width in _ways(region, way_m)]
    return Held(
        ids=ids,
        areas_m2=np.array([region.area_m2 for region in regions], float),
        counts=np.array([region.place_count for region in regions], np.int64),
        positions_m=np.array([region.position_m for region in regions], float).reshape(-1, 3),
        beliefs=_means(places.posteriors[rows].astype(np.float64), of_region, len(ids)),
        ground_m2=ground_m2.reshape(-1, count),
        contacts=np.array([way[:2] for way in ways], np.int64).reshape(-1, 2),
        ways=np.array([width for _, _, width in ways], np.float64),
    )


def _ways(region: Region, way_m: float) -> list[tuple[int, float]]:
    """The regions of higher id that ways lead to, ascending, and how wide these are together."""
    found: dict[int, float] = {}
    for way in region.transitions:
        if region.id < way.region:
            found[way.region] = found.get(way.region, 0.0) + min(way.clearance_m / way_m, 1.0)
    return sorted(found.items())


def _members(held: Held, graph: ReceivedGraph, places: Places, cfg: LayersConfig) -> Members:
    """Regions as members of the level above: mean beliefs of their places, and the ways between them."""
    listed = np.isin(held.contacts[:, 1], held.ids)
    known = np.searchsorted(held.ids, held.contacts[listed])
    near = near_regions(graph, places.regions, held.ids, known, cfg.join_m)
    return Members(
        areas_m2=held.areas_m2,
        beliefs=held.beliefs,
        edges=np.concatenate((known, near)),
        ways=np.concatenate((held.ways[listed], np.zeros(len(near)))),
    )


def _means(values: np.ndarray, rows: np.ndarray, count: int) -> np.ndarray:
    """Mean (row, column) of the values (place, column) of each row."""
    sums = np.stack([np.bincount(rows, column, minlength=count) for column in values.T], axis=1)
    return sums / np.maximum(np.bincount(rows, minlength=count), 1)[:, None]


def _nodes(held: Held, layers: list[Layer], node_of: dict[LevelName, Numbered]) -> list[LevelNode]:
    """The nodes of all levels, by level and id."""
    found = []
    members, of_region = "region", held.ids
    for number, layer in enumerate(layers):
        own = node_of[layer.level].numbers
        above = node_of[layers[number + 1].level].numbers if number + 1 < len(layers) else np.full(len(own), NO_NODE)
        for node in np.unique(own).tolist():
            rows = np.flatnonzero(own == node)
            middle_m = np.average(held.positions_m[rows], axis=0, weights=held.counts[rows].astype(float))
            x, y, z = middle_m.round(2).tolist()
            group = int(layer.groups[rows[0]])
            found.append(
                LevelNode(
                    level=layer.level,
                    id=node,
                    label=layer.labels[group],
                    probability=round(float(layer.probabilities[group]), 2),
                    member_ids=np.unique(of_region[rows]).tolist(),
                    members=members,
                    area_m2=round(float(held.areas_m2[rows].sum()), 2),
                    position_m=(x, y, z),
                    parent_id=int(above[rows[0]]),
                )
            )
        members, of_region = layer.level, own
    return found

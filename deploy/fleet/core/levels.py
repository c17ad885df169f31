"""Levels above the regions of the merged map, found as a robot's segmenter finds those of its own (pure).

Storeys come from the geometry of all nodes that have a label. Zones, and whatever else a prior names, are those of one
robot's prior; a label that this prior does not know says nothing of them.
"""

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import msgspec
import numpy as np

from prior_sg.deploy.fleet.core.believing import CFG
from prior_sg.deploy.fleet.core.fusing import Fused
from prior_sg.schemas.levels import LevelName, LevelNode, LevelPrior, rank
from prior_sg.schemas.priors import Prior
from prior_sg.schemas.regions import NO_REGION
from prior_sg.schemas.scene import Scene
from prior_sg.services.segmenter.core.aim import border_costs
from prior_sg.services.segmenter.core.layers.layer_map import LayerMap, Numbered
from prior_sg.services.segmenter.core.layers.stacking import BUILDING, LevelInForce
from prior_sg.services.segmenter.core.layers.storeys import Storeys, storeys_of
from prior_sg.services.segmenter.core.map.received import ReceivedGraph
from prior_sg.services.segmenter.core.map.table import Places


class Ground(NamedTuple):
    """The nodes that have a label, as a segmenter has its places."""

    rows: np.ndarray  # (place,) of the merged graph's nodes
    graph: ReceivedGraph
    storeys: Storeys


def ground_of(found: Fused, labels: np.ndarray, on_ground: bool) -> Ground:
    """Of nodes with `labels` (node,), -1 = none; `on_ground` says that the robots' places lie on the ground."""
    rows = np.flatnonzero(labels >= 0)
    number = np.full(len(labels), -1)
    number[rows] = np.arange(len(rows))
    edges = number[found.edges].reshape(-1, 2)
    inner = (edges >= 0).all(axis=1)
    graph = ReceivedGraph(
        found.ids[rows],
        found.positions_m[rows],
        found.radii_m[rows],
        edges[inner],
        found.clearances_m[inner],
        on_ground,
    )
    return Ground(rows, graph, storeys_of(graph, CFG.layers.storeys))


def names_levels(nodes: list[LevelNode]) -> bool:
    """Whether the prior that a map follows names levels above its regions: any but what the geometry says."""
    found = ((node.level, node.label) for node in nodes if node.level != "floor")
    return any(one != ("building", BUILDING) for one in found)


@dataclass
class Levels:
    """The levels as known, with ids that last."""

    map: LayerMap = field(default_factory=LayerMap)
    node_of: dict[LevelName, dict[int, int]] = field(default_factory=dict)  # by region, also of gone ones
    seen: Scene | None = None  # when they were found last, without them
    prior: Prior | None = None  # in force then

    def renew(self, scene: Scene, ground: Ground, prior: Prior | None) -> Scene:
        """The scene with its levels, which are found again where a region has changed; each region names its zone."""
        if not scene.regions:
            self.map, self.seen, self.prior = LayerMap(self.map.next_ids), None, prior
            return scene
        changed = None
        if self.seen is not None and self.prior is prior and self.seen.labels == scene.labels:
            changed = _changed(self.seen, scene)
        if changed is None or changed:
            self.map.node_of = {level: Numbered.of(held) for level, held in self.node_of.items()}
            regions, beliefs = scene.place_regions[ground.rows], scene.posteriors[ground.rows].astype(np.float32)
            self.map.renew(
                {region.id: region for region in scene.regions},
                ground.graph,
                replace(Places.none(), regions=regions, posteriors=beliefs),
                ground.storeys,
                levels=in_force(prior, scene.labels),
                cfg=CFG.layers,
                changed=changed,
            )
            for level, held in self.map.node_of.items():
                self.node_of[level] = self.node_of.get(level, {}) | held.table
        self.seen, self.prior = scene, prior
        zones = self.map.zones
        regions = [msgspec.structs.replace(one, parent=zones.get(one.id, one.parent)) for one in scene.regions]
        return msgspec.structs.replace(scene, regions=regions, nodes=sorted(self.map.known.values(), key=rank))


def in_force(prior: Prior | None, labels: list[str]) -> dict[str, LevelInForce]:
    """The levels that a prior names, by name, the lowest upon the merged map's labels."""
    if prior is None or not prior.levels_above:
        return {}
    lowest, *others = prior.levels_above
    existence = np.array([entry.existence for entry in lowest.entries], np.float32)
    known = dict(zip([region.name for region in prior.regions], lowest.parents, strict=True))
    parents = np.array([known.get(label, existence) for label in labels], np.float32)
    levels: list[LevelPrior] = [msgspec.structs.replace(lowest, parents=parents), *others]
    return {level.name: LevelInForce(level, border_costs(level, CFG)) for level in levels}


def _changed(before: Scene, now: Scene) -> set[int]:
    """Regions that are described otherwise, or whose places lie or are believed otherwise; also those that are gone."""
    former, present = ({region.id: region for region in scene.regions} for scene in (before, now))
    found = {number for number in former.keys() | present.keys() if former.get(number) != present.get(number)}
    _, then, here = np.intersect1d(before.place_ids, now.place_ids, assume_unique=True, return_indices=True)
    other = (before.place_regions[then] != now.place_regions[here]) | (before.radii_m[then] != now.radii_m[here])
    other |= (before.positions_m[then] != now.positions_m[here]).any(axis=1)
    other |= (before.posteriors[then] != now.posteriors[here]).any(axis=1)
    for scene, rows in ((before, then), (now, here)):
        touched = np.ones(len(scene.place_ids), bool)
        touched[rows] = other
        found |= {*np.unique(scene.place_regions[touched]).tolist()}
    return found - {NO_REGION}

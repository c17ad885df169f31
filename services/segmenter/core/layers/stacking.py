"""From regions to all levels above them, one upon the other (pure).

Zones follow the prior and never span storeys. A building is a part of the map that hangs together, by ways or because
its pieces stand side by side (`pieces`), and that the prior takes for one thing, such as indoors or outdoors; where it
names no such level, all that hangs together. A floor is what a building has on one storey. Districts follow the prior.
"""

from collections.abc import Mapping
from typing import NamedTuple

import msgspec
import numpy as np

from prior_sg.schemas.levels import LevelName, LevelPrior
from prior_sg.services.segmenter.core.layers.alignment import AlignmentConfig, Members, align, beliefs_of, grouped
from prior_sg.services.segmenter.core.layers.storeys import StoreyConfig
from prior_sg.services.segmenter.core.regions.components import numbered

BUILDING = "building"  # the label of buildings where the prior names no such level


class LayersConfig(msgspec.Struct, frozen=True, kw_only=True):
    """How the levels above regions are found."""

    storeys: StoreyConfig = msgspec.field(default_factory=StoreyConfig)
    alignment: AlignmentConfig = msgspec.field(default_factory=AlignmentConfig)
    join_m: float = 1.0  # from the free space of one piece of a map to another's, through walls or a slab: one building

    def __post_init__(self) -> None:
        if self.join_m < 0:
            raise ValueError("join_m is negative")


class LevelInForce(NamedTuple):
    """One level of the prior, and what its borders cost."""

    prior: LevelPrior
    pairwise: np.ndarray  # (entry, entry)


class Layer(NamedTuple):
    """One level as found."""

    level: LevelName
    groups: np.ndarray  # (region,) number of the node that each region is in
    labels: list[str]  # (node)
    probabilities: np.ndarray  # (node,) of the label


class Standing(NamedTuple):
    """The entities of the highest level so far."""

    members: Members
    at: np.ndarray  # (region,) member that each region is in


def layers_of(
    regions: Members, storeys: np.ndarray, levels: Mapping[str, LevelInForce], cfg: AlignmentConfig
) -> list[Layer]:
    """All levels of a map, from below; `storeys` (region,)."""
    if not len(storeys):
        return []
    now, layers = Standing(regions, np.arange(len(storeys))), list[Layer]()
    if "zone" in levels:
        now, layer = _aligned("zone", now, _within(regions, storeys), levels["zone"], cfg)
        layers.append(layer)
    housed, buildings = _buildings(now, levels.get("building"), cfg)
    layers += [_floors(buildings.groups, storeys), buildings]
    if "district" in levels:
        layers.append(_aligned("district", housed, housed.members, levels["district"], cfg)[1])
    return layers


def _aligned(
    name: LevelName, now: Standing, near: Members, level: LevelInForce, cfg: AlignmentConfig
) -> tuple[Standing, Layer]:
    """Connected members under one entry of the prior; `near` are the members with the contacts that count."""
    aligned = align(near, level.prior, level.pairwise, cfg)
    groups = numbered(aligned.labels, near.edges)
    first = np.unique(groups, return_index=True)[1]
    labels = aligned.labels[first]
    beliefs = beliefs_of(aligned.costs, groups, cfg.temperature)
    probabilities = beliefs[np.arange(len(labels)), labels]
    layer = Layer(name, groups[now.at], [level.prior.names[label] for label in labels.tolist()], probabilities)
    return Standing(grouped(now.members, groups, beliefs), groups[now.at]), layer


def _within(members: Members, storeys: np.ndarray) -> Members:
    """The same without contacts between storeys, or through walls."""
    same = (storeys[members.edges[:, 0]] == storeys[members.edges[:, 1]]) & (members.ways > 0)
    return members._replace(edges=members.edges[same], ways=members.ways[same])


def _buildings(now: Standing, level: LevelInForce | None, cfg: AlignmentConfig) -> tuple[Standing, Layer]:
    if level is not None:
        return _aligned("building", now, now.members, level, cfg)
    groups = numbered(np.zeros(len(now.members.areas_m2), np.int64), now.members.edges)
    count = int(groups.max()) + 1
    shares = np.zeros((count, now.members.beliefs.shape[1]))
    np.add.at(shares, groups, now.members.areas_m2[:, None] * now.members.beliefs)
    beliefs = shares / np.maximum(shares.sum(axis=1, keepdims=True), np.finfo(float).tiny)
    layer = Layer("building", groups[now.at], [BUILDING] * count, np.ones(count))
    return Standing(grouped(now.members, groups, beliefs), groups[now.at]), layer


def _floors(buildings: np.ndarray, storeys: np.ndarray) -> Layer:
    """What each building (region,) has on each storey (region,)."""
    count = int(storeys.max()) + 1
    found, groups = np.unique(buildings * count + storeys, return_inverse=True)
    return Layer("floor", groups, [f"floor {storey}" for storey in (found % count).tolist()], np.ones(len(found)))
